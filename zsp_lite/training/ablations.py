"""What each part of the training is worth: short runs that go on from the same weights, each without one part.

    python -m zsp_lite.training.ablations zsp-tiny outputs/ablations

renders 800 new objects in three ways, trains every variant for as many steps on 128 px crops, and prints a table of
what is found on TRAINING-category objects that no run sees. Everything is kept in the folder and reused.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import nn

from zsp_lite.errors import InputError
from zsp_lite.training.batches import sample_batch
from zsp_lite.training.renders import HELD_OUT, SHARD, VIEWS, RenderSet, load_render_set, render_set
from zsp_lite.training.train import (
    Stage,
    Trainee,
    TrainingConfig,
    held_out_accuracy,
    keep_freed_memory,
    starting_weights,
    train,
)

SIDE = 128
FULL = Stage(160, SIDE, 3, VIEWS, (0.6, 1.0), view=2.0)
BASE = TrainingConfig(seed=1, objects=800, learning_rate=3e-4, average=0.98, stages=(FULL,))

VARIANTS = {
    "all of it": BASE,
    "views of one deformed instance, no siblings": replace(BASE, proportions=0.0),
    "views of one rigid instance": replace(BASE, proportions=0.0, deformation=0.0),
    "no view loss": replace(BASE, stages=(replace(FULL, view=0.0),)),
    "view loss on bare keys": replace(BASE, log_binned=False),
    "view loss without opposite sides": replace(BASE, stages=(replace(FULL, objects=6, views=4),)),
    "no geometry, no attention": replace(BASE, stages=(replace(FULL, helpers=0.0),)),
}


def positional_mean(model: Trainee, renders: RenderSet) -> torch.Tensor:
    """The mean key at each place of the grid, over crops of training objects: what a key says about where it is."""
    rng, total = np.random.default_rng(0), 0.0
    for _ in range(60):
        images = sample_batch(renders, rng, 1, VIEWS, SIDE, (0.85, 1.0)).images
        with torch.no_grad():
            total = total + model(images).keys.float().mean(0)
    return total / 60


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m zsp_lite.training.ablations", description=__doc__.splitlines()[0])
    parser.add_argument("start_from", help="what variants go on from: checkpoint.pt, exported .safetensors, zsp-tiny")
    parser.add_argument("out", type=Path, help="folder for renders and runs")
    parser.add_argument("--also", nargs="*", default=[], help="other such weights, measured beside")
    arguments = parser.parse_args()
    keep_freed_memory()
    try:
        rows = measured_rows(arguments.start_from, arguments.out, arguments.also)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    print("| | matches (%) | view (%) | IoU |\n|---|---|---|---|")
    for name, (matches, view, iou) in rows.items():
        print(f"| {name} | {100 * matches:.1f} | {100 * view:.1f} | {iou:.3f} |")


def measured_rows(start_from: str, out: Path, also: list[str]) -> dict[str, tuple[float, float, float]]:
    sources = {f"{start_from}, before": start_from} | {name: name for name in also}
    models = {name: trainee(starting_weights(BASE, source)) for name, source in sources.items()}
    unseen = load_render_set(render_set(out / "held-out", SHARD, 0, first=HELD_OUT))
    rows = {name: measured(model, unseen) for name, model in models.items()}
    for name, config in VARIANTS.items():
        run, renders = out / "".join(letter if letter.isalnum() else "-" for letter in name), out / "renders"
        train(config, run, renders, log=lambda line: print(line, flush=True), start_from=start_from)
        state = torch.load(run / "checkpoint.pt", map_location="cpu", weights_only=True)
        rows[name] = measured(trainee(state["average"]), unseen)
        if name == "all of it":
            rows["no average of the weights"] = measured(trainee(state["model"]), unseen)
            model = trainee(state["average"])
            some = sorted(renders.glob(f"objects-{BASE.seed}-000000-*-{BASE.proportions:g}-{BASE.deformation:g}.npz"))
            model.key_mean = positional_mean(model, load_render_set(some))
            rows["the keys' mean at each place removed"] = measured(model, unseen)
    return rows


def trainee(weights: dict[str, torch.Tensor]) -> Trainee:
    model = Trainee(BASE)
    model.load_state_dict(weights, strict=False)  # exported weights have no read-outs, which no figure here needs
    return model


def measured(model: nn.Module, unseen: RenderSet) -> tuple[float, float, float]:
    return tuple(held_out_accuracy(model, unseen, SIDE, len(unseen)).values())


if __name__ == "__main__":
    main()
