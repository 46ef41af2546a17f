"""Train the position head of zsp-tiny-photo (`zsp_lite/backbones/positions.py`) on renders with known object poses.

    python -m tools.position_head outputs/training_poses outputs/training --out head.safetensors

docs/rebuild.md makes the data. Features are computed once and kept in the data folders; the training takes 12 minutes.
Only categories that `concepts.csv` lists for training are accepted. `--validation FOLDER` prints after each eighth of
the run how well the axes of unseen categories are predicted.
"""

import argparse
import logging
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from safetensors.torch import save_file
from torch import Tensor

from tools.concepts import check_sides
from zsp_lite.backbones.backbone import Backbone, normalize, prepare_images
from zsp_lite.backbones.load import load_backbone
from zsp_lite.backbones.positions import PositionHead, patch_places
from zsp_lite.data.co3d import Co3D
from zsp_lite.errors import InputError
from zsp_lite.synthetic.ground_truth import ObjectPose, object_poses
from zsp_lite.verified.poses import nearest_rotation, rotation_angles
from zsp_lite.views import View, extract_views, object_crop

BACKBONE = "zsp-tiny-photo"
BATCH, PATCHES = 16, 128  # images per step, foreground patches per image
_LEARNING_RATE, _WEIGHT_DECAY = 2e-3, 0.05
_NOISE = 0.1  # on the features, standard deviations
_FARTHEST = 4.0  # points farther from the object's centre, in its standard deviations, are background
_FEWEST = 16  # foreground patches of known depth
WITHOUT = "without"  # metadata of the file: the categories left out
_log = logging.getLogger("zsp_lite.position_head")


