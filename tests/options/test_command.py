import logging

from bhd_lerobot.options.command import exit_status


def test_no_command_prints_that_torchcodec_finds_no_ffmpeg() -> None:
    logger = logging.getLogger("lerobot.utils.import_utils")
    logger.setLevel(logging.NOTSET)
    assert exit_status(lambda: int(logger.isEnabledFor(logging.WARNING))) == 0
    assert exit_status(lambda: int(not logger.isEnabledFor(logging.ERROR))) == 0
