"""The recorder's process: drains the ring of a running robot into the log of its frames.

Started by `LiveLink` as ``python -m bhd_lerobot.realtime.recorder_process BLOCK``; it imports numpy and little else.
"""

import os
import signal
import sys
import time

from bhd_lerobot.errors import BhdError
from bhd_lerobot.realtime.block import LiveBlock, Phase, Word
from bhd_lerobot.realtime.frame_log import FrameCollector, FrameLog

_PAUSE_S = 0.002  # the ring holds seconds, but the brain waits for the frames


def main() -> int:
    """Run the process; its argument is the name of the block."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the brain's process decides when it is over
    try:
        block = LiveBlock.attach(sys.argv[1])
    except BhdError as error:
        print(error, file=sys.stderr)
        return 2
    about, parent, words = block.about, os.getppid(), block.words
    log = FrameLog(block.state_dtype, about["frames"], block.section("frames"))
    collector = FrameCollector(block.ring, log, about["control_hz"] // about["fps"])
    try:
        while os.getppid() == parent and not words[Word.END] and words[Word.PHASE] != Phase.ENDED:
            block.show_life(Word.RECORDER_ALIVE)
            collector.drain()
            words[Word.RECORDER_DROPS] = collector.drops
            time.sleep(_PAUSE_S)
        collector.drain()
    finally:
        words[Word.RECORDER_ALIVE] = 0  # it is not watched any more: it ended in order
        block.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
