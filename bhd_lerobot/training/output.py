"""What a training run leaves: its folder, and what of it goes to the Hub and to wandb."""

import copy
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lerobot.utils.constants import PRETRAINED_MODEL_DIR

from bhd_lerobot.datasets.remote.errors import transfer_errors
from bhd_lerobot.errors import BhdError, ConfigError, TransferError
from bhd_lerobot.hub.push import check_pushable
from bhd_lerobot.hub.transfer import prompt_interrupt
from bhd_lerobot.policies.learned.contract import CONTRACT_FILE
from bhd_lerobot.rollout.run_folder import made
from bhd_lerobot.stock import push_checkpoint_to_hub
from bhd_lerobot.training import checkpoint
from bhd_lerobot.training.checkpoint import TrainingParts
from bhd_lerobot.training.config import BhdTrainConfig, without_places
from bhd_lerobot.training.log import METRICS_NAME, PLOT_NAME, MetricsFile, Row, read_metrics, write_config
from bhd_lerobot.training.plots import draw_loss


class RunOutput:
    """Writes a run's folder. Of several processes only the main one does; in the others nothing happens."""

    def __init__(
        self, config: BhdTrainConfig, parts: TrainingParts, step: int, *, is_main: bool = True, processes: int = 1
    ) -> None:
        """Open the folder, with the metrics up to the step that a resumed run continues from."""
        self.folder, self.checkpoint = Path(str(config.output_dir)), config.checkpoint_path
        policy: Any = config.policy
        if is_main and policy is not None and (policy.push_to_hub or config.save_checkpoint_to_hub):
            check_pushable(str(policy.repo_id))  # before hours of training, not after
        self._config, self._parts, self._processes = config, parts, processes
        self._metrics = self._open(step) if is_main else None
        self._wandb = self._make_wandb() if is_main else None
        self._drawn = (0, 0)  # the step and the number of rows of the curve as it was drawn last

    @property
    def rows(self) -> list[Row]:
        """Rows of `metrics.jsonl`; none in other processes than the main one."""
        return [] if self._metrics is None else self._metrics.rows

    def log(self, row: Row) -> None:
        """Write a row of metrics."""
        if self._metrics is None:
            return
        try:
            self._metrics.append(row)
        except OSError as error:
            kept = "there is none yet" if self.checkpoint is None else f"{self.checkpoint} is intact"
            raise BhdError(
                f"The metrics of step {row['step']} cannot be written to {self._metrics.path}: {error.strerror}. "
                f"Training stops; of the checkpoints, {kept}. Make room, and resume the run."
            ) from error
        if self._wandb is not None:
            self._wandb.log_dict({key: one for key, one in row.items() if key != "step"}, row["step"])

    def save(self, step: int, loop_state: dict[str, Any]) -> None:
        """Write a checkpoint, and share it if that was asked for."""
        if self._metrics is None:
            return
        self.checkpoint = checkpoint.save(self._config, step, self._parts, loop_state, self._processes)
        self.draw(step)
        config = self._config
        if config.save_checkpoint_to_hub and config.policy is not None:
            again = f"When that is repaired, continue with:\n  {checkpoint.resume_command(self.checkpoint)}"
            with self._uploading(str(config.policy.repo_id), "The checkpoint", again):
                push_checkpoint_to_hub(self.checkpoint, config.policy.repo_id, private=config.policy.private)
        if self._wandb is not None:
            self._wandb.log_policy(self.checkpoint)

    def draw(self, step: int) -> None:
        """Draw the curve. Where that fails, what was learned is worth more than its image: the run continues."""
        if self._metrics is None or self._drawn == (step, len(self._metrics.rows)):
            return
        config = self._config
        heading = f"{config.job_name} on {config.dataset.repo_id}, step {step} of {config.steps}"
        kind = getattr(config.policy, "loss_name", None)
        loss = f"loss of {config.policy.type}{f' ({kind})' if kind else ''}" if config.policy else "loss"
        try:
            draw_loss(self._metrics.rows, self.folder / PLOT_NAME, heading, loss)
            self._drawn = (step, len(self._metrics.rows))
        except OSError:
            (self.folder / PLOT_NAME).unlink(missing_ok=True)  # half of an image

    def push(self) -> None:
        """Upload the policy of a complete run, if that was asked for."""
        policy: Any = self._config.policy
        if self._metrics is None or policy is None or not policy.push_to_hub:
            return
        parts = self._parts
        again = ""
        if self.checkpoint is not None:
            private = ["--private"] if policy.private else []
            folder = str(self.checkpoint / PRETRAINED_MODEL_DIR)
            again = f"When that is repaired:\n  {shlex.join(['hf', 'upload', policy.repo_id, folder, '.', *private])}"
        with self._uploading(policy.repo_id, "The policy", again):
            published: Any = copy.copy(parts.policy)
            published.config = without_places(published.config)
            published.push_model_to_hub(without_places(self._config))
            parts.preprocessor.push_to_hub(policy.repo_id)
            parts.postprocessor.push_to_hub(policy.repo_id)
            if self.checkpoint is not None:
                from huggingface_hub import HfApi

                file = self.checkpoint / PRETRAINED_MODEL_DIR / CONTRACT_FILE
                HfApi().upload_file(path_or_fileobj=file, path_in_repo=file.name, repo_id=policy.repo_id)

    @contextmanager
    def _uploading(self, repo_id: str, what: str, again: str) -> Iterator[None]:
        """Say, where an upload fails or is interrupted, what is kept and how to repeat it."""
        kept = "is not on this machine" if self.checkpoint is None else f"is complete at {self.checkpoint}"
        left = f"{what} {kept}. {again}".rstrip()
        try:
            with prompt_interrupt(left), transfer_errors(repo_id, "upload to"):
                yield
        except TransferError as error:
            raise TransferError(f"{error}\n{left}") from error
        except KeyboardInterrupt:
            print(f"Stopped; {repo_id} may hold a part. {left}", file=sys.stderr)
            raise

    def _open(self, step: int) -> MetricsFile:
        config, folder = self._config, self.folder
        try:
            folder, _ = made(folder, is_new=config.checkpoint_path is None)
            self.folder = config.output_dir = folder
            source = config.checkpoint_path.parent.parent if config.checkpoint_path else folder
            checkpoint.clean(folder)
            write_config(folder, config.plain())
            config._save_pretrained(folder)
            return MetricsFile(folder / METRICS_NAME, read_metrics(source / METRICS_NAME, step))
        except OSError as error:
            raise ConfigError(
                f"The run folder {folder} cannot be written: {error.strerror}. Set --output_dir."
            ) from error

    def _make_wandb(self) -> Any:
        if not (self._config.wandb.enable and self._config.wandb.project):
            return None
        from bhd_lerobot.stock import WandBLogger

        return WandBLogger(self._config)
