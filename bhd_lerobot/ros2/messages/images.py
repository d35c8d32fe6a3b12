"""Images in bags: `sensor_msgs/Image` and `CompressedImage`."""

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.messages.parts import Frames, header
from bhd_lerobot.ros2.messages.serialize import decode, encode

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_JPEG_QUALITY = 95
# What image_transport writes of an rgb8 image. It decodes with OpenCV, into blue, green, red; by the last word it
# knows that red and blue have to change places.
_FORMAT = "rgb8; jpeg compressed bgr8"
_COLOURS = ("RGB", "RGBA", "L", "LA", "P", "1", "CMYK", "YCbCr")  # modes of PIL with 8 bits
# encoding of a raw image -> its type, channels, and where red, green and blue are in it
_RAW = {
    "rgb8": (np.uint8, 3, (0, 1, 2)),
    "bgr8": (np.uint8, 3, (2, 1, 0)),
    "rgba8": (np.uint8, 4, (0, 1, 2)),
    "bgra8": (np.uint8, 4, (2, 1, 0)),
    "mono8": (np.uint8, 1, (0, 0, 0)),
}


def encode_image(frames: Frames, frame_id: str, image: NDArray[np.uint8], *, compressed: bool) -> bytes:
    """Return one image as a message: raw RGB, or JPEG."""
    fields: dict[str, Any] = {"header": header(frames.stamps, frame_id)}
    if compressed:
        from PIL import Image

        file = io.BytesIO()
        Image.fromarray(image).save(file, "JPEG", quality=_JPEG_QUALITY, subsampling=0)
        fields |= {"format": _FORMAT, "data": np.frombuffer(file.getvalue(), np.uint8)}
        return encode(COMPRESSED, fields, 1)[0]
    height, width, _ = image.shape
    fields |= {"height": height, "width": width, "encoding": "rgb8", "step": 3 * width, "data": image.reshape(1, -1)}
    return encode(IMAGE, fields, 1)[0]


def decode_image(topic: str, msgtype: str, message: bytes) -> NDArray[np.uint8]:
    """Return the image in a message, shape (H, W, 3)."""
    found = decode(msgtype, message)
    if msgtype == COMPRESSED:
        return _decompressed(topic, found.format, found.data)
    encoding = found.encoding
    if encoding not in _RAW:
        raise DatasetError(
            f"The images of {topic} have the encoding {encoding!r}; valid: {', '.join(_RAW)}, or a CompressedImage."
        )
    dtype, channels, order = _RAW[encoding]
    height, width, step, data = found.height, found.width, found.step, found.data
    if not height * width or len(data) != height * step or step < width * channels:
        raise DatasetError(f"An image of {topic} has {len(data)} bytes, which is not {height} x {width} {encoding}.")
    rows = data.view(dtype).reshape(height, step)[:, : width * channels].reshape(height, width, channels)
    return np.ascontiguousarray(rows[:, :, order])


def _decompressed(topic: str, form: str, data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    from PIL import Image

    what = f"{form!r}, {len(data)} bytes"
    try:
        image = Image.open(io.BytesIO(data.tobytes()))
        if image.mode in _COLOURS:
            return np.asarray(image.convert("RGB"))
    except Image.UnidentifiedImageError as error:
        raise DatasetError(
            f"An image of {topic} ({what}) is neither JPEG nor PNG, and cannot be decoded. Compressed depth is not "
            "supported."
        ) from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise DatasetError(f"An image of {topic} ({what}) cannot be decoded: {error}.") from error
    raise DatasetError(
        f"The images of {topic} ({what}) have more than 8 bits (mode {image.mode}), as of a depth camera; valid: "
        "JPEG and PNG in colour or grey."
    )
