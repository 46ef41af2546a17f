"""Ablations of the training: short runs that continue from the same weights, each without one part.

    python -m tools.ablations zsp-tiny outputs/ablations

renders 800 objects in three variants, trains every variant for the same number of steps on 128 px crops, and prints a
table of accuracies on objects of training categories that no run has seen. Renders and runs are kept in the folder and
reused.
"""

import argparse
import logging
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from zsp_lite.errors import InputError
from zsp_lite.training.batches import sample_batch
from zsp_lite.training.export import starting_weights
from zsp_lite.training.loop import keep_freed_memory, read_checkpoint
from zsp_lite.training.recipe import Stage, TrainingConfig
from zsp_lite.training.renders import HELD_OUT, VIEWS, RenderSet, load_render_set, render_set
from zsp_lite.training.train import held_out_accuracy, train
from zsp_lite.training.trainee import Trainee

SIDE = 128  # of the crops, pixels
UNSEEN = 200  # objects for the table
FULL = Stage(160, SIDE, 3, VIEWS, (0.6, 1.0), view=2.0)
BASE = TrainingConfig(seed=1, objects=800, learning_rate=3e-4, average=0.98, stages=(FULL,))

ALL = "full training"
VARIANTS = {
    ALL: BASE,
    "views of one deformed object, no variants": replace(BASE, proportions=0.0),
    "views of one rigid object": replace(BASE, proportions=0.0, deformation=0.0),
    "no view loss": replace(BASE, stages=(replace(FULL, view=0.0),)),
    "view loss on plain keys": replace(BASE, log_binned=False),
    "view loss without opposite views": replace(BASE, stages=(replace(FULL, objects=6, views=4),)),
    "no geometry, no attention": replace(BASE, stages=(replace(FULL, helpers=0.0),)),
}

Row = tuple[float, float, float]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tools.ablations", description=__doc__.splitlines()[0])
    parser.add_argument(
        "start_from", help="initial weights: checkpoint.pt of a run, exported .safetensors, or zsp-tiny"
    )
    parser.add_argument("out", type=Path, help="folder for renders and runs")
    parser.add_argument("--also", nargs="*", default=[], help="other weights to evaluate without training")
    arguments = parser.parse_args()
    logging.basicConfig(format="%(message)s", level=logging.INFO)
    keep_freed_memory()
    try:
        rows = evaluate_variants(arguments.start_from, arguments.out, arguments.also)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    print("| | matches (%) | right view (%) | IoU of the saliency |\n|---|---|---|---|")
    for name, (matches, view, iou) in rows.items():
        print(f"| {name} | {100 * matches:.1f} | {100 * view:.1f} | {iou:.3f} |")


def evaluate_variants(start_from: str, out: Path, also: list[str]) -> dict[str, Row]:
    """Train all variants and return match accuracy, view accuracy and saliency IoU by row of the table."""
    sources = {f"{start_from}, without further training": start_from} | {name: name for name in also}
    models = {name: _trainee(starting_weights(BASE, source)) for name, source in sources.items()}
    unseen = load_render_set(render_set(out / "held-out", UNSEEN, seed=0, first=HELD_OUT))
    rows = {name: _evaluate(model, unseen) for name, model in models.items()}
    for name, config in VARIANTS.items():
        folder, renders = out / name.replace(" ", "-").replace(",", ""), out / "renders"
        train(config, folder, renders, start_from=start_from)
        checkpoint = folder / "checkpoint.pt"
        model = _trainee(starting_weights(config, checkpoint))
        rows[name] = _evaluate(model, unseen)
        if name == ALL:
            state = read_checkpoint(checkpoint)["task"]
            last = {key.removeprefix("model."): x for key, x in state.items() if key.startswith("model.")}
            rows["no averaging of weights"] = _evaluate(_trainee(last), unseen)
            first_shard = f"views-{BASE.seed}-000000-*-{BASE.proportions:g}-{BASE.deformation:g}.npz"
            model.key_mean = positional_mean(model, load_render_set(sorted(renders.glob(first_shard))))
            rows["mean key at each grid position removed"] = _evaluate(model, unseen)
    return rows


@torch.no_grad()
def positional_mean(model: Trainee, renders: RenderSet) -> torch.Tensor:
    """Return the mean key (n, dim) at each position of the patch grid over crops of training objects."""
    rng, total = np.random.default_rng(0), 0.0
    for _ in range(60):
        images = sample_batch(renders, rng, 1, VIEWS, SIDE, (0.85, 1.0)).images
        total = total + model(images).keys.float().mean(0)
    return total / 60


def _trainee(weights: dict[str, torch.Tensor]) -> Trainee:
    model = Trainee(BASE)
    model.load_state_dict(weights, strict=False)  # exported weights have no heads; the table does not need them
    return model


def _evaluate(model: Trainee, unseen: RenderSet) -> Row:
    return tuple(held_out_accuracy(model, unseen, SIDE, len(unseen)).values())


if __name__ == "__main__":
    main()
