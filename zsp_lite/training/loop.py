"""The training loop shared by all training runs: steps, schedule, checkpoints, log and resumption."""

import ctypes
import json
import logging
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from zsp_lite.backbones.precision import Precision, bfloat16_is_fast
from zsp_lite.data.annotations import decode
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes, write_atomic

_SMOOTHING = 0.95  # decay per step of the exponential averages in the log

logger = logging.getLogger(__name__)


class Task(nn.Module):
    """What one training run computes. `run` trains it.

    A subclass creates its networks and its optimiser and implements `loss`. All parameters and buffers are saved in
    checkpoints. A step must depend only on these and on its number (seed random generators with both), so that a
    resumed run gives the same result as an uninterrupted one.

    Attributes:
        steps: Number of steps of the whole run.
        optimizer: Optimiser of the trained parameters.
        max_gradient_norm: Gradients with a larger norm are scaled down to it.
        precision: Precision of the matrix products; a resumed run keeps that of its first part.
        origin: Identifies the weights from which the run started; a checkpoint with another one is refused. None
            accepts every checkpoint.
        steps_done: Number of steps taken.
        settings: What `schedule` returned for the last step.
        smoothed: Exponential averages of the figures of all steps.
    """

    steps: int
    optimizer: torch.optim.Optimizer
    max_gradient_norm = math.inf
    precision: Precision = "float32"
    origin: str | None = None

    def __init__(self):
        super().__init__()
        self.steps_done = 0
        self.settings: dict[str, float] = {}
        self.smoothed: dict[str, float] = {}

    def schedule(self, step: int) -> dict[str, float]:
        """Set what changes from step to step, such as the learning rate, and return the values to log."""
        return {}

    def loss(self, step: int) -> tuple[Tensor, dict[str, float]]:
        """Return the loss of step `step`, counted from 0, and the figures to log."""
        raise NotImplementedError

    def after_step(self, step: int) -> None:
        """Update running averages after the optimiser's step."""

    def evaluate(self) -> dict[str, float]:
        """Return figures measured on data that the run does not train on."""
        return {}

    def step(self) -> dict[str, float]:
        """Take one step and return its figures.

        Raises:
            InputError: If the gradients are not finite.
        """
        step = self.steps_done
        self.settings = self.schedule(step)
        loss, figures = self.loss(step)
        self.optimizer.zero_grad()
        loss.backward()
        norm = float(nn.utils.clip_grad_norm_(self.parameters(), self.max_gradient_norm))
        if not math.isfinite(norm):
            raise InputError(f"step {step + 1}: the gradient has norm {norm}, expected a lower learning rate")
        self.optimizer.step()
        self.after_step(step)
        self.steps_done += 1
        figures = figures | {"gradient": norm}
        for name, value in figures.items():
            self.smoothed[name] = _SMOOTHING * self.smoothed.get(name, value) + (1 - _SMOOTHING) * value
        return figures

    def set_learning_rate(self, rate: float) -> None:
        """Set the learning rate of all parameter groups."""
        for group in self.optimizer.param_groups:
            group["lr"] = rate

    def save(self, path: Path) -> None:
        """Write a checkpoint; an existing file is replaced only by a complete one."""
        names = ("origin", "precision", "steps_done", "smoothed")
        state = {name: getattr(self, name) for name in names}
        state |= {"task": self.state_dict(), "optimizer": self.optimizer.state_dict()}
        unfinished = path.with_suffix(".part")
        torch.save(state, unfinished)
        unfinished.replace(path)

    def restore(self, path: Path) -> None:
        """Continue from a checkpoint. Raises InputError if it is damaged or of another network or origin."""
        state = read_checkpoint(path)
        if self.origin is not None and state["origin"] != self.origin:
            raise InputError(f"{path}: run that started from other weights, expected a new folder")
        try:
            self.load_state_dict(state["task"])
            self.optimizer.load_state_dict(state["optimizer"])
        except (RuntimeError, ValueError) as error:
            raise InputError(f"{path}: checkpoint of another network") from error
        self.origin, self.steps_done, self.smoothed = state["origin"], state["steps_done"], state["smoothed"]
        device = next(self.parameters()).device.type
        if state["precision"] == "bfloat16" and not bfloat16_is_fast(device):
            logger.warning(
                "%s: the run began in bfloat16 and keeps it, which is slow on this device (%s)", path, device
            )
        for module in self.modules():
            if hasattr(module, "precision"):
                module.precision = state["precision"]


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a file of `Task.save` into CPU memory. Raises InputError if it is damaged or something else."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        return {name: state[name] for name in ("task", "optimizer", "origin", "precision", "steps_done", "smoothed")}
    except Exception as error:  # torch.load raises many types of exceptions
        raise InputError(f"{path}: damaged, or not the checkpoint of a training run") from error