@dataclass(frozen=True, eq=False)
class Example:
    """The foreground patches of one picture: features, places in the picture, and coordinates on the object.

    The category is FOLDER/CATEGORY, because two folders may mean different objects by one name.
    """

    category: str
    sequence: str
    keys: Float[Tensor, "n dim"]
    photo: Float[Tensor, "n channels"]
    image: Float[Tensor, " dim"]
    places: Float[Tensor, "n 2"]
    positions: Float[Tensor, "n 3"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.position_head", description=__doc__.split("\n")[0])
    parser.add_argument("data", nargs="+", type=Path, help="folders of `zsp-lite synth` with training categories")
    parser.add_argument("--validation", nargs="*", type=Path, default=[], help="folders with validation categories")
    parser.add_argument("--without", nargs="*", default=[], metavar="FOLDER/CATEGORY", help="categories to leave out")
    parser.add_argument("--steps", type=int, default=2400)
    parser.add_argument("--out", type=Path, required=True, help="file of weights to write")
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        check_sides(given.data, "training")
        check_sides(given.validation, "validation")
        backbone = load_backbone(BACKBONE)
        examples = [one for folder in given.data for one in read_examples(folder, backbone)]
        unseen = [one for folder in given.validation for one in read_examples(folder, backbone)]
        if unknown := set(given.without) - {one.category for one in examples}:
            raise InputError(f"--without {' '.join(sorted(unknown))}: not in the data, expected FOLDER/CATEGORY")
        head = train([one for one in examples if one.category not in given.without], unseen, given.steps)
        weights = {name: value.half().contiguous() for name, value in head.state_dict().items()}
        save_file(weights, given.out, {WITHOUT: " ".join(given.without)})
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def read_examples(folder: Path, backbone: Backbone) -> list[Example]:
    """Return the examples of all frames of a folder; they are computed once and kept in it."""
    kept = folder / "position_examples.pt"
    if not kept.is_file():
        dataset, examples = Co3D(folder), []
        for category in dataset.categories():
            poses = object_poses(dataset, category)
            for sequence, pose in sorted(poses.items()):
                crops = [
                    object_crop(dataset.load(one), backbone.image_size) for one in dataset.frames(category, sequence)
                ]
                views = extract_views(backbone, crops)
                known = [view for view in views if view.known_foreground.sum() >= _FEWEST]
                name = f"{folder.name}/{category}"
                examples += [vars(make_example(name, sequence, view, pose, backbone)) for view in known]
            _log.info("%s: %d pictures so far", category, len(examples))
        torch.save(examples, kept)
    return [Example(**one) for one in torch.load(kept, weights_only=True)]


def make_example(category: str, sequence: str, view: View, pose: ObjectPose, backbone: Backbone) -> Example:
    """Compute the example of a view whose object has a known pose."""
    image = normalize(prepare_images([view.frame.rgb], backbone.image_size), backbone.mean, backbone.std)
    with torch.inference_mode():
        photo = backbone.model.extract(image, backbone.layer, backbone.facet).photo[0]
    known = view.known_foreground
    positions = pose.to_object(view.frame.camera.to_world(view.patch_points[0][known]))
    near = torch.from_numpy(np.linalg.norm(positions, axis=1) < _FARTHEST)
    chosen = torch.from_numpy(known.ravel())
    return Example(
        category, sequence,
        view.features.keys.flatten(0, 1)[chosen][near].half(), photo[chosen][near].half(),
        view.features.global_feature, patch_places(view.features.grid)[chosen][near],
        torch.from_numpy(positions.astype(np.float32))[near],
    )  # fmt: skip


def train(examples: Sequence[Example], unseen: Sequence[Example], steps: int, seed: int = 0) -> PositionHead:
    """Train a head with the smooth L1 loss on coordinates.

    A picture is drawn by its category, with a probability proportional to the root of the category's number of objects,
    its object, and its number.
    """
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    objects: dict[str, dict[str, list[Example]]] = {}
    for one in examples:
        objects.setdefault(one.category, {}).setdefault(one.sequence, []).append(one)
    by_category = [list(found.values()) for found in objects.values()]
    share = np.sqrt([len(found) for found in by_category])
    head = PositionHead(examples[0].keys.shape[1], examples[0].photo.shape[1]).train()
    optimiser = torch.optim.AdamW(head.parameters(), lr=_LEARNING_RATE, weight_decay=_WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, _LEARNING_RATE, steps, pct_start=0.1)
    mean = 0.0
    for step in range(1, steps + 1):
        drawn = []
        for index in rng.choice(len(by_category), BATCH, p=share / share.sum()):
            pictures = by_category[index][rng.integers(len(by_category[index]))]
            drawn.append(pictures[rng.integers(len(pictures))])
        keys, photo, places, image, foreground, positions = collate(drawn, rng)
        keys, photo = (x + _NOISE * x.std() * torch.randn_like(x) for x in (keys, photo))
        found = head(keys, photo, places, image, foreground)
        loss = F.smooth_l1_loss(found[foreground], positions[foreground], beta=0.5)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(head.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        mean += 0.02 * (loss.item() - mean)
        if step % max(steps // 8, 1) == 0:
            _log.info("step %d, loss %.3f%s", step, mean, f"; {accuracy(head, unseen)}" if unseen else "")
    return head.eval()


def collate(
    examples: Sequence[Example], rng: np.random.Generator | None = None
) -> tuple[
    Float[Tensor, "b n dim"], Tensor, Tensor, Float[Tensor, "b dim"], Bool[Tensor, "b n"], Float[Tensor, "b n 3"]
]:
    """Pad examples to one length: of all their patches, or with a generator of at most PATCHES random ones."""
    most = max(len(one.positions) for one in examples) if rng is None else PATCHES
    names = "keys", "photo", "places", "positions"
    batch = {name: torch.zeros(len(examples), most, getattr(examples[0], name).shape[1]) for name in names}
    foreground = torch.zeros(len(examples), most, dtype=torch.bool)
    for row, one in enumerate(examples):
        n = len(one.positions)
        chosen = torch.arange(n) if rng is None else torch.from_numpy(rng.permutation(n)[:most])
        for name in names:
            batch[name][row, : len(chosen)] = getattr(one, name)[chosen].float()
        foreground[row, : len(chosen)] = True
    image = torch.stack([one.image for one in examples])
    return batch["keys"], batch["photo"], batch["places"], image, foreground, batch["positions"]


@torch.no_grad()
def accuracy(head: PositionHead, examples: Sequence[Example]) -> str:
    """Format the share of pictures whose object axes are predicted within 45 degrees, in all and by category."""
    head.eval()
    right: dict[str, list[bool]] = {}
    for one in examples:
        keys, photo, places, image, foreground, positions = collate([one])
        found, true = head(keys, photo, places, image, foreground)[0], positions[0]
        turn = nearest_rotation(((true - true.mean(0)).T @ (found - found.mean(0)))[None])
        right.setdefault(one.category, []).append(bool(rotation_angles(turn, torch.eye(3)[None]) < 45))
    head.train()
    share = 100 * np.mean([one for found in right.values() for one in found])
    return f"axes within 45 degrees: {share:.0f} % (" + ", ".join(
        f"{category} {100 * np.mean(found):.0f}" for category, found in right.items()
    ) + ")"  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
