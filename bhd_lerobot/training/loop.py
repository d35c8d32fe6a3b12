"""The training loop: steps, and what happens between them."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from bhd_lerobot.errors import BhdError
from bhd_lerobot.training.config import BhdTrainConfig
from bhd_lerobot.training.data import TrainingData
from bhd_lerobot.training.log import Row
from bhd_lerobot.training.step import Learner, NonFiniteError, StepResult

Batch = dict[str, Any]
_EARLY = (10, 20, 50, 100)  # steps with a row of metrics although `log_freq` is more: it shows soon that it learns


class DivergedError(BhdError):
    """The loss became infinite or not a number."""


@dataclass
class Hooks:
    """What the loop calls, in every process; `mean` is over all of them. What is not wanted is None."""

    log: Callable[[Row], None] = lambda row: None
    save: Callable[[int, dict[str, Any]], None] | None = None
    evaluate: Callable[[int], Row] | None = None
    progress: Callable[[int], None] = lambda step: None
    should_stop: Callable[[int], bool] = lambda step: False
    mean: Callable[[Tensor], Tensor] = lambda values: values


@dataclass
class Window:
    """What was measured since the last row of metrics, also before this process was started; times are in s."""

    results: list[StepResult] = field(default_factory=list)
    before: list[dict[str, float]] = field(default_factory=list)
    batches: list[tuple[Any, Any]] = field(default_factory=list)
    data_s: float = 0.0
    update_s: float = 0.0
    other_s: float = 0.0
    started: float = field(default_factory=time.perf_counter)

    def numbers(self) -> list[dict[str, float]]:
        """Return the measurements of every step as plain numbers; waits for the device."""
        if not self.results:
            return list(self.before)
        losses = torch.stack([outcome.loss for outcome in self.results]).tolist()
        norms = torch.stack([outcome.grad_norm for outcome in self.results]).tolist()
        rows = []
        for result, loss, norm in zip(self.results, losses, norms, strict=True):
            outputs = {key: float(one) for key, one in result.outputs.items() if _is_number(one)}
            rows.append({**outputs, "loss": loss, "grad_norm": norm})
        return [*self.before, *rows]


class TrainingLoop:
    """Steps from where it is to the end.

    The first rows of metrics come earlier than `log_freq`, after 10, 20, 50 and 100 steps; the last step has a row, a
    held-out loss and a checkpoint, and is never interrupted.
    """

    def __init__(
        self, learner: Learner, config: BhdTrainConfig, data: TrainingData, hooks: Hooks, processes: int = 1
    ) -> None:
        """Prepare it at step 0."""
        self.learner, self.config, self.data, self.loader, self.hooks = learner, config, data, data.train, hooks
        self._batch_size = config.batch_size * processes
        self.step = 0
        self.interrupted = False
        self._window = Window()
        self._saved: int | None = None

    def state_dict(self) -> dict[str, Any]:
        """Return where it is, as JSON values: floats keep all their bits."""
        return {
            "frames": self.data.frames,
            "held_out": list(self.data.held_out_episodes),
            "fingerprint": self.data.fingerprint,
            "loader": self.loader.state_dict(),
            "learner": self.learner.state_dict(),
            "window": self._window.numbers(),
        }

    def load_state_dict(self, step: int, state: dict[str, Any]) -> None:
        """Continue after `step` steps."""
        if state.get("frames", self.data.frames) != self.data.frames:
            raise BhdError(
                f"The run was started on {state['frames']} frames, and now there are {self.data.frames}: the "
                "dataset or the selection has changed since. To learn from it, start a new run with "
                "--fine_tune=CHECKPOINT."
            )
        before, now = state.get("held_out", list(self.data.held_out_episodes)), list(self.data.held_out_episodes)
        if before != now:
            raise BhdError(
                f"The run was started with {_listed(before)} held out, and now it would be {_listed(now)}. Leave "
                "dataset.eval_split and selection.hold_out as they were, or start a new run."
            )
        if state.get("fingerprint", self.data.fingerprint) != self.data.fingerprint:
            raise BhdError(
                f"The run was started on other data: as many frames ({self.data.frames}) with other numbers, "
                "episodes, instructions or images. Restore that dataset, or learn from this one in a new run with "
                "--fine_tune=CHECKPOINT."
            )
        self.step = self._saved = step
        self._window = Window(before=list(state.get("window", [])))
        self.learner.load_state_dict(state.get("learner", {}))
        if "loader" in state:
            self.loader.load_state_dict(state["loader"])
        else:  # a checkpoint of lerobot-train
            self.loader.seek(step)

    def run(self) -> None:
        """Train to the end, or until asked to stop; then a checkpoint of the last step exists."""
        batches = self._batches()
        self._window.started = time.perf_counter()
        while self.step < self.config.steps and not self.interrupted:
            started = time.perf_counter()
            raw = next(batches)
            where = (raw.get("episode_index"), raw.get("frame_index"))
            batch = self.learner.prepare(raw)
            loaded = time.perf_counter()
            try:
                result = self.learner.step(batch)
            except NonFiniteError as error:
                what, value = error.args
                raise self._diverged(self.step + 1, what, value, where) from None
            self.step += 1
            self._window.results.append(result)
            self._window.batches.append(where)
            self._window.data_s += loaded - started
            self._window.update_s += time.perf_counter() - loaded
            self._between()

    def _between(self) -> None:
        step, options, hooks, held_out = self.step, self.config, self.hooks, self.data.held_out
        is_last = step == options.steps
        self.interrupted = not is_last and hooks.should_stop(step)
        is_extra = (options.log_freq > 0 and is_last) or (step in _EARLY and step < options.log_freq)
        is_log = _is_due(step, options.log_freq) or is_extra
        is_saving = _is_due(step, options.save_freq) or is_last
        is_eval = options.eval_steps > 0 and (_is_due(step, options.eval_steps) or is_last)
        row: Row = {"step": step, "epoch": step * self._batch_size / self.data.frames}
        if is_log:
            row |= self._measured()
        elif options.log_freq == 0 and step % _EARLY[-1] == 0:
            self._measured()  # what no row is made of is not kept
        began = time.perf_counter()
        if is_eval and held_out is not None:
            self._check()
            row["held_out_loss"] = self.learner.held_out_loss(iter(held_out), options.seed or 0)
        if hooks.evaluate is not None and _is_due(step, options.env_eval_freq):
            row |= hooks.evaluate(step)
        if len(row) > 2:
            hooks.log(row)
        hooks.progress(step)
        if hooks.save is not None and (is_saving or self.interrupted) and self._saved != step:
            self._check()
            hooks.save(step, self.state_dict())
            self._saved = step
        self._window.other_s += time.perf_counter() - began

    def _measured(self) -> Row:
        """Return the means over the window, and start a new one."""
        self._check()
        window, rows = self._window, self._window.numbers()
        elapsed = time.perf_counter() - window.started - window.other_s
        keys = ["loss", "grad_norm", *(key for key in rows[-1] if key not in ("loss", "grad_norm"))]
        means = torch.tensor(
            [math.fsum(row.get(key, 0.0) for row in rows) / len(rows) for key in keys], dtype=torch.float64
        )
        count = len(window.results)
        row: Row = dict(zip(keys, self.hooks.mean(means).tolist(), strict=True))
        row |= {
            "lr": self.learner.lr,
            "data_s": window.data_s / count,
            "update_s": window.update_s / count,
            "steps_per_s": count / elapsed,
            "samples_per_s": count * self._batch_size / elapsed,
        }
        self._window = Window()
        return row

    def _check(self) -> None:
        """Look for a loss or a gradient that is not finite; where that was done at once, there is none."""
        for what, key in (("loss", "loss"), ("norm of the gradient", "grad_norm")):
            if not self._window.results or (key == "grad_norm" and self.learner.skips_overflows):
                continue
            values = torch.stack([getattr(result, key) for result in self._window.results])
            bad = (~torch.isfinite(values)).nonzero()
            if len(bad):
                place = int(bad[0, 0])
                first = self.step - len(values) + 1 + place
                raise self._diverged(first, what, float(values[place]), self._window.batches[place])

    def _diverged(self, step: int, what: str, value: float, where: tuple[Any, Any]) -> DivergedError:
        name = f"step {step} (epoch {(step - 1) * self._batch_size // self.data.frames})"
        if all(isinstance(rows, Tensor) for rows in where):
            pairs = [f"{int(e)}:{int(f)}" for e, f in zip(*where, strict=True)]
            shown = ", ".join(pairs[:8]) + (f", … ({len(pairs)} samples)" if len(pairs) > 8 else "")
            name += f", batch of episode:frame {shown}"
        saved = "there is none yet" if not self._saved else f"that of step {self._saved} is kept"
        return DivergedError(
            f"The {what} is {value} at {name}. Training stops; of the checkpoints, {saved}. Lower the learning rate "
            "(--policy.optimizer_lr), clip gradients, or look for extreme values in the data."
        )

    def _batches(self) -> Iterator[Batch]:
        is_new_epoch = self.loader.state_dict().get("position", 0) == 0
        while True:
            if is_new_epoch:
                # As PyTorch's DataLoader does, so that dropout and noise are those of lerobot-train for the same seed.
                torch.empty((), dtype=torch.int64).random_()
            yield from self.loader
            is_new_epoch = True


def _listed(episodes: Sequence[int]) -> str:
    shown = ", ".join(map(str, episodes[:5])) + (", …" if len(episodes) > 5 else "")
    return f"{len(episodes)} episodes ({shown})" if episodes else "no episode"


def _is_due(step: int, frequency: int) -> bool:
    return frequency > 0 and step % frequency == 0


def _is_number(value: Any) -> bool:
    if isinstance(value, Tensor):
        return value.numel() == 1 and value.dtype != torch.bool
    return isinstance(value, int | float) and not isinstance(value, bool)