def run(
    task: Task,
    folder: Path,
    log: Callable[[str], None] = logger.info,
    log_every: int = 50,
    evaluate_every: int = 500,
    checkpoint_every: int = 250,
) -> None:
    """Train a task to its last step, or resume it from `folder`/checkpoint.pt.

    Args:
        task: The task at its first step.
        folder: Receives checkpoint.pt and log.jsonl: one JSON object per line with the step, the seconds of computing,
            `Task.settings`, `Task.smoothed` and, in some lines, the figures of `Task.evaluate`.
        log: Called with each line of the log as readable text.
        log_every: Steps between lines of the log. The last step always has one.
        evaluate_every: Steps between evaluations, a multiple of `log_every`.
        checkpoint_every: Steps between checkpoints.

    Raises:
        InputError: If the checkpoint does not fit the task or the loss diverges.
    """
    checkpoint, log_path = folder / "checkpoint.pt", folder / "log.jsonl"
    if checkpoint.exists():
        task.restore(checkpoint)
    rows = _log_until(log_path, task.steps_done)
    start = time.monotonic() - (rows[-1]["seconds"] if rows else 0)
    while task.steps_done < task.steps:
        task.step()
        step, last = task.steps_done, task.steps_done == task.steps
        if step % log_every == 0 or last:
            figures = task.smoothed
            if step % evaluate_every == 0 or last:
                figures = figures | task.evaluate()
            row = {"step": step, "seconds": round(time.monotonic() - start)} | task.settings
            row |= {name: round(value, 4) for name, value in figures.items()}
            with log_path.open("a") as file:
                file.write(json.dumps(row) + "\n")
            log("  ".join(f"{name} {value}" for name, value in row.items()))
        if step % checkpoint_every == 0 or last:
            task.save(checkpoint)


def cosine(ends: tuple[float, float], progress: float) -> float:
    """Interpolate from ends[0] to ends[1] along half a cosine, for progress from 0 to 1."""
    return ends[1] + (ends[0] - ends[1]) * 0.5 * (1 + math.cos(math.pi * progress))


def claim_folder(folder: Path, settings: dict[str, Any]) -> None:
    """Make the folder of a run and write its settings to config.json.

    Raises:
        InputError: If the folder has a run with other settings.
    """
    folder.mkdir(parents=True, exist_ok=True)
    settings, path = json.loads(json.dumps(settings)), folder / "config.json"
    if path.exists():
        found = decode(read_bytes(path, "configuration"), dict, path)
        for name in sorted(settings.keys() | found.keys()):
            if settings.get(name) != found.get(name):
                raise InputError(
                    f"{path}: run with another configuration, {name} is {found.get(name)}, expected "
                    f"{settings.get(name)} or a new folder"
                )
    write_atomic(path, (json.dumps(settings, indent=1) + "\n").encode())


def keep_freed_memory() -> None:
    """Let glibc keep freed memory for the rest of this process; has no effect with other C libraries.

    By default each step returns its memory to the system and gets it back page by page: a step with 16 crops of 224 px
    took 7.1 s instead of 2.8 s, one with 24 crops of 128 px 1.4 s instead of 1.1 s (medians of six on two cores).
    """
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        never_map, never_trim = (-4, 0), (-1, 2**31 - 1)  # M_MMAP_MAX, M_TRIM_THRESHOLD
        for option in (never_map, never_trim):
            libc.mallopt(*option)


def _log_until(path: Path, step: int) -> list[dict[str, Any]]:
    """Cut the log at `step` and return its rows. Later steps are not in the checkpoint and will be logged again."""
    lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    rows = [json.loads(line) for line in lines if line.endswith("\n")]
    rows = [row for row in rows if row["step"] <= step]
    write_atomic(path, "".join(json.dumps(row) + "\n" for row in rows).encode())
    return rows
