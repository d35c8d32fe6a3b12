"""The documents are true: generated parts are up to date, links and files exist, commands parse, messages are real."""

import ast
import contextlib
import io
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

import bhd_lerobot.plugin  # noqa: F401  registers our policies
from bhd_lerobot.apps.doctor.robot import RobotDescription
from bhd_lerobot.cli import doctor, evaluate, monitor, ros2
from bhd_lerobot.cli.data import main
from bhd_lerobot.cli.train import algorithm_of
from bhd_lerobot.datasets.format.summary import dataset_info
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.options.parse import CommandLine, parse, read_line
from bhd_lerobot.recording.config import RecordConfig
from bhd_lerobot.recording.record import record
from bhd_lerobot.rollout.replay.config import ReplayConfig
from bhd_lerobot.ros2.serve.config import BridgeConfig, ServeConfig
from bhd_lerobot.training.arguments import parse_train
from bhd_lerobot.training.dagger.config import parse_aggregation, read_stages
from bhd_lerobot.training.rl.config import parse_rl
from tests.cases import each_case
from tests.docs.support import ROOT, load_script

DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "CHANGELOG.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]
CONFIGURATIONS = sorted((ROOT / "configs").rglob("*.yaml"))
TESTS = {
    name for path in (ROOT / "tests").rglob("*.py") for name in re.findall(r"def (test_\w+)", path.read_text("utf-8"))
}
FOLDERS = ("benchmarks", "bhd_lerobot", "configs", "docs", "scripts", "tests")


def by_name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def test_the_reference_is_up_to_date() -> None:
    pages = load_script("make_reference").pages()
    folder = ROOT / "docs" / "reference"
    files = folder / "options.md", folder / "record.md", *(folder / "options").iterdir()
    written = {path: path.read_text(encoding="utf-8") for path in files}
    assert written == pages, "run: python scripts/make_reference.py"
    assert sum(len(text.splitlines()) for text in pages.values()) <= 1320


def test_an_option_without_a_description_is_found() -> None:
    script = load_script("make_reference")

    @dataclass
    class Undocumented:
        """It has a docstring, and the docstring describes nothing."""

        mode: str = "both"

    with pytest.raises(SystemExit, match="does not describe 'mode'"):
        list(script._options(Undocumented, "", "page.md", {}))


def without_code(text: str) -> str:
    return re.sub(r"```.*?```", "", text, flags=re.DOTALL)


