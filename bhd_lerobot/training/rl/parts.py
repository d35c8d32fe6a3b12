"""What a run consists of before it learns: the actor, its processors, its contract."""

import copy
import dataclasses
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from numpy.typing import NDArray

from bhd_lerobot.datasets.format import features as keys
from bhd_lerobot.envs.spaces import action_bounds
from bhd_lerobot.envs.vector import BhdVectorEnv
from bhd_lerobot.errors import ConfigError
from bhd_lerobot.policies.learned.contract import PolicyContract, find_checkpoint
from bhd_lerobot.policies.learned.policy import load_policy
from bhd_lerobot.policies.mlp.configuration_mlp import MlpConfig
from bhd_lerobot.policies.mlp.modeling_mlp import MlpPolicy
from bhd_lerobot.policies.mlp.processor_mlp import make_bhd_mlp_pre_post_processors
from bhd_lerobot.rollout.provenance import versions
from bhd_lerobot.rollout.types import Episode
from bhd_lerobot.training.rl.config import RlConfig

Stats = dict[str, dict[str, torch.Tensor]]
Rows = dict[str, NDArray[np.float32]]
_KEYS = {"agent_pos": OBS_STATE, "environment_state": OBS_ENV_STATE}
_RANDOM_FRAMES = 50  # of each environment, when nothing else shows how large the observations are


@dataclass
class RlParts:
    """What is learned, and what it needs: `front` is the actor without convolutions; `fresh`: not initialised yet."""

    actor: MlpPolicy
    front: MlpPolicy
    before: Any
    after: Any
    contract: PolicyContract
    fresh: bool


def rows_of(observation: dict[str, Any]) -> Rows:
    """Return an environment's observation, by LeRobot's names, each of shape (n, width)."""
    return {key: observation[name] for name, key in _KEYS.items() if name in observation}


def make_parts(config: RlConfig, env: BhdVectorEnv, episodes: Sequence[Episode] = ()) -> RlParts:
    """Return the actor and what belongs to it."""
    simulation, task = env.episodes.simulation, env.episodes.task
    contract = PolicyContract(
        robot_type=config.robot.type,
        fps=simulation.rates.fps,
        observation_names=tuple(simulation.observation_names),
        action_names=tuple(simulation.action_names),
        environment_names=tuple(task.environment_names),
        cameras={},
        units="SI",
        task=task.parameters(),
        trainer="bhd-train, ppo",
        versions=versions(),
    )
    if config.resume:
        # With the normalisation that the run began with, whatever became of what it started from.
        return _from_checkpoint(str(config.output_dir), contract)
    if config.start_from is not None:
        steps = (config.policy.n_obs_steps, config.policy.obs_stride) if config.see_history else None
        return _from_checkpoint(config.start_from, contract, see_ignored=config.see_ignored, steps=steps)
    mlp = config.policy.actor()
    mlp.input_features = {OBS_STATE: PolicyFeature(FeatureType.STATE, (len(contract.observation_names or ()),))}
    if task.environment_names:
        mlp.input_features[OBS_ENV_STATE] = PolicyFeature(FeatureType.ENV, (len(task.environment_names),))
    mlp.output_features = {ACTION: PolicyFeature(FeatureType.ACTION, (len(simulation.action_names),))}
    mlp.set_dataset_feature_metadata({OBS_STATE: {"names": list(simulation.observation_names)}})
    mlp.validate_features()
    stats = _observed(episodes) if episodes else _random_run(env, config.seed)
    low, high = action_bounds(simulation.body, simulation.action_names)
    stats[ACTION] = {"mean": _tensor((low + high) / 2), "std": _tensor((high - low) / 2)}
    before, after = make_bhd_mlp_pre_post_processors(mlp, stats)
    torch.manual_seed(config.seed)
    return RlParts(MlpPolicy(mlp), _front(mlp), before, after, contract, fresh=True)


def _from_checkpoint(
    path: str, contract: PolicyContract, *, see_ignored: bool = False, steps: tuple[int, int] | None = None
) -> RlParts:
    folder = find_checkpoint(path)
    loaded = load_policy(folder)
    who = f"The policy {path!r}"
    if loaded.kind != "bhd_mlp":
        raise ConfigError(f"{who} is of the type {loaded.kind!r}; PPO starts from a 'bhd_mlp', or from scratch.")
    trained = PolicyContract.load(folder)
    inputs = loaded.config.input_features
    trained.check(
        contract.observation_names if OBS_STATE in inputs else None,
        contract.action_names,
        contract.fps,
        contract.environment_names if OBS_ENV_STATE in inputs else None,
        contract.robot_type,
        who=who,
    )
    for key, names in ((OBS_STATE, contract.observation_names), (ACTION, contract.action_names)):
        width = loaded.width(key)
        if width is not None and width != len(names or ()):
            raise ConfigError(f"{who} has {width} numbers in {key!r}; this robot has {len(names or ())}.")
    if loaded.config.residual:
        raise ConfigError(
            f"{who} predicts by how much actions differ from what is observed (policy.residual is "
            f"{list(loaded.config.residual)}); PPO learns the actions themselves. Train one without it."
        )
    if loaded.config.dropout:
        raise ConfigError(f"{who} has dropout {loaded.config.dropout}; PPO needs a policy without it.")
    if loaded.config.scan.channels and loaded.config.scan.transform == "none":
        raise ConfigError(f"{who} has policy.scan.channels without a transform; train it with inverse or log ranges.")
    if see_ignored and not loaded.config.ignored_columns:
        raise ConfigError(f"see_ignored is true, and {who[0].lower()}{who[1:]} ignores nothing. Leave it out.")
    if steps is not None and loaded.config.n_obs_steps > 1:
        raise ConfigError(
            f"see_history is true, and {who[0].lower()}{who[1:]} sees {loaded.config.n_obs_steps} observations "
            "already. Leave it out."
        )
    actor = single_action(seeing_more(loaded.policy, ignored=see_ignored, steps=steps))
    known = dataclasses.replace(contract, dataset=trained.dataset)
    return RlParts(actor, _front(actor.config), loaded.before, loaded.after, known, fresh=False)


