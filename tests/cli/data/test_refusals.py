"""Whatever `bhd-data` refuses ends in a message and status 2, and changes nothing."""

import shlex
import shutil
from pathlib import Path

import pytest

from bhd_lerobot.cli.data import main
from tests.cases import each_case
from tests.datasets import support
from tests.ros2.bag.support import drive, write

IMPORT = "import bag --repo_id=t/t --root=x --task=Drive."

# A command in a folder with a dataset `d` of six episodes, an empty one, a bag, a file and a folder; and what is said.
REFUSALS = [
    ("view d --prt 0", "Did you mean '--port'?"),
    ("check a b", "unexpected argument: b"),
    ("check folder", "is not a LeRobot dataset"),
    ("repair", "name the dataset, in one way: its folder (ROOT or --root), or --repo_id"),
    ("repair d --repo_id t/t", "name the dataset, in one way"),
    ("repair d --root x", "name the dataset, in one way"),
    ("repair --root x --repo_id t/t", "name the dataset, in one way"),
    ("pull s3://bucket/data here", "unexpected argument: here. Name the folder to download to with --root=FOLDER."),
    ("merge d --output x", "at least two"),
    ("merge d none --output x", "does not exist"),
    ("merge d d/../d --output x", "more than once"),
    ("filter d --outcome sucess --output x", "Did you mean 'success'"),
    ("filter d --outcome stuck --output x", "No episode of"),
    ("filter none --outcome all --output x", "does not exist"),
    ("filter d --output x", "needs a selection of episodes: --episodes"),
    ("filter d --min_score 2 --output x", "0 to 1"),
    ("filter d --episodes 0-2,1 --output x", "Episode 1 is named twice"),
    ("filter d --episodes 0 --output d/new", "which must not change"),
    ("filter d --episodes 0 --output folder", "exists already"),
    ("filter empty --episodes 0 --output x", "empty has no episode"),
    ("delete d --episodes 9", "no episode 9"),
    ("delete d --episodes x", "names no episode"),
    ("delete d --episodes 5-1", "runs backwards; write 1-5"),
    ("delete d --episodes 0-99999999999", "at most 1000000"),
    ("split d --parts a=1 --output x", "Write a=1.0 for the share, a=1-1 for the episode"),
    ("split d --parts a=0.5 --shuffle_seed -1 --output x", "--shuffle_seed is -1; it must be at least 0"),
    ("split d --parts a=0.7,b=0.7 --output x", "at most 1 together"),
    ("split d --parts a=0.01 --output x", "would have no episode"),
    ("split d --parts note=0.5 --output folder", "exists already"),
    ("split d --parts a=0.5 --output file", "is a file"),
    ("split d --parts a=0-1;b=1 --output x", "'a' and to 'b'"),
    ("split d --parts a,b --output x", "not one name and its part"),
    ("split d --parts ../a=0.5 --output x", "not one name and its part"),
    ("split d --parts a=0.5,b=3 --output x", "at most 1 together"),
    ("split d --parts a=0.5,b=x --output x", "no number"),
    ("mark d --episodes 0", "Give a mark"),
    ("mark d --episodes 0 --outcome good", "Unknown outcome 'good'"),
    ("mark d --episodes 0 --intervention 3..5", "FIRST-LAST"),
    ("mark d --episodes 0 --intervention 3-5", "not frames of episode 0; valid: 0 to 4"),
    ("info none", "does not exist"),
    ("timing d", "Its content is in `bhd-data info`"),
    ("info file", "file is not a LeRobot dataset"),
    ("info folder", "has no meta/info.json"),
    ("export d --output=x --episodes=7", "no episode 7 in"),
    ("export d --output=x --episodes=3-1", "runs backwards; write 1-3"),
    ("export d --output=x --episodes=a", "such as 0,3,5-9"),
    ("export d --output=x --start_time=-1", "--start_time is -1"),
    ("export d --output=x --start_time=nan", "--start_time is nan"),
    ("export d --output=d/bags", "which must not change"),
    ("export d --output=folder", "exists already"),
    ("export none --output=x", "none"),
    (f"{IMPORT} --robot=ur5", "Unknown robot 'ur5'"),
    (f"{IMPORT} --fps=0", "--fps is 0"),
    (f"{IMPORT} --beams=7", "it must divide 360"),
    (f"{IMPORT} --stamps=mine", "Unknown stamps 'mine'"),
    (f"{IMPORT} --outcome=winning", "Unknown outcome 'winning'"),
    (f"{IMPORT} --max_gap=0.1", "--max_gap is 0.1"),
    (f"{IMPORT} --max_gap=nan", "--max_gap is nan"),
    (f"{IMPORT} --max_age=-1", "--max_age is -1"),
    (f"{IMPORT} --command_timeout=0", "--command_timeout is 0"),
    (f"{IMPORT} --min_episode_s=inf", "--min_episode_s is inf"),
    (f"{IMPORT} --min_episode_s=100", "No episode of 100 s or more"),
    (f"{IMPORT} --camera=front", "NAME=TOPIC"),
    (f"{IMPORT} --camera=front=/nothing", "no topic /nothing"),
    (f"{IMPORT} --scan_yaw=nan", "--scan_yaw is nan"),
    (f"{IMPORT} --task=", "Describe the robot's task"),
    ("push", "Give the target"),
    ("push d", "Give the target"),
    ("push d me", "neither a name on the Hub"),
    ("push d me/a..b", "neither a name on the Hub"),
    ("push d me/a me/b", "Unexpected argument: me/b"),
    ("push d s3://b/d --tag=x", "is a URL"),
    ("push d me/a --storage_options={}", "is for URLs"),
    ("push d memory://b/d --storage_options=[1]", "give a JSON object"),
    ("push d memory://b/d --storage_options={", "is not JSON"),
    ("push memory://b/d", "Name the folder"),
    ("push none me/a", "does not exist"),
    ("push '' me/a", "A name is empty"),
    ("push d me/a --tag=", "--tag is empty"),
    ("push a\0b me/a", "cannot be the folder"),
    ("push ~nobodyatall/d me/a", "cannot be the folder"),
    ("push d foo://b/d", "Protocol not known: foo. Known protocols: "),
    ("push d ftp://", "names no folder"),
    ("push d s3://", "s3:// cannot hold a dataset: it names no folder"),
    ("push d s3:///d", "names no bucket"),
    ("push d file://", "names no folder"),
    ("push d ://b/d", "names no protocol"),
    ("push d http://127.0.0.1/d", "cannot be written, listed and read"),
    ("push d zip://d.zip", "cannot hold a dataset"),
    ("push d simplecache::s3://bucket/d", "a chain"),
    ("push d 'memory://b/a\0b'", "characters that are not valid in a URL"),
    ("push d 'memory://b/a\nb'", "characters that are not valid in a URL"),
    ("pull", "Give one source"),
    ("pull me/a --repo_id=me/b", "Give one source"),
    ("pull memory://b/d", "Give the target"),
    ("pull memory://b/d --root=x --revision=main", "has no revisions"),
    ("pull me/a --root=x --episodes=all", "such as 0,3,5-9"),
    ("pull me/a --root=x --outcome=good", "Unknown outcome 'good'"),
    ("pull me/a --root=x --min_score=2", "from 0 to 1"),
    ("pull me/a --root=", "--root is empty"),
    ("pull ''", "A name is empty"),
    ("pull me/a --root=a\0b", "cannot be the folder"),
    (f"pull me/a --root={'x' * 5000}", "File name too long"),
    ("pull memory://b/d --root=x --episodes=1", "only whole datasets"),
]


@pytest.fixture(scope="module")
def folder(six_episodes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("refusals")
    shutil.copytree(six_episodes, folder / "d")
    support.create(folder / "empty").finalize()
    write(folder / "bag", drive())
    (folder / "file").write_text("not a dataset")
    (folder / "folder").mkdir()
    (folder / "folder/note").write_text("mine")
    return folder


def status_of(arguments: list[str]) -> object:
    try:
        return main.main(arguments)
    except SystemExit as ended:
        return ended.code


@pytest.mark.usefixtures("hub")
@each_case(("line", "message"), REFUSALS)
def test_what_is_refused_is_named_and_nothing_is_changed(folder, monkeypatch, capsys, line, message):
    monkeypatch.chdir(folder)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert status_of(shlex.split(line)) == 2
    error = capsys.readouterr().err
    assert message in error
    assert "\0" not in error
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
