"""The loop that all trainings share, and the rendering of their data in parallel."""

import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torch import nn

from zsp_lite.errors import InputError
from zsp_lite.training import shards
from zsp_lite.training.loop import Task, claim_folder, read_checkpoint, run
from zsp_lite.training.shards import render_shards


class LineFit(Task):
    """Fit y = 2 x + 1 by gradient descent on points drawn for each step."""

    def __init__(self, steps: int = 6, precision: str = "float32", width: int = 1):
        super().__init__()
        self.steps, self.precision = steps, precision
        torch.manual_seed(0)
        self.line = nn.Linear(1, width)
        self.register_buffer("mean", torch.zeros(1))
        self.optimizer = torch.optim.AdamW(self.line.parameters())
        self.evaluated = []

    def schedule(self, step):
        rate = 0.1 * (1 - step / self.steps)
        self.set_learning_rate(rate)
        return {"rate": round(rate, 3)}

    def loss(self, step):
        x = torch.from_numpy(np.random.default_rng(step).normal(size=(8, 1)).astype(np.float32))
        loss = (self.line(x) - 2 * x - 1).square().mean()
        return loss, {"loss": loss.item()}

    @torch.no_grad()
    def after_step(self, step):
        self.mean.lerp_(self.line.weight[0], 0.5)

    def evaluate(self):
        self.evaluated.append(self.steps_done)
        return {"slope": self.line.weight.item()}


class Killed(Exception):
    pass


def rows_of(folder):
    return [json.loads(line) | {"seconds": 0} for line in (folder / "log.jsonl").read_text().splitlines()]


def test_a_killed_run_resumes_to_the_same_weights_and_log(tmp_path):
    (tmp_path / "whole").mkdir()
    (tmp_path / "killed").mkdir()
    every = dict(log_every=1, evaluate_every=2, checkpoint_every=2)
    whole = LineFit()
    run(whole, tmp_path / "whole", lambda line: None, **every)

    def kill_at_five(line):
        if line.startswith("step 5"):
            raise Killed

    with pytest.raises(Killed):
        run(LineFit(), tmp_path / "killed", kill_at_five, **every)
    with (tmp_path / "killed" / "log.jsonl").open("a") as file:
        file.write('{"step": 6, "se')  # killed while it was writing
    resumed = LineFit()
    run(resumed, tmp_path / "killed", lambda line: None, **every)
    assert all(torch.equal(x, whole.state_dict()[name]) for name, x in resumed.state_dict().items())
    assert resumed.evaluated == [6]  # from step 4 on, without step 5
    rows = rows_of(tmp_path / "whole")
    assert rows == rows_of(tmp_path / "killed")
    assert [row["step"] for row in rows] == [1, 2, 3, 4, 5, 6]
    assert ["slope" in row for row in rows] == [False, True, False, True, False, True]
    assert [row["rate"] for row in rows] == [0.1, 0.083, 0.067, 0.05, 0.033, 0.017]


def test_the_log_has_exponential_averages_of_all_steps(tmp_path):
    task = LineFit()
    losses = [task.step()["loss"] for _ in range(3)]
    expected = 0.95 * (0.95 * losses[0] + 0.05 * losses[1]) + 0.05 * losses[2]
    assert task.smoothed["loss"] == pytest.approx(expected)


def test_gradients_are_clipped_and_must_be_finite():
    free, clipped = LineFit(), LineFit()
    clipped.max_gradient_norm = 1e-3
    norm = free.step()["gradient"]
    assert norm == pytest.approx(clipped.step()["gradient"]) and norm > 1
    gradients = [torch.cat([p.grad.flatten() for p in task.parameters()]) for task in (free, clipped)]
    torch.testing.assert_close(gradients[1], gradients[0] * 1e-3 / norm)
    with torch.no_grad():
        free.line.weight.fill_(float("inf"))
    with pytest.raises(InputError, match="step 2: the gradient has norm nan, expected a lower learning rate"):
        free.step()


def test_a_resumed_run_keeps_its_precision_and_refuses_other_networks_and_origins(tmp_path):
    first = LineFit(precision="bfloat16")
    first.origin = "weights A"
    first.save(tmp_path / "checkpoint.pt")
    resumed = LineFit(precision="float32")
    resumed.restore(tmp_path / "checkpoint.pt")
    assert resumed.precision == "bfloat16" and resumed.origin == "weights A"
    with pytest.raises(InputError, match="checkpoint.pt: checkpoint of another network"):
        LineFit(width=2).restore(tmp_path / "checkpoint.pt")
    other = LineFit()
    other.origin = "weights B"
    with pytest.raises(InputError, match="checkpoint.pt: run that started from other weights"):
        other.restore(tmp_path / "checkpoint.pt")
    torch.save({"task": {}}, tmp_path / "checkpoint.pt")
    with pytest.raises(InputError, match="checkpoint.pt: damaged, or not the checkpoint of a training run"):
        read_checkpoint(tmp_path / "checkpoint.pt")


def test_a_run_resumed_where_its_precision_is_slow_says_so(tmp_path, monkeypatch, caplog):
    LineFit(precision="bfloat16").save(tmp_path / "slow.pt")
    LineFit(precision="float32").save(tmp_path / "exact.pt")
    for fast in (True, False):
        monkeypatch.setattr("zsp_lite.training.loop.bfloat16_is_fast", lambda device, fast=fast: fast)
        for name in ("slow.pt", "exact.pt"):
            LineFit().restore(tmp_path / name)
    (warning,) = caplog.messages
    assert "slow.pt: the run began in bfloat16 and keeps it" in warning


def test_a_folder_belongs_to_one_configuration(tmp_path):
    claim_folder(tmp_path / "run", {"seed": 0, "sides": (1, 2)})
    claim_folder(tmp_path / "run", {"seed": 0, "sides": (1, 2)})
    with pytest.raises(InputError, match="run with another configuration, seed is 0, expected 1 or a new folder"):
        claim_folder(tmp_path / "run", {"seed": 1, "sides": (1, 2)})


def squares(number):
    return np.full(2, number), np.full(3, number**2)


def test_worker_processes_are_spawned_not_forked(tmp_path, monkeypatch):
    started = []

    class Pool(ThreadPoolExecutor):
        def __init__(self, workers, context):
            started.append((workers, context.get_start_method()))
            super().__init__(workers)

    monkeypatch.setattr(shards, "ProcessPoolExecutor", Pool)
    files = {tmp_path / f"{start}.npz": range(start, start + 2) for start in (0, 2, 4)}
    render_shards(squares, files, ("number", "square"), workers=2)
    assert started == [(2, "spawn")]
    with np.load(tmp_path / "2.npz") as file:
        assert file["number"].tolist() == [[2, 2], [3, 3]] and file["square"].tolist() == [[4] * 3, [9] * 3]
    kept = (tmp_path / "0.npz").stat().st_mtime_ns
    (tmp_path / "4.npz").unlink()
    render_shards(squares, files, ("number", "square"), workers=2)
    assert len(started) == 1  # one missing shard needs no other process
    assert (tmp_path / "4.npz").exists() and (tmp_path / "0.npz").stat().st_mtime_ns == kept
