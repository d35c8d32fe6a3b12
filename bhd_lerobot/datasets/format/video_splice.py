"""Parts of videos into one video, without encoding again.

Every episode was encoded by itself before videos were joined, by LeRobot as by us. So each begins with a key frame, and
the packets of one can be taken out without touching those of another.
"""

from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

from bhd_lerobot.errors import DatasetCorruptError, UnsupportedDatasetError

type Span = tuple[int, int]
"""First frame of a part in its file, and the number of its frames."""


def splice(parts: Sequence[tuple[Path, Sequence[Span]]], target: Path, fps: int | Fraction) -> None:
    """Write spans of frames of several videos, one after the other, into one video.

    Args:
        parts: a file and its spans, in the order of the new video. All files have the same `stream_signature`.
    """
    import av

    written, last = 0, None
    with av.open(str(target), "w", format="mp4", options={"movflags": "faststart"}) as output:
        joined: Any = None
        for path, spans in parts:
            with _opened(path) as source:
                stream: Any = source.streams.video[0]
                if joined is None:
                    joined = output.add_stream_from_template(stream, opaque=True)
                    joined.time_base = stream.time_base
                for (start, _), packets in zip(spans, _by_span(path, source, spans, fps), strict=True):
                    # Counted in frames from the new video's start, so no rounding adds up.
                    shift = round(Fraction(written - start) / Fraction(fps) / stream.time_base)
                    for packet in packets:
                        packet.pts, packet.dts = packet.pts + shift, packet.dts + shift
                        if last is not None and packet.dts <= last:
                            # Videos with frames out of order begin before zero in decoding order.
                            packet.dts = last + 1
                        last = packet.dts
                        packet.stream = joined
                        output.mux(packet)
                    written += len(packets)


def _opened(path: Path) -> Any:
    import av

    try:
        return av.open(str(path))
    except (av.error.FFmpegError, OSError) as error:
        raise DatasetCorruptError(f"{path} is not a readable video ({error}). Restore it from a copy.") from error


def _by_span(path: Path, source: Any, spans: Sequence[Span], fps: int | Fraction) -> list[list[Any]]:
    """Return the packets of each span in decoding order, with the data that they need."""
    import av

    stream = source.streams.video[0]
    owner = {frame: place for place, (start, length) in enumerate(spans) for frame in range(start, start + length)}
    found: list[list[Any]] = [[] for _ in spans]
    try:
        for frame, packet in _frames(source, stream, fps):
            place = owner.get(frame)
            if place is None:
                continue
            if not found[place] and not (packet.is_keyframe and frame == spans[place][0]):
                raise UnsupportedDatasetError(
                    f"{path}: frame {spans[place][0]}, with which an episode begins, is no key frame, so the episode "
                    "cannot be cut out without encoding again. Use lerobot-edit-dataset, which encodes again."
                )
            found[place].append(packet)
    except av.error.FFmpegError as error:
        raise DatasetCorruptError(f"{path} cannot be read to its end ({error}). Restore it from a copy.") from error
    for (start, length), packets in zip(spans, found, strict=True):
        if len(packets) != length:
            raise DatasetCorruptError(
                f"{path} has {len(packets)} of the {length} frames from {start} on. Run `bhd-data check` on it, and "
                "restore it from a copy."
            )
    return found


def _frames(source: Any, stream: Any, fps: int | Fraction) -> Iterator[tuple[int, Any]]:
    """Yield the number and the packet of every frame."""
    begin = stream.start_time or 0
    for packet in source.demux(stream):
        if packet.dts is not None and packet.size:
            yield round(Fraction(packet.pts - begin) * stream.time_base * Fraction(fps)), packet
