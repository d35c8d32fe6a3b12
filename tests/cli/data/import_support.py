"""`bhd-data import` in tests."""

from bhd_lerobot.cli.data import main
from bhd_lerobot.datasets.format.summary import dataset_info

TASK = "--task=Drive around."


def run(source, root, *arguments):
    """Import and return the status."""
    return main.main(["import", str(source), "--repo_id=t/t", f"--root={root}", TASK, *arguments])


def imported(source, root, *arguments):
    """Import and return what is in the dataset."""
    assert run(source, root, *arguments) == 0
    return dataset_info(root)


def refused(source, root, capsys, *arguments):
    """Import, which must be refused; return what is said."""
    assert run(source, root, *arguments) == 2
    assert not root.exists()
    return capsys.readouterr().err
