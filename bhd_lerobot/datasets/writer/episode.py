"""One episode while it is being recorded: its columns in memory, its video on the way to the disk."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bhd_lerobot.datasets.format.schema import LANGUAGE, Column, Schema
from bhd_lerobot.datasets.format.video import CameraEncoder, EncodedVideo, VideoSettings
from bhd_lerobot.datasets.storage.disk import Disk, write_errors
from bhd_lerobot.datasets.writer.encoder_process import RemoteEncoder
from bhd_lerobot.errors import FrameError, unknown_name

_FIRST_CAPACITY = 64
EncoderMaker = Callable[[Path, int, tuple[int, int], VideoSettings], CameraEncoder | RemoteEncoder]


class EpisodeWriter:
    """Collects the frames of one episode. `DatasetRecorder.begin_episode` makes it, `DatasetRecorder.save` ends it.

    Fill it either frame by frame (`add_frame`) or with whole columns (`set_columns`), and add one image per frame to
    every camera. All values are copied.
    """

    def __init__(
        self,
        schema: Schema,
        fps: int,
        *,
        folder: Path,
        disk: Disk,
        video: VideoSettings,
        make_encoder: EncoderMaker,
        on_close: Callable[["EpisodeWriter"], None],
    ) -> None:
        """Start empty.

        Args:
            folder: staging folder of this episode; made when there is something to put in it.
            on_close: called once when the episode was saved or discarded.
        """
        self.folder = folder
        self._schema, self._fps, self._disk, self._video, self._on_close = schema, fps, disk, video, on_close
        self._keys = {column.key for column in schema.columns}
        self._slots = {column.key: column for column in schema.columns}
        self._buffers: dict[str, np.ndarray] = {}
        self._rows = 0
        self._by_frame: bool | None = None
        self._make_encoder = make_encoder
        self._encoders: dict[str, CameraEncoder | RemoteEncoder | EncodedVideo] = {}
        self._closed = False

    @property
    def length(self) -> int:
        """Frames so far."""
        if not self._keys and self._encoders:
            return max(encoder.frames for encoder in self._encoders.values())
        return self._rows

    def add_frame(self, frame: Mapping[str, ArrayLike]) -> None:
        """Append one frame.

        Args:
            frame: a value of the feature's shape for every feature that is neither video nor filled in by the
                recorder. Scalars may be plain numbers or arrays of shape (1,).

        Raises:
            FrameError: missing or extra keys, or a value of the wrong shape or type. Nothing was added then.
        """
        self._open(by_frame=True)
        if frame.keys() != self._keys:
            self._raise_keys(frame.keys())
        row = self._rows
        if not self._buffers:
            self._buffers = {c.key: np.empty((_FIRST_CAPACITY, *c.shape), c.dtype) for c in self._schema.columns}
        elif row == len(next(iter(self._buffers.values()))):
            self._buffers = {key: np.concatenate([old, np.empty_like(old)]) for key, old in self._buffers.items()}
        for column in self._schema.columns:
            value = frame[column.key]
            if type(value) is np.ndarray and value.dtype == column.dtype and value.shape == column.shape:
                self._buffers[column.key][row] = value
            else:
                self._buffers[column.key][row] = _converted(column, value)
        self._rows += 1

    def set_columns(self, columns: Mapping[str, np.ndarray]) -> None:
        """Set whole columns; several calls may each bring some of them.

        Args:
            columns: key -> array of shape (T, *shape), or (T,) where the shape is (1,). T is the same for all.

        Raises:
            FrameError: an unknown key, another number of frames, or a wrong shape or type.
        """
        self._open(by_frame=False)
        converted = {}
        rows = self._rows
        for key, values in columns.items():
            column = self._slots.get(key)
            if column is None:
                raise FrameError(unknown_name("feature", key, self._keys))
            array = _converted_column(column, values)
            if rows and len(array) != rows:
                raise FrameError(f"{key!r} has {len(array)} frames; the columns before it have {rows}.")
            rows = len(array)
            converted[key] = array
        self._buffers.update(converted)
        self._rows = rows

    def add_image(self, key: str, image: np.ndarray) -> None:
        """Append one image to a camera.

        Waits while the encoder is busy; after `DatasetRecorder.encode_in_process` it never waits, see `dropped`.

        Args:
            key: the video feature.
            image: shape (H, W, 3), uint8.

        Raises:
            FrameError: unknown camera, wrong shape or type.
            DatasetWriteError: the encoder cannot write, for example because the disk is full.
        """
        self._open(by_frame=self._by_frame)
        encoder = self._encoders.get(key)
        with write_errors("encode video", self.folder.parents[1], "Episodes saved before are intact."):
            if encoder is None:
                if key not in self._schema.videos:
                    raise FrameError(unknown_name("camera", key, self._schema.videos))
                self._disk.make_folder(self.folder)
                path = self.folder / f"{key}.mp4"
                encoder = self._make_encoder(path, self._fps, self._schema.videos[key], self._video)
                self._encoders[key] = encoder
            if isinstance(encoder, EncodedVideo):
                raise FrameError(f"The video of camera {key!r} is complete; it takes no more images.")
            encoder.add(image)

    @property
    def dropped(self) -> dict[str, list[int]]:
        """Frames whose image was dropped because the encoder was too slow, by camera; it shows the one before."""
        encoders = ((key, getattr(encoder, "dropped", [])) for key, encoder in self._encoders.items())
        return {key: rows for key, rows in encoders if rows}

    @property
    def images_per_s(self) -> float:
        """Images of all cameras that the encoders' process encodes in a second [Hz]; 0 where there is none."""
        return max((getattr(encoder, "images_per_s", 0.0) for encoder in self._encoders.values()), default=0.0)

    @property
    def video(self) -> VideoSettings:
        """How its images are encoded."""
        return self._video

    def add_video(self, key: str, content: bytes, histograms: np.ndarray) -> None:
        """Add all images of a camera at once, which were encoded elsewhere with the settings of `video`.

        Args:
            key: the video feature.
            content: the MP4 file.
            histograms: of its images, shape (T, 3, 256), see `image_histogram`.

        Raises:
            FrameError: unknown camera, or one that has images already.
            DatasetWriteError: the disk refused it.
        """
        self._open(by_frame=self._by_frame)
        if key not in self._schema.videos or key in self._encoders:
            known = self._schema.videos.keys() - self._encoders.keys()
            raise FrameError(unknown_name("camera without images", key, known))
        path = self.folder / f"{key}.mp4"
        with write_errors("store video", self.folder.parents[1], "Episodes saved before are intact."):
            self._disk.make_folder(self.folder)
            self._disk.write(path, content)
        self._encoders[key] = EncodedVideo(path, histograms)

    def discard(self) -> None:
        """Throw the episode away; a second call, or a call after saving, does nothing."""
        if not self._closed:
            for encoder in self._encoders.values():
                encoder.cancel()
            self.close()

    def check_complete(self) -> None:
        """Check that every feature has a value for every frame.

        Raises:
            FrameError: the episode is empty, or a column or images are missing.
        """
        self._open(by_frame=self._by_frame)
        if self.length == 0:
            raise FrameError("The episode has no frames; there is nothing to save. Discard it instead.")
        if missing := self._keys - self._buffers.keys():
            raise FrameError(f"The episode has no values for {', '.join(sorted(missing))}.")
        for key in self._schema.videos:
            images = self._encoders[key].frames if key in self._encoders else 0
            if images != self.length:
                raise FrameError(f"Camera {key!r} has {images} images for {self.length} frames.")

    def columns(self) -> dict[str, np.ndarray]:
        """Return the columns, shape (T,) or (T, d), C-contiguous; they are valid until the next frame."""
        return {key: buffer[: self._rows] for key, buffer in self._buffers.items()}

    def finish_videos(self) -> dict[str, tuple[Path, np.ndarray]]:
        """Close all encoders and return camera -> (file, histograms of shape (T, 3, 256))."""
        return {key: (encoder.path, encoder.finish()) for key, encoder in self._encoders.items()}

    def close(self) -> None:
        """Forget everything; the recorder calls it after a save."""
        self._closed = True
        self._buffers = {}
        self._on_close(self)

    def _open(self, by_frame: bool | None) -> None:
        if self._closed:
            raise FrameError("This episode was saved or discarded already; begin a new one.")
        if self._by_frame is not None and by_frame != self._by_frame:
            raise FrameError("Fill an episode with add_frame or with set_columns, not with both.")
        self._by_frame = by_frame

    def _raise_keys(self, given: object) -> None:
        keys = set(given)  # type: ignore[call-overload]
        missing, extra = sorted(self._keys - keys), sorted(map(str, keys - self._keys))
        parts = [f"missing: {', '.join(missing)}"] if missing else []
        parts += [f"not a feature: {', '.join(extra)}"] if extra else []
        raise FrameError(f"The frame does not fit the features ({'; '.join(parts)}).")


