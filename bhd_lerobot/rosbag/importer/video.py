"""The images of a robot's camera, out of its bag into an episode."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.datasets.writer.episode import EpisodeWriter
from bhd_lerobot.errors import DatasetError
from bhd_lerobot.rosbag.importer.resample import Times, newest
from bhd_lerobot.rosbag.importer.tracks import MOST_LOST, Track
from bhd_lerobot.rosbag.messages.images import decode_image
from bhd_lerobot.rosbag.storage.read import Bag, Picker

CAMERA = "camera/"
"""What the role of a camera's track begins with; its name follows."""

_TRIED = 10  # images at the beginning, of which one must be readable


class CameraImages:
    """One camera.

    Attributes:
        role: of its track.
        name: of the camera.

    Args:
        bag: the bag.
        role: of its track.
        track: all of its messages.
        notes: what is left out is added to it.
    """

    def __init__(self, bag: Bag, role: str, track: Track, notes: list[str]) -> None:
        self.role, self.name = role, role.removeprefix(CAMERA)
        self._track, self._notes = track, notes
        self._images = Picker(bag, track.topic)

    def shape(self) -> tuple[int, int, int]:
        """Return the shape of its images.

        Raises:
            DatasetError: none of the first ones can be decoded.
        """
        reason: DatasetError | None = None
        for place in self._track.values[:_TRIED, 0].astype(np.int64).tolist():
            try:
                height, width, channels = self._decode(place).shape
            except DatasetError as error:
                reason = reason or error
            else:
                return height, width, channels
        assert reason is not None
        raise reason

    def blind(self, track: Track, times: Times) -> int:
        """Return how many frames at the beginning of an episode have no image that can be decoded.

        Args:
            track: the camera's messages in the segment in which the episode lies, sorted by time.
            times: of the frames [ns].

        Raises:
            DatasetError: none of the first images can.
        """
        reason: DatasetError | None = None
        rows, first = np.unique(newest(track.times, times), return_index=True)
        for row, frame in zip(rows[:_TRIED].tolist(), first.tolist(), strict=False):
            try:
                self._decode(int(track.values[row, 0]))
            except DatasetError as error:
                reason = reason or error
            else:
                return int(frame)
        assert reason is not None
        raise reason

    def write(self, track: Track, times: Times, writer: EpisodeWriter) -> Times:
        """Add the image of each frame to an episode; return when they were taken [ns], shape (frames,).

        An image that cannot be decoded, as of a camera that was unplugged, is as if it had been lost: the one before
        is there in its place, and its age says so.

        Args:
            track: as in `blind`.
            times: of the frames [ns]; the first one has an image that can be decoded.
            writer: the episode.

        Raises:
            DatasetError: too many cannot be decoded.
        """
        rows = newest(track.times, times)
        total = len(np.unique(rows))
        image: NDArray[np.uint8] | None = None
        shown, broken, reason, before, good = rows.copy(), 0, "", -1, -1
        for frame, row in enumerate(rows.tolist()):
            if row != before:
                try:
                    image = self._decode(int(track.values[row, 0]))
                    good = row
                except DatasetError as error:
                    broken += 1
                    reason = reason or str(error)
                    if image is None or broken > max(1, MOST_LOST * total):
                        raise DatasetError(
                            f"{broken} of {total} images of an episode cannot be decoded, which is more than "
                            f"{MOST_LOST:.0%}: too many to go on without them. The first: {reason}"
                        ) from error
                before = row
            assert image is not None
            shown[frame] = good
            writer.add_image(f"{keys.OBSERVATION_IMAGES}.{self.name}", image)
        if broken:
            self._notes.append(
                f"{track.topic}: {broken} of {total} images of an episode cannot be decoded; the one before is there "
                f"in their place. The first: {reason}"
            )
        return track.times[shown]

    def _decode(self, place: int) -> NDArray[np.uint8]:
        return decode_image(self._track.topic, self._track.msgtype, self._images.get(place))
