"""Images in messages: every encoding that cameras have, and what is refused."""

import io

import numpy as np
import pytest
from PIL import Image

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.messages.images import COMPRESSED, IMAGE, decode_image, encode_image
from bhd_lerobot.ros2.messages.parts import Frames
from tests.cases import each_case
from tests.ros2.bag.support import STORE, T, header

rng = np.random.default_rng(0)
PREVIEW = np.repeat(np.repeat(rng.integers(0, 256, (4, 6, 3), np.uint8), 8, axis=0), 8, axis=1)  # (32, 48, 3)
GREY = np.repeat(PREVIEW[:, :, :1], 3, axis=2)
FULL = np.full((32, 48, 1), 255, np.uint8)


def raw(encoding, pixels, *, padding=0):
    height, width = pixels.shape[:2]
    flat = pixels.reshape(height, width * pixels.shape[2])
    rows = np.concatenate([flat, np.zeros((height, padding), np.uint8)], axis=1)
    message = T[IMAGE](
        header=header(5, "camera"), height=height, width=width, encoding=encoding, is_bigendian=0, step=rows.shape[1],
        data=np.ascontiguousarray(rows).reshape(-1),
    )  # fmt: skip
    return bytes(STORE.serialize_cdr(message, IMAGE))


def packed(data, form="jpeg"):
    message = T[COMPRESSED](header=header(5, "camera"), format=form, data=np.frombuffer(data, np.uint8))
    return bytes(STORE.serialize_cdr(message, COMPRESSED))


def file(image, kind, mode=None):
    buffer = io.BytesIO()
    Image.fromarray(image).convert(mode).save(buffer, kind) if mode else Image.fromarray(image).save(buffer, kind)
    return buffer.getvalue()


@pytest.mark.law
@each_case(
    ("encoding", "pixels", "seen"),
    [
        ("rgb8", PREVIEW, PREVIEW),
        ("bgr8", PREVIEW[:, :, ::-1], PREVIEW),
        ("rgba8", np.concatenate([PREVIEW, FULL], axis=2), PREVIEW),
        ("bgra8", np.concatenate([PREVIEW[:, :, ::-1], FULL], axis=2), PREVIEW),
        ("mono8", GREY[:, :, :1], GREY),
    ],
)
@each_case("padding", [0, 16])
def test_raw_images(encoding, pixels, seen, padding):
    message = raw(encoding, np.ascontiguousarray(pixels), padding=padding)
    assert np.array_equal(decode_image("/c", IMAGE, message), seen)


@pytest.mark.parametrize(
    ("kind", "mode", "seen", "within"),
    [("PNG", None, PREVIEW, 0), ("PNG", "RGBA", PREVIEW, 0), ("PNG", "L", None, 0), ("JPEG", None, PREVIEW, 15)],
)
def test_compressed_images(kind, mode, seen, within):
    found = decode_image("/c", COMPRESSED, packed(file(PREVIEW, kind, mode), kind.lower()))
    if seen is None:
        assert np.array_equal(found, np.repeat(np.asarray(Image.fromarray(PREVIEW).convert("L"))[..., None], 3, axis=2))
    else:
        assert np.abs(found.astype(int) - seen).mean() <= within


@each_case("encoding", ["16UC1", "mono16", "32FC1", "bayer_rggb8", "yuv422_yuy2", ""])
def test_raw_images_of_another_encoding_are_refused_with_the_valid_ones(encoding):
    with pytest.raises(DatasetError, match=r"/c have the encoding .* valid: rgb8, bgr8"):
        decode_image("/c", IMAGE, raw(encoding, np.zeros((4, 6, 2), np.uint8)))


def test_depth_and_broken_images_are_refused():
    depth = file(np.arange(24, dtype=np.uint16).reshape(4, 6) * 1000, "PNG")
    with pytest.raises(DatasetError, match="more than 8 bits"):
        decode_image("/c", COMPRESSED, packed(depth, "16UC1; png compressed "))
    with pytest.raises(DatasetError, match=r"compressedDepth png.*neither JPEG nor PNG"):
        decode_image("/c", COMPRESSED, packed(bytes(12) + depth, "16UC1; compressedDepth png"))
    whole = {kind: file(PREVIEW, kind) for kind in ("PNG", "JPEG")}
    for kind, data in whole.items():
        for size in (0, 10, len(data) // 2):
            with pytest.raises(DatasetError, match="/c"):
                decode_image("/c", COMPRESSED, packed(data[:size], kind))
    huge = bytearray(whole["PNG"])
    huge[16:24] = b"\0\1\0\0" * 2  # 65,536 x 65,536 pixels
    with pytest.raises(DatasetError, match="/c"):
        decode_image("/c", COMPRESSED, packed(bytes(huge), "png"))
    with pytest.raises(DatasetError, match="0 x 6"):
        decode_image("/c", IMAGE, raw("rgb8", np.zeros((0, 6, 3), np.uint8)))


def test_our_jpegs_say_how_image_transport_has_to_read_them():
    """It decodes into blue, green, red, and changes them into what stands first if "compressed bgr" follows."""
    frames = Frames(0, np.array([0]), np.array([5]))
    message = STORE.deserialize_cdr(encode_image(frames, "c", PREVIEW, compressed=True), COMPRESSED)
    assert message.format == "rgb8; jpeg compressed bgr8"
    stored = np.asarray(Image.open(io.BytesIO(message.data.tobytes())))  # colours as the JPEG standard has them
    assert np.abs(stored.astype(int) - PREVIEW).mean() <= 5


@pytest.mark.parametrize("msgtype", [IMAGE, COMPRESSED])
def test_an_image_that_is_cut_off_is_refused(msgtype):
    whole = raw("rgb8", PREVIEW) if msgtype == IMAGE else packed(file(PREVIEW, "PNG"), "rgb8; png")
    assert np.array_equal(decode_image("/c", msgtype, whole), PREVIEW)
    for size in (len(whole) // 2, 40, 13, 4, 1, 0):
        with pytest.raises(DatasetError):
            decode_image("/c", msgtype, whole[:size])
