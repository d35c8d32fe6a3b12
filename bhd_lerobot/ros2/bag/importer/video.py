"""The images of a robot's camera, out of its bag into an episode."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.writer.episode import EpisodeWriter
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.ros2.bag.importer.resample import Times, newest
from bhd_lerobot.ros2.bag.importer.tracks import MOST_LOST, Track
from bhd_lerobot.ros2.bag.storage.read import Bag
from bhd_lerobot.ros2.messages.images import decode_image

_TRIED = 10  # images at the beginning, of which one must be readable


class CameraImages:
    """One camera."""

    def __init__(self, bag: Bag, track: Track, notes: list[str]) -> None:
        self.key = track.source.feature
        self._bag, self._track, self._notes = bag, track, notes
        self._messages = bag.messages((track.topic,))
        self._place, self._payload = -1, b""  # the newest message that was read
        self._image: NDArray[np.uint8] | None = None  # of that message, once it is decoded

    def of(self, tracks: Sequence[Track]) -> Track:
        """Return its track among others."""
        return next(track for track in tracks if track.source.feature == self.key)

    def shape(self) -> tuple[int, int, int]:
        """Return the shape of its images."""
        height, width, channels = self._decode(
            self._track, self._first(self._track, range(len(self._track.times)))
        ).shape
        wanted = self._track.source.size
        if any(wanted) and wanted != (height, width):
            raise DatasetError(
                f"The images of {self._track.topic} have {width} x {height} pixels; the mapping says {wanted[1]} x "
                f"{wanted[0]}. Give the size that they have, or leave width and height out."
            )
        return height, width, channels

    def blind(self, track: Track, times: Times) -> int:
        """Return how many frames at the beginning of an episode have no image that can be decoded."""
        rows, first = np.unique(newest(track.times, times), return_index=True)
        return int(first[rows == self._first(track, rows.tolist())][0])

    def write(self, track: Track, times: Times, writer: EpisodeWriter) -> Times:
        """Add the image of each frame to an episode; return when they were taken [ns], shape (frames,).

        An image that cannot be decoded, as of a camera that was unplugged, is as if it had been lost: the one before
        is there in its place, with its age.

        Args:
            times: of the frames [ns]; the first one has an image that can be decoded.
        """
        rows = newest(track.times, times)
        total = len(np.unique(rows))
        image: NDArray[np.uint8] | None = None
        shown, broken, reason, before, good = rows.copy(), 0, "", -1, -1
        for frame, row in enumerate(rows.tolist()):
            if row != before:
                try:
                    image = self._decode(track, row)
                    good = row
                except DatasetError as error:
                    broken += 1
                    reason = reason or str(error)
                    if image is None or broken > max(1, MOST_LOST * total):
                        raise DatasetError(
                            f"{broken} of {total} images of an episode cannot be decoded, which is more than "
                            f"{100 * MOST_LOST:.0f} %: too many to continue without them. The first: {reason}"
                        ) from error
                before = row
            assert image is not None
            shown[frame] = good
            writer.add_image(self.key, image)
        if broken:
            self._notes.append(
                f"{track.topic}: {broken} of {total} images of an episode cannot be decoded; the previous image takes "
                f"their place. The first: {reason}"
            )
        return track.times[shown]

    def _first(self, track: Track, rows: Sequence[int]) -> int:
        """Return the first of some messages that can be decoded."""
        reason: DatasetError | None = None
        for row in rows[:_TRIED]:
            try:
                self._decode(track, row)
            except DatasetError as error:
                reason = reason or error
            else:
                return row
        assert reason is not None
        raise reason

    def _decode(self, track: Track, row: int) -> NDArray[np.uint8]:
        """Return the image of a message. Images are read from the bag one by one, best in their order."""
        place = int(track.values[row, 0])
        if place != self._place:
            if place < self._place:
                self._messages, self._place = self._bag.messages((track.topic,)), -1
            while self._place < place:
                _, _, self._place, self._payload = next(self._messages)
            self._image = None
        if self._image is None:
            self._image = decode_image(track.topic, track.msgtype, self._payload)
        return self._image
