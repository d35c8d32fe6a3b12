#!/usr/bin/env bash
# Records, replays, trains and evaluates two robots in a few minutes: `make demo`, or scripts/demo.sh FOLDER.
#
# A minute of training is too short for a good policy; the evaluation measures how good it is.
set -euo pipefail

out=${1:-outputs/demo/$(date +%Y-%m-%d_%H-%M-%S)}
if [ -e "$out" ] && [ -n "$(ls -A "$out" 2>&1)" ]; then
    echo "error: $out is not empty. Name another folder or none." >&2
    exit 2
fi
mkdir -p "$out"
cd "$out"
base=turtlebot3_avoid reach=ur5_reach pick=ur5_pick see=ur5_see  # a folder and a dataset for each

# Half of the task's usual time: more arenas in the same number of frames.
roaming=(--robot.type=turtlebot3 --task.type=avoid --task.duration_s=30)
# Coarser than the task's own 5 mm and 2°, for which the network would have to learn longer.
reaching=(--robot.type=ur5 --robot.action_space=tool --robot.tool_pose=true --task.type=reach --task.tolerance_m=0.03
    --task.tolerance_deg=10 --task.duration_s=6)
seeing=(--robot.type=ur5 --robot.camera=true --robot.camera_width=160 --robot.camera_height=120 --task.type=pick)

data() { echo "--dataset.repo_id=bhd/demo_$1" "--dataset.root=$1/dataset"; }
# Steps, not times, so that the same comes out on any day.
training() {
    echo "$(data "$1") --output_dir=$1/train" --dataset.eval_split=0.05 --policy.device=cpu --env_eval_freq=0 --seed=0
}

# shellcheck disable=SC2046  # these options have no spaces
main() {
    echo "1. Record: rules drive simulated robots, and every frame goes into a LeRobotDataset"
    bhd-record "${roaming[@]}" --brain.type=avoidance --seed=1 $(data $base) --dataset.num_episodes=128 --n_envs=32 \
        --output_dir=$base/record
    # Recorded episodes stay at the target for a second, so that there are frames to learn that from.
    bhd-record "${reaching[@]}" --task.hold_s=1.0 --brain.type=reach --seed=1 $(data $reach) \
        --dataset.num_episodes=480 --n_envs=32 --preview_video=false --output_dir=$reach/record
    bhd-record --robot.type=ur5 --task.type=pick --task.language=any --brain.type=language --seed=11 $(data $pick) \
        --dataset.num_episodes=6 --n_envs=6 --output_dir=$pick/record

    echo "2. Replay: a recorded episode of each robot again"
    bhd-replay --dataset.root=$base/dataset --output_dir=$base/replay
    bhd-replay --dataset.root=$pick/dataset --output_dir=$pick/replay

    echo "3. Train: a small network imitates each rule, from the dataset alone"
    # docs/reference/policies.md says what happens without --policy.ignore. A second thread gains little with so small a
    # network, and loses on a busy machine.
    bhd-train $(training $base) --policy.type=bhd_mlp --policy.chunk_size=1 --policy.hidden_dims='[256,256]' \
        --policy.scan.transform=inverse --policy.ignore="['*.vel']" --batch_size=256 --steps=3000 --log_freq=100 \
        --eval_steps=600 --save_freq=0 --threads=1
    bhd-train $(training $reach) --policy.type=bhd_mlp --policy.chunk_size=16 --policy.n_action_steps=8 \
        --policy.hidden_dims='[256,256,256]' --policy.activation=gelu --policy.optimizer_lr=2e-3 \
        --selection.outcome='[success]' --batch_size=256 --steps=1500 --log_freq=50 --eval_steps=300 --save_freq=300 \
        --threads=1

    echo "4. Evaluate: the network beside the rule, in scenes that it was not trained on"
    # Two videos of each brain would take too long; where there can be none, the report has the reason.
    videos=()
    if [ -e $base/record/episode.mp4 ]; then videos=(--videos=1); fi
    bhd-eval "${roaming[@]}" --brains.rule.type=avoidance --brains.learned.type=learned \
        --brains.learned.path=$base/train --brains.random.type=random --baseline=rule "${videos[@]}" --n_episodes=24 \
        --n_envs=24 --output_dir=$base/eval
    # `random` and `noop` drive joints, not tool poses.
    bhd-eval "${reaching[@]}" --brains.rule.type=reach --brains.learned.type=learned \
        --brains.learned.path=$reach/train --brains.early.type=learned \
        --brains.early.path=$reach/train/checkpoints/000300 --baseline=rule "${videos[@]}" --n_episodes=24 \
        --n_envs=24 --output_dir=$reach/eval

    echo "5. See: a network learns what a camera shows, and the arm picks up what it sees and a sentence names"
    if [ ${#videos[@]} = 0 ]; then
        echo "left out: images cannot be rendered here"
        return
    fi
    bhd-record "${seeing[@]}" --task.duration_s=0.04 --brain.type=noop --seed=3 $(data $see) \
        --dataset.num_episodes=600 --n_envs=32 --preview_video=false --output_dir=$see/record
    # So short a training has no room for sizes and shades that it is not shown: 96 of 120 picks, and 84 with both.
    bhd-train $(training $see) --policy.type=bhd_perception --policy.optimizer_lr=3e-3 \
        --policy.scheduler_warmup_steps=50 --policy.zoom=0 --policy.tint=0 --batch_size=16 --steps=600 --log_freq=20 \
        --eval_steps=120 --save_freq=0
    bhd-eval "${seeing[@]}" --task.language=any --brains.rule.type=language --brains.seeing.type=language \
        --brains.seeing.perception.path=$see/train --baseline=rule "${videos[@]}" --n_episodes=12 --n_envs=12 \
        --output_dir=$see/eval
}

main
echo "Done in $SECONDS s. Training in full: configs/train/, docs/how_to/training.md. Reports, for a browser:"
ls "$PWD"/*/eval/report.html
