#!/bin/sh
# In LeRobot, a robot that is asked for as so101_follower says that it is an so100_follower.
#
# Versions: lerobot 0.6.1; Python 3.12, Linux, x86-64.
#
# so100_follower and so101_follower are two names of one configuration class, as are so100_leader and so101_leader. Its
# property `type` looks for the class among the names and returns the first, so the type that was asked for is lost when a
# command line is parsed: a configuration file that is saved from it names an SO-100. The robot's own name, which
# lerobot-record writes into a dataset and which chooses the folder of calibrations, is a third one, so_follower. So an
# SO-100 and an SO-101 with the same id share one calibration file.
#
# Expected: `type` and the saved configuration name the robot that was asked for.
#
# Output seen:
#   lerobot 0.6.1
#   asked for so100_follower: type so100_follower, saved so100_follower, recorded so_follower, calibration so_follower/arm.json
#   asked for so101_follower: type so100_follower, saved so100_follower, recorded so_follower, calibration so_follower/arm.json
#
# Exit status: 0 if it behaves like this, 1 if it does not any more.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
"${PYTHON:-python3}" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check "lerobot[dataset,feetech]==0.6.1"
export HF_HUB_OFFLINE=1 HF_HOME="$folder/home" HF_LEROBOT_HOME="$folder/home/lerobot"
cd "$folder"
"$folder/venv/bin/python" - <<'PY' 2>messages || { cat messages >&2; exit 1; }
import sys
from dataclasses import dataclass
from importlib.metadata import version

import draccus
import lerobot.robots.so_follower  # registers the arms
from lerobot.robots import RobotConfig, make_robot_from_config


@dataclass
class Program:
    robot: RobotConfig


print(f"lerobot {version('lerobot')}")
found = []
for asked in ("so100_follower", "so101_follower"):
    config = draccus.parse(Program, args=[f"--robot.type={asked}", "--robot.port=/dev/null", "--robot.id=arm"]).robot
    saved = draccus.encode(Program(config))["robot"]["type"]
    robot = make_robot_from_config(config)
    place = "/".join(robot.calibration_fpath.parts[-2:])
    print(f"asked for {asked}: type {config.type}, saved {saved}, recorded {robot.name}, calibration {place}")
    found.append((config.type, saved, robot.name, place))
sys.exit(found != [("so100_follower", "so100_follower", "so_follower", "so_follower/arm.json")] * 2)
PY