def single_action(policy: MlpPolicy) -> MlpPolicy:
    """Return a Gaussian policy that predicts the first action of another's chunk, with the same weights."""
    old = policy.config
    values: dict[str, Any] = {
        "chunk_size": 1,
        "n_action_steps": 1,
        "gaussian": True,
        "loss": None,
        "sample": False,
        "device": "cpu",
    }
    config = dataclasses.replace(old, **values)
    config.scan = copy.deepcopy(old.scan)
    actor = MlpPolicy(config)
    size, modes = int(config.action_feature.shape[0]), old.modes
    state = dict(policy.state_dict())
    last = f"net.{len(policy.net) - 1}"
    rows = torch.arange(len(state[f"{last}.bias"]))
    chunks = modes * old.chunk_size * size
    first = rows[:chunks].reshape(modes, old.chunk_size * size)[:, :size].flatten()
    for name in ("weight", "bias"):
        state[f"{last}.{name}"] = state[f"{last}.{name}"][torch.cat([first, rows[chunks:]])]
    if "log_std" in state:
        state["log_std"] = state["log_std"][:1].clone()
    else:
        state["log_std"] = torch.zeros(1, size)
    actor.load_state_dict(state)
    return actor


def seeing_more(policy: MlpPolicy, *, ignored: bool = False, steps: tuple[int, int] | None = None) -> MlpPolicy:
    """Return a policy that does the same and sees more, with weights of 0.

    `ignored`: what the other ignores. `steps`: how many observations, and frames between them; the other sees one.
    """
    values: dict[str, Any] = {"ignore": [], "ignored_columns": []} if ignored else {}
    if steps is not None:
        values |= {"n_obs_steps": steps[0], "obs_stride": steps[1]}
    config = dataclasses.replace(policy.config, **values)
    config.scan = copy.deepcopy(policy.config.scan)
    wider = MlpPolicy(config)
    state = dict(policy.state_dict())
    old = state["net.0.weight"]
    state["net.0.weight"] = old.new_zeros(old.shape[0], wider.feature_size)
    state["net.0.weight"][:, policy.features_in(wider)] = old
    if policy.scan_encoder is not None:  # scans are its input channels, the present one the last
        name = "scan_encoder.layers.0.weight"
        kernels = torch.zeros_like(wider.state_dict()[name])
        kernels[:, -state[name].shape[1] :] = state[name]
        state[name] = kernels
    wider.load_state_dict(state)
    return wider


def _front(config: MlpConfig) -> MlpPolicy:
    small = dataclasses.replace(config, hidden_dims=[], scan=dataclasses.replace(config.scan, channels=[]))
    return MlpPolicy(small).eval()


def _observed(episodes: Sequence[Episode]) -> Stats:
    stats: Stats = {}
    for column, key in ((keys.OBSERVATION_STATE, OBS_STATE), (keys.ENVIRONMENT_STATE, OBS_ENV_STATE)):
        parts = [episode.columns[column] for episode in episodes if column in episode.columns]
        if parts:
            stats[key] = _scale(np.concatenate(parts))
    return stats


def _random_run(env: BhdVectorEnv, seed: int) -> Stats:
    """Return the scale of what is seen under random actions, each of which lasts a while."""
    rng = np.random.default_rng(seed)
    observation, _ = env.reset()
    low, high = action_bounds(env.episodes.simulation.body, env.episodes.simulation.action_names)
    seen: dict[str, list[NDArray[Any]]] = defaultdict(list)
    actions = rng.uniform(low, high, (env.num_envs, len(low))).astype(np.float32)
    for frame in range(_RANDOM_FRAMES):
        if frame % 10 == 0:
            actions = rng.uniform(low, high, (env.num_envs, len(low))).astype(np.float32)
        for key, rows in rows_of(observation).items():
            seen[key].append(rows)
        observation, _, terminated, truncated, _ = env.step(actions)
        done = terminated | truncated
        if done.any():
            env.reset(options={"reset_mask": done})
    return {key: _scale(np.concatenate(parts)) for key, parts in seen.items()}


def _scale(values: NDArray[Any]) -> dict[str, torch.Tensor]:
    return {"mean": _tensor(values.mean(axis=0)), "std": _tensor(values.std(axis=0))}


def _tensor(values: NDArray[Any]) -> torch.Tensor:
    return torch.from_numpy(np.asarray(values, np.float32))
