"""The pictures of a robot's camera, out of its bag into an episode."""

import numpy as np
from numpy.typing import NDArray

from bhd_lerobot.data import features as keys
from bhd_lerobot.data.bag_images import decode_image
from bhd_lerobot.data.bag_read import Bag, Picker
from bhd_lerobot.data.bag_sound import MOST
from bhd_lerobot.data.bag_tracks import Track
from bhd_lerobot.data.episode import EpisodeWriter
from bhd_lerobot.data.resample import Times, newest
from bhd_lerobot.errors import DatasetError

CAMERA = "camera/"
"""What the role of a camera's track begins with; its name follows."""

_TRIED = 10  # pictures at the beginning, of which one must be readable


class Film:
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
        self._pictures = Picker(bag, track.topic)

    def shape(self) -> tuple[int, int, int]:
        """Return the shape of its pictures.

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

    def write(self, track: Track, times: Times, writer: EpisodeWriter) -> Times:
        """Add the picture of each frame to an episode; return when they were taken [ns], shape (frames,).

        A picture that cannot be decoded, as of a camera that was unplugged, is as if it had been lost: the one before
        is there in its place, and its age says so.

        Args:
            track: the camera's messages in the stretch in which the episode lies, sorted by time.
            times: of the frames [ns].
            writer: the episode.

        Raises:
            DatasetError: the first one cannot be decoded, or too many cannot.
        """
        rows = newest(track.times, times)
        image: NDArray[np.uint8] | None = None
        shown, broken, reason, before = rows.copy(), set[int](), "", -1
        for frame, row in enumerate(rows.tolist()):
            if row != before:
                try:
                    image = self._decode(int(track.values[row, 0]))
                    good = row
                except DatasetError as error:
                    broken.add(row)
                    reason = reason or str(error)
                    if image is None or len(broken) > max(1, MOST * len(set(rows.tolist()))):
                        raise
                before = row
            assert image is not None
            shown[frame] = good
            writer.add_image(f"{keys.OBSERVATION_IMAGES}.{self.name}", image)
        if broken:
            self._notes.append(
                f"{track.topic}: {len(broken)} of {len(set(rows.tolist()))} pictures cannot be decoded; the one before "
                f"is there in their place. The first: {reason}"
            )
        return track.times[shown]

    def _decode(self, place: int) -> NDArray[np.uint8]:
        return decode_image(self._track.topic, self._track.msgtype, self._pictures.get(place))