def anchors(text: str) -> set[str]:
    """Return the anchors of a document's headings, as the usual renderers make them."""
    headings = re.findall(r"^#+ (.*)$", without_code(text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def broken_references(document: Path) -> list[str]:
    """Return every relative link, image, and name of a file or a test in a document that leads nowhere."""
    text = document.read_text(encoding="utf-8")
    prose = without_code(text)
    broken = []
    targets = re.findall(r"\]\(([^)\s]+)\)", prose) + re.findall(r"(?:src|href)=\"([^\"]+)\"", prose)
    for target in targets:
        if re.match(r"[a-z]+:", target):
            continue
        name, _, anchor = target.partition("#")
        path = (document.parent / name).resolve() if name else document
        if not path.exists() or (anchor and anchor not in anchors(path.read_text(encoding="utf-8"))):
            broken.append(target)
    for name in re.findall(r"`([\w./-]+)`", prose):
        if name.startswith(tuple(f"{folder}/" for folder in FOLDERS)) and not (ROOT / name).exists():
            broken.append(name)
    broken += [name for name in re.findall(r"`(test_\w+)`", prose) if name not in TESTS]
    targets_of_make = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    calls = re.findall(r"`make ([a-z-]+)( --)?", prose) + re.findall(r"^make ([a-z-]+)( --)?", text, re.MULTILINE)
    # Options behind a target are options of make.
    broken += [f"make {name}{option}" for name, option in calls if option or name not in targets_of_make]
    return broken


def test_every_link_and_every_file_exists() -> None:
    assert [(by_name(path), target) for path in DOCUMENTS for target in broken_references(path)] == []


@each_case(
    "planted",
    [
        "[x](no.md)",
        "[x](README.md#no-such-heading)",
        '<img src="no.png">',
        "`docs/no.md`",
        "`test_of_nothing`",
        "`make nothing`",
        "`make results --only see`",
    ],
)
def test_a_planted_broken_reference_is_found(tmp_path: Path, planted: str) -> None:
    (tmp_path / "README.md").write_text("# Heading\n")
    document = tmp_path / "notes.md"
    document.write_text(f"{planted}\n[fine](README.md#heading) `docs/reference/options.md`\n")
    assert len(broken_references(document)) == 1


def quoted_commands(path: Path) -> Iterator[str]:
    """Yield every command line of ours in a document's code blocks and code spans, or in a file's comments."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".yaml":
        comments = "\n".join(line.lstrip("# ") for line in text.splitlines() if line.startswith("#"))
        lines = comments.replace("\\\n", " ").splitlines()
    else:
        fences = re.findall(r"^```(\w*)\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
        blocks = "\n".join(block for language, block in fences if language in ("", "bash", "sh", "text"))
        lines = blocks.replace("\\\n", " ").splitlines()
        lines += [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", without_code(text)) if " " in span]
    variables = dict(re.findall(r'^([A-Z]+)="(.*)"$', text, re.MULTILINE))
    lines = [re.sub(r"\$([A-Z]+)", lambda found: variables.get(found[1], found[0]), line) for line in lines]
    # "…" stands for the options of an earlier command.
    yield from (line for line in lines if re.match(r"bhd-\w+ ", line) and "…" not in line)


def parse_command(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Parse a command line as its program would, and run nothing."""
    monkeypatch.chdir(ROOT)
    own = ROOT / "bhd_lerobot" / "bodies" / "so101.xml"  # for the one that is downloaded
    program, *arguments = shlex.split(text.replace("mjcf=robot.xml", f"mjcf={own}"), comments=True)
    if "--help" in arguments:
        return
    if program == "bhd-train":
        parse_training(read_line(arguments, "train"))
    elif program == "bhd-eval":
        chosen = evaluate.program_of(line := read_line(arguments, "eval"))
        (chosen.read or partial(parse, chosen.config_class))(line)
    elif program == "bhd-record":
        parse(RecordConfig, read_line(arguments, "record"))
    elif program == "bhd-replay":
        parse(ReplayConfig, arguments)
    elif program == "bhd-ros2" and arguments[:1] == ["serve"]:
        parse(ServeConfig, arguments[1:] or ["--robot.type=turtlebot3"])
    elif program == "bhd-ros2" and arguments[:1] == ["bridge"]:
        parse(BridgeConfig, arguments[1:] or ["--robot.type=turtlebot3", "--robot.plant=ros2"])
    elif program in ("bhd-data", "bhd-ros2"):
        # In running text a command is named without its arguments.
        named = ["--help"] if len(arguments) == 1 else []
        with contextlib.redirect_stdout(io.StringIO()):
            try:
                (main if program == "bhd-data" else ros2)._parser().parse_args([*arguments, *named])
            except SystemExit as end:
                if end.code:
                    raise
    elif program in ("bhd-monitor", "bhd-doctor"):
        about_robot = any(one.startswith("--robot.") for one in arguments)
        own_parser = (monitor if program == "bhd-monitor" else doctor)._parser()
        _ = parse(RobotDescription, arguments) if about_robot else own_parser.parse_args(arguments)
    else:
        raise AssertionError(f"Unknown program {program}.")


def parse_training(line: CommandLine) -> None:
    """Parse the arguments of `bhd-train`; checkpoints of earlier commands need not be there."""
    algorithm = algorithm_of(line)
    if algorithm == "dagger":
        read_stages(parse_aggregation(line))
        return
    if algorithm is not None:
        parse_rl(line)
        return
    try:
        parse_train(line)
    except ConfigError as error:
        if not re.search("outputs/(train|results)/", str(error)):
            raise


def test_every_quoted_command_parses(monkeypatch: pytest.MonkeyPatch) -> None:
    programs, wrong = set(), []
    quoted = {line: path for path in [*DOCUMENTS, *CONFIGURATIONS] for line in quoted_commands(path)}
    for line, path in quoted.items():
        programs.add(line.split()[0])
        try:
            parse_command(line, monkeypatch)
        except (Exception, SystemExit) as error:
            wrong.append(f"{by_name(path)}: {line}: {error}")
    assert wrong == []
    assert programs == {
        f"bhd-{name}" for name in ("record", "replay", "data", "doctor", "monitor", "train", "eval", "ros2")
    }


def test_a_wrong_command_does_not_parse(monkeypatch: pytest.MonkeyPatch) -> None:
    for line in (
        *("bhd-record --seed=1", "bhd-replay --mode=sideways", "bhd-data inform x", "bhd-fly x"),
        *("bhd-train --policy.type=none", "bhd-eval --robot.type=ur5"),
    ):
        with pytest.raises((Exception, SystemExit)):
            parse_command(line, monkeypatch)


def texts_in_code() -> str:
    """Return every piece of text in the package's code; what stands between two pieces of a message is not one."""
    pieces = []
    for path in sorted((ROOT / "bhd_lerobot").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                pieces.append(node.value)
    return "\0".join(pieces)


def quoted_messages() -> list[str]:
    """Return the messages of the tables in troubleshooting.md whose first column is headed "message"."""
    text = (ROOT / "docs" / "how_to" / "troubleshooting.md").read_text(encoding="utf-8")
    tables = re.findall(r"^\| message \|.*\n((?:\|.*\n)+)", text, re.MULTILINE)
    rows = [line for table in tables for line in table.splitlines() if not line.startswith("|---")]
    return [re.split(r"(?<!\\)\|", row)[1].strip().strip("`") for row in rows]


def test_every_quoted_message_is_in_the_code() -> None:
    code, messages = texts_in_code(), quoted_messages()
    assert len(messages) > 20
    # "…" stands for a value.
    unknown = [
        (m, part) for m in messages for part in re.split("…", m) if part.strip(" .") and part.strip() not in code
    ]
    assert unknown == []


def test_every_column_is_described(tmp_path: Path) -> None:
    arguments = ["--robot.type=turtlebot3", "--robot.odometry=true", "--robot.imu=true", "--brain.type=avoidance"]
    arguments += ["--task.type=avoid", "--dataset.repo_id=bhd/test", f"--dataset.root={tmp_path / 'data'}"]
    arguments += ["--dataset.num_episodes=1", "--dataset.episode_time_s=0.5", "--preview_video=false"]
    record(parse(RecordConfig, [*arguments, f"--output_dir={tmp_path}"]))
    summary = dataset_info(tmp_path / "data")
    text = (ROOT / "docs" / "reference" / "dataset.md").read_text(encoding="utf-8")
    wanted = [f"`{key}`" for key in summary.features] + [f"`bhd/{key}`" for key in summary.episodes[0].metadata]
    assert [key for key in wanted if key not in text] == []
    robots = (ROOT / "docs" / "reference" / "robots.md").read_text(encoding="utf-8")
    names = [name for name in summary.features["observation.state"]["names"] if not name.startswith("scan_")]
    assert [name for name in names if f"`{name}`" not in robots] == []