def _converted(column: Column, value: ArrayLike) -> np.ndarray | str:
    if column.key == LANGUAGE:
        return value  # type: ignore[return-value]  # what it holds is checked when it is written
    if column.dtype == object:
        return _text(column.key, value)
    array = np.asarray(value)
    if array.shape != column.shape and not (column.shape == () and array.shape == (1,)):
        raise FrameError(f"{column.key!r} needs the shape {column.shape or (1,)}; got {array.shape}.")
    _check_type(column, array)
    return array.reshape(column.shape)


def _converted_column(column: Column, values: ArrayLike) -> np.ndarray:
    if column.key == LANGUAGE:
        frames: list[Any] = list(values)  # type: ignore[arg-type]
        rows = np.empty(len(frames), dtype=object)
        rows[:] = frames  # np.array would make a matrix of lists of equal length
        return rows
    array = np.asarray(values, dtype=object if column.dtype == object else None)
    if column.shape == () and array.ndim == 2 and array.shape[1] == 1:
        array = array[:, 0]
    if array.ndim == 0 or array.shape[1:] != column.shape:
        raise FrameError(f"{column.key!r} needs the shape (frames, {column.shape or 1}); got {array.shape}.")
    if column.dtype == object:
        return np.array([_text(column.key, value) for value in array], dtype=object)
    _check_type(column, array)
    return np.array(array, dtype=column.dtype, order="C")


def _check_type(column: Column, array: np.ndarray) -> None:
    # float64 -> float32 and int -> float are harmless; float -> int or number -> bool would change the meaning.
    if array.dtype != column.dtype and not np.can_cast(array.dtype, column.dtype, casting="same_kind"):
        raise FrameError(f"{column.key!r} holds {column.dtype} values; {array.dtype} cannot be stored in it.")


def _text(key: str, value: object) -> str:
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    if not isinstance(value, str):
        raise FrameError(f"{key!r} holds text; got {value!r}.")
    return str(value)
