"""The sections about speed, and about the rule of the navigate task: benchmarks of this folder, run as they are."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from benchmarks._turns import GOAL_MISSED
from benchmarks.results.runner import Runner
from benchmarks.results.section import Row, Section, mean, rate

_BARE = "Batch.step and lidar alone"
_PEERS = ("SyncVectorEnv", "AsyncVectorEnv")


def benchmark(
    module: str, rows: Callable[[Any], list[Row]], *options: str, short: Sequence[str] = ()
) -> Callable[[Runner, Section], None]:
    """Return what runs a benchmark that writes JSON.

    Args:
        module: name of the benchmark.
        rows: makes rows of what it wrote.
        options: of its command line.
        short: options for a short run, after those.
    """

    def measure(run: Runner, section: Section) -> None:
        output = run.path("speed", f"{module}.json")
        command = ["python", "-m", f"benchmarks.{module}", *options, *(short if run.is_short else ())]
        run.run(f"speed_{module}", [*command, f"--json={output}"], allowed=(0, GOAL_MISSED))
        section.rows += rows(run.read("speed", f"{module}.json"))

    return measure


def speed(run: Runner, section: Section) -> None:
    """Loader, environments and evaluation, each beside its peers in one run."""
    for measure in (
        benchmark("loader", loader_rows, short=("--episodes", "20", "4", "--repeats=1", "--seconds=0.5", "--no-start")),
        benchmark(
            "images",
            images_rows,
            short=("--policies=bhd_perception", "--episodes=4", "--steps=10", "--turns=1", "--whole"),
        ),
        benchmark("sight", sight_rows, short=("--rounds=1", "--seconds=2")),
        benchmark("envs", envs_rows, short=("--n=4", "--repeats=1", "--seconds=0.5", "--limit=120")),
        benchmark("evaluate", evaluate_rows, short=("--demonstrations=8", "--episodes=4", "--n_envs=4", "--turns=1")),
    ):
        measure(run, section)
    section.remarks.append(
        "Medians over turns, in which all of a row are measured one after the other, with the least and the largest in "
        "brackets; a ratio is taken within a turn."
    )


def navigate(run: Runner, section: Section) -> None:
    """The rule of the navigate task, on scenes that it was not tuned on."""
    options = ("--seed=2", "--episodes=500")
    benchmark("navigate", navigate_rows, *options, short=("--episodes=10",))(run, section)


def loader_rows(results: Mapping[str, Any]) -> list[Row]:
    """Return the rows of `benchmarks.loader`."""
    names = {"state": "loader, state data, chunks of 50 steps", "cameras": "loader, two cameras of 96 x 96 pixels"}
    rows = []
    for case, what in names.items():
        if case not in results:
            rows.append(Row(what, "not measured: its dataset could not be recorded", "", met=False))
            continue
        one = results[case]
        speeds = ", ".join(f"{name} {speed['median']:,.0f}" for name, speed in one["samples_per_s"].items())
        rows += [
            Row(f"{what}: samples/s", speeds),
            Row(f"{what}: ours / LeRobot's better", times(one["ratio"]), f"at least {one['goal']:.0f} x", one["met"]),
        ]
    return rows


def images_rows(results: Mapping[str, Any]) -> list[Row]:
    """Return the rows of `benchmarks.images`."""
    rows = []
    for policy, learned in results["training"].items():
        for part, what in (("whole", f"a run of {learned['steps']} steps"), ("steps", "its steps alone")):
            if f"{part}: ratio" not in learned:  # `--whole`
                continue
            speeds = ", ".join(
                f"{name} {learned[f'{part}: {name}']['median']:.1f}" for name in ("bhd-train", "lerobot-train")
            )
            ratio, name = learned[f"{part}: ratio"], f"learning {policy} from images, {what}"
            goal = "at least 5 x" if part == "whole" else ""
            met = ratio["median"] >= 5 if part == "whole" else None
            rows += [
                Row(f"{name}: samples per CPU second", speeds),
                Row(f"{name}: bhd-train / lerobot-train", times(ratio), goal, met),
            ]
    if "rendering" in results:
        ratio = results["rendering"]["ratio"]
        what = "two cameras of 96 x 96: images a second, over MuJoCo's own renderer"
        rows.append(Row(what, times(ratio, 2), "at least 0.8 x", ratio["median"] >= 0.8))
    return rows


def sight_rows(results: Mapping[str, Any]) -> list[Row]:
    """Return the rows of `benchmarks.sight`."""
    quiet = {row["core"]: row for row in results["rows"] if "ratios" not in row}
    rows = []
    for row in (one for one in results["rows"] if "ratios" in one):
        alone, over = quiet[row["core"]], row["ratios"]
        what = f"UR5 at 500 Hz beside {row['brain']} at 25 Hz, cerebellum on {row['core']}"
        share = f"{row['late_share']:.2%}, beside noop {alone['late_share']:.2%}"
        stops = f"; stopped and run again {row['stops']}, beside noop {alone['stops']}" if row["stops"] else ""
        rows += [
            Row(
                f"{what}: lateness of ticks p99, over that beside noop",
                f"{over['wake_p99']:.2f} x ({row['wake_p99']:.0f} us)",
                f"at most {results['goals']['wake_p99']:g} x",
                over["wake_p99"] <= results["goals"]["wake_p99"],
            ),
            Row(
                f"{what}: ticks later than 0.1 ms",
                f"{share}; missed {row['missed']}, beside noop {alone['missed']}{stops}",
                f"at most {results['goals']['late_share']:.1%} more",
                row["late_share_excess"] <= results["goals"]["late_share"] and row["stops"] <= alone["stops"],
            ),
            Row(
                f"{what}: frames/s",
                f"{row['frames_per_s']:.2f}, beside noop {alone['frames_per_s']:.2f}; {row['cpu_ms']:.1f} CPU ms each",
                f"at least {results['goals']['frames_per_s']:.0%} of 25",
                row["frames_per_s"] >= results["goals"]["frames_per_s"] * 25,
            ),
        ]
    return rows


def envs_rows(results: Mapping[str, Any]) -> list[Row]:
    """Return the rows of `benchmarks.envs`."""
    what, over = f"{results['n']} avoid environments", results["ours_is"]
    speeds = ", ".join(f"{name} {speed['median']:,.0f}" for name, speed in results["steps_per_s"].items())
    rows = [
        Row(f"{what}: steps/s", speeds),
        Row(
            f"{what}: VectorEnv / bare physics with the same lidar",
            times(over[_BARE], 2),
            f"at least {results['goal']:.2f} x",
            results["met"],
        ),
    ]
    for peer in _PEERS:
        reason = results["not_measured"].get(peer, "it was left out")
        value = times(over[peer]) if peer in over else f"not measured: {reason}"
        rows.append(Row(f"{what}: VectorEnv / Gymnasium's {peer}", value))
    return rows


def evaluate_rows(results: Mapping[str, Any]) -> list[Row]:
    """Return the rows of `benchmarks.evaluate`."""
    what = f"{results['episodes']} {results['task']} episodes of {results['policy']}, {results['n_envs']} side by side"
    speeds = ", ".join(f"{name} {speed['median']:.2f}" for name, speed in results["episodes_per_s"].items())
    return [
        Row(f"{what}: episodes/s", speeds),
        Row(
            f"{what}: bhd-eval / lerobot-eval on SyncVectorEnv",
            times(results["ratio"]),
            f"at least {results['goal']:.0f} x",
            results["met"],
        ),
        Row(
            f"{what}: ended the same with both",
            f"{results['same_success']} of {results['compared']}; returns differ by at most "
            f"{results['largest_return_difference']:.2g}",
        ),
    ]


def navigate_rows(results: Mapping[str, Any]) -> list[Row]:
    """Return the rows of `benchmarks.navigate`."""
    success, spl, collisions = results["success"], results["spl"], results["collisions"]
    return [
        Row(
            f"navigator: success in {results['episodes']}",
            rate(success, results["ends"]),
            f"at least {success['goal']:.0%}",
            success["met"],
        ),
        Row("navigator: collisions", str(collisions["value"]), f"at most {collisions['goal']}", collisions["met"]),
        Row("navigator: success weighted by path length, mean", mean(spl), f"above {spl['goal']:.2f}", spl["met"]),
    ]


def times(ratio: Mapping[str, float], digits: int = 1) -> str:
    """Return a ratio with its spread."""
    return f"{ratio['median']:.{digits}f} x ({ratio['low']:.{digits}f} to {ratio['high']:.{digits}f})"
