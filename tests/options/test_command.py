import errno
import logging
import os
import sys
from pathlib import Path

import pytest

from bhd_lerobot.options.command import exit_status
from tests.cases import each_case


def test_no_command_prints_that_torchcodec_finds_no_ffmpeg() -> None:
    logger = logging.getLogger("lerobot.utils.import_utils")
    logger.setLevel(logging.NOTSET)
    assert exit_status(lambda: int(logger.isEnabledFor(logging.WARNING))) == 0
    assert exit_status(lambda: int(not logger.isEnabledFor(logging.ERROR))) == 0


@each_case(
    ("number", "where", "message"),
    [
        (errno.EACCES, ["a"], "error: Permission denied: a. Check the permissions of this path.\n"),
        (errno.ENOSPC, ["a"], "error: No space left on device: a. Make room there, or name another folder.\n"),
        (errno.ENOSPC, [], "error: No space left on device. Make room there, or name another folder.\n"),
        (errno.EROFS, ["a", None, "b"], "error: Read-only file system: b. The file system is mounted read-only"),
    ],
)
def test_what_a_disk_refuses_is_a_message_and_status_2(capsys, number, where, message):
    def program() -> None:
        raise OSError(number, os.strerror(number), *where)

    assert exit_status(program) == 2
    assert capsys.readouterr().err.startswith(message)


def test_a_folder_of_nobody_is_a_message_and_other_errors_keep_their_traceback(capsys):
    assert exit_status(lambda: Path("~nobodyatall/data").expanduser().exists()) == 2
    assert "A path begins with ~ and the name of no user" in capsys.readouterr().err
    with pytest.raises(FileNotFoundError):
        exit_status(lambda: Path("there/is/none").stat().st_size)


def test_a_full_disk_behind_standard_output_is_a_message_and_status_2(monkeypatch, capsys):
    with open("/dev/full", "w") as output:
        monkeypatch.setattr(sys, "stdout", output)
        assert exit_status(lambda: print("text")) == 2
        output.flush()  # as Python does when it ends
    assert "No space left on device. Make room there" in capsys.readouterr().err
