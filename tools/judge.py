"""Fit the constants of `scans.judge`, and those of `scans.category` to what it judges.

    python -m tools.judge outputs/validation outputs/validation_scans

Pairs of objects of validation categories are judged in several settings: scans all around, with
noise, with an object that lies, within arcs, and a single image. The tool prints the constants, and
how well they do on categories left out of the fit. docs/rebuild.md makes the data.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from zsp_lite.backbones.load import load_backbone
from zsp_lite.benchmark.problem import FrameStore
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.evaluation import spread
from zsp_lite.data.frames import Frame
from zsp_lite.data.labels import read_labels
from zsp_lite.io.files import stable_hash
from zsp_lite.metrics import SAME_ANGLE, rotation_angle
from zsp_lite.scans import category as synchronisation
from zsp_lite.scans.category import PairHypotheses, synchronise
from zsp_lite.scans.judge import Votes, asked_positions, judge, score_terms
from zsp_lite.scans.shapes import Shape
from zsp_lite.threads import one_thread

# The arc in degrees and the number of frames of both objects.
_SETTINGS = {
    "all around": ((360, 5), (360, 5)),
    "noise": ((360, 5), (360, 5)),
    "arcs": ((150, 5), (150, 5)),
    "arc and all around": ((100, 5), (360, 5)),
    "single image": ((360, 5), (1, 1)),
}
_OBJECTS = 4  # of a category
_PAIRS = 4  # of them in each setting but the first, which has all
_RIDGE = 3e-3
# Categories of models whose labels do not tell what is alike: fans hang or stand.
_LEFT_OUT = ("fan", "mailbox")


class Noisy(Co3D):
    """A data set whose poses, depth and masks are disturbed, as those of hand-held captures are."""

    def load(self, annotation: Frame) -> Frame:
        """Load a frame: 2 degrees and 1 % of the distance off, depth off by 1 to 2 % in patches of
        ten pixels, and a mask that is up to three pixels too large or too small."""
        frame = super().load(annotation)
        rng = np.random.default_rng(stable_hash(frame.name) >> 1)
        camera = frame.camera
        turn = Rotation.from_rotvec(np.radians(2) * rng.normal(size=3)).as_matrix()
        shift = 0.01 * np.linalg.norm(camera.t) * rng.normal(size=3)
        patches = cv2.GaussianBlur(rng.normal(size=frame.depth.shape), (0, 0), 3)
        change = cv2.dilate if rng.random() < 0.5 else cv2.erode
        mask = change(frame.mask, np.ones((3, 3)), iterations=int(rng.integers(4)))
        depth = (frame.depth * (1 + 0.06 * patches)).astype(np.float32)
        camera = replace(camera, R=turn @ camera.R, t=turn @ camera.t + shift)
        return replace(frame, camera=camera, depth=depth, mask=mask)


@dataclass
class Example:
    """A pair of objects in a setting, with a number of frames of each that were solved."""

    category: str
    setting: str
    frames: int
    terms: Float[np.ndarray, "m 5"]
    right: Bool[np.ndarray, " m"]  # candidates within 30 degrees of the truth
    same: Bool[np.ndarray, "m m"]  # candidates within 30 degrees of each other


def collect(root: str, category: str) -> tuple[list[Example], list[PairHypotheses], dict]:
    """Judge pairs of a category in all settings.

    Returns the examples, what the present constants judge of the pairs all around, and the
    rotations of the labels.
    """
    plain = Co3D(root)
    extractors = {"backbone": load_backbone(device="cpu")}
    stores = {False: FrameStore(plain, extractors), True: FrameStore(Noisy(root), extractors)}
    labels = {
        name: label.trans[:3, :3]
        for name, label in list(read_labels(root, category).items())[:_OBJECTS]
    }
    numbers = plain.frame_numbers(category)
    examples, judged = [], []
    for setting, ends in _SETTINGS.items():
        store = stores[setting == "noise"]
        pairs = list(combinations(labels, 2))
        rng = np.random.default_rng(stable_hash(f"{category} {setting}") >> 1)
        if setting != "all around":
            pairs = [pairs[k] for k in rng.permutation(len(pairs))[:_PAIRS]]
        for names in pairs:
            seen, frames, order = {}, {}, {}
            for name, (arc, count) in zip(names, ends):
                every = numbers[name]
                start = 0 if arc == 360 else int(rng.integers(len(every)))
                length = max(1, round(len(every) * arc / 360))
                seen[name] = tuple(every[(start + k) % len(every)] for k in range(length))
                frames[name] = tuple(seen[name][k] for k in spread(count, length))
                order[name] = [frames[name][k] for k in asked_positions(4, len(frames[name]))]
            shapes = {name: store.shape(category, name, seen[name]) for name in names}
            true = labels[names[1]] @ labels[names[0]].T
            ranked = []
            for a, b in (names, names[::-1]):
                for rank, number in enumerate(order[a]):
                    found = store.hypotheses(Pair(category, a, number, b, frames[b]))
                    if found is not None:
                        ranked.append((rank, found))
            for most in (2, 4):
                answers = [found for rank, found in ranked if rank < most]
                examples.append(example((category, setting, most), shapes, names, answers, true))
            if setting == "all around":
                judged.append(judge(names, shapes, answers))
                shapes[names[1]] = lying(shapes[names[1]])
                setting_of = (category, "an object lies", 4)
                examples.append(example(setting_of, shapes, names, answers, true))
    return examples, judged, labels


def lying(shape: Shape) -> Shape:
    """Return the shape of an object with a horizontal axis as its vertical."""
    turn = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    from_world = replace(shape.from_world, R=turn @ shape.from_world.R, t=turn @ shape.from_world.t)
    return Shape(shape.points @ turn.T, from_world, shape.upright, shape.span)


def example(
    what: tuple[str, str, int],
    shapes: dict[str, Shape],
    names: tuple[str, str],
    answers: Sequence[PairHypotheses],
    true: Float[np.ndarray, "3 3"],
) -> Example:
    """Compute the terms of a pair's candidates, and which of them are right."""
    first, second = (shapes[name] for name in names)
    candidates, terms, _ = score_terms(first, second, Votes(names[0], answers))
    same = rotation_angle(candidates[:, None], candidates) < SAME_ANGLE
    return Example(*what, terms, rotation_angle(candidates, true) < SAME_ANGLE, same)


def log_probabilities(
    terms: Float[torch.Tensor, "n m 5"], weights: Float[torch.Tensor, "6"]
) -> Float[torch.Tensor, "n m1"]:
    """Return the logarithms of the probabilities of the candidates and, last, of none."""
    scores = terms @ weights[:-1]
    none = weights[-1].expand(len(scores), 1)
    return torch.cat([scores, none], dim=1).log_softmax(dim=1)


def padded(examples: Sequence[Example]) -> Float[torch.Tensor, "n m 5"]:
    """Stack the terms of examples, padded with candidates of probability 0."""
    most = max(len(one.terms) for one in examples)
    rows = np.full((len(examples), most, 5), -1e3)
    rows[:, :, [1, 3]] = 0.0
    for row, one in zip(rows, examples):
        row[: len(one.terms)] = one.terms
    return torch.from_numpy(rows)


def fit(examples: Sequence[Example]) -> Float[torch.Tensor, "6"]:
    """Fit weights and the score of no right candidate by maximum likelihood, with a ridge on
    weights per standard deviation of their terms; every category counts the same."""
    terms = padded(examples)
    right = torch.zeros(len(examples), terms.shape[1] + 1, dtype=torch.bool)
    for row, one in zip(right, examples):
        row[: len(one.right)] = torch.from_numpy(one.right)
        row[-1] = not one.right.any()
    names = [one.category for one in examples]
    importance = torch.tensor([1 / names.count(name) for name in names], dtype=torch.float64)
    spread_of = torch.from_numpy(np.concatenate([one.terms for one in examples]).std(axis=0))
    weights = torch.ones(6, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([weights], max_iter=300, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        masked = log_probabilities(terms, weights).masked_fill(~right, -1e9)
        value = -importance @ masked.logsumexp(dim=1) / importance.sum()
        value = value + _RIDGE * (weights[:-1] * spread_of).square().sum()
        value.backward()
        return value

    optimiser.step(loss)
    return weights.detach()


def left_out(examples: Sequence[Example]) -> Iterator[tuple[Example, float, bool]]:
    """Yield each example with the probability of its best pose by a fit without its category, and
    whether that pose is right."""
    for name in sorted({one.category for one in examples}):
        weights = fit([one for one in examples if one.category != name])
        for one in (one for one in examples if one.category == name):
            odds = log_probabilities(padded([one]), weights)[0].exp().numpy()[:-1]
            best = int(odds.argmax())
            yield one, float(odds[: len(one.same)] @ one.same[best]), bool(one.right[best])


def report(found: Sequence[tuple[Example, float, bool]]) -> None:
    """Print the share of right poses, the mean probability, and the calibration error in five bins
    of equal count."""
    p = np.array([probability for _, probability, _ in found])
    right = np.array([is_right for *_, is_right in found])
    bins = np.array_split(np.argsort(p), 5)
    error = 100 * sum(abs((p[part] - right[part]).sum()) for part in bins) / len(p)
    sure = right[p > 0.8]
    print(
        f"{100 * right.mean():.1f} % right, mean probability {100 * p.mean():.1f} %, calibration "
        f"error {error:.1f} points; above 0.8 {100 * sure.mean():.1f} % of {len(sure)}"
    )


def category_examples(
    pairs: Sequence[PairHypotheses], labels: dict[str, Float[np.ndarray, "3 3"]]
) -> Iterator[tuple[float, float, int]]:
    """Align sets of three and four objects; yield for each object the terms of
    `category._judge`, and 0, 1 or 2 if its pose, its alternative or neither is right.

    The terms are computed back from the probabilities that the present constants give.
    """
    for names in (names for size in (3, 4) for names in combinations(labels, size)):
        objects = synchronise([one for one in pairs if {one.reference, one.target} <= {*names}])
        frames = np.stack([one.sim3.R @ labels[name] for name, one in objects.objects.items()])
        agreeing = (rotation_angle(frames[:, None], frames) < SAME_ANGLE).sum(axis=1)
        common = frames[agreeing.argmax()]
        for name, one in objects.objects.items():
            other = one.alternative or one.sim3
            turns = rotation_angle(np.stack([one.sim3.R, other.R]) @ labels[name], common)
            right = [*(turns < SAME_ANGLE), True].index(True)
            neither = 1 - one.probability - one.alternative_probability
            odds = np.array([one.alternative_probability, neither]) / one.probability
            margin, none = np.log(odds + 1e-30)
            agree = (none - synchronisation.NONE) / synchronisation.NONE_AGREEING
            yield margin / -synchronisation.MARGIN, agree, right


def fit_category(rows: Float[np.ndarray, "n 3"]) -> Float[torch.Tensor, "3"]:
    """Fit MARGIN, NONE and NONE_AGREEING by maximum likelihood, with a ridge."""
    margin, agreeing, right = torch.from_numpy(rows).T
    x = torch.ones(3, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([x], max_iter=300, line_search_fn="strong_wolfe")

    def loss() -> torch.Tensor:
        optimiser.zero_grad()
        scores = torch.stack([0 * margin, -x[0] * margin, x[1] + x[2] * agreeing], dim=1)
        value = torch.nn.functional.cross_entropy(scores, right.long()) + 1e-3 * x.square().sum()
        value.backward()
        return value

    optimiser.step(loss)
    return x.detach()


def main(*roots: str) -> None:
    """Fit to the examples of all categories, and print."""
    examples: list[Example] = []
    rows: list[tuple[float, float, int]] = []
    for root in roots:
        for category in Co3D(root).categories():
            labelled = read_labels(root, category)
            if len(labelled) < 2 or category in _LEFT_OUT:
                continue
            with one_thread():
                found, judged, labels = collect(root, category)
            examples += found
            if len(labels) > 2:
                rows += category_examples(judged, labels)
            print(f"{root}/{category}: {len(found)} examples", flush=True)
    weights = fit(examples)
    print("WEIGHTS:", weights[:-1].numpy().round(2), "NONE:", weights[-1].numpy().round(2))
    found = list(left_out(examples))
    report(found)
    for setting, frames in dict.fromkeys((one.setting, one.frames) for one in examples):
        print(f"{setting}, {frames} frames: ", end="")
        report([row for row in found if (row[0].setting, row[0].frames) == (setting, frames)])
    print("MARGIN, NONE, NONE_AGREEING:", fit_category(np.array(rows)).numpy().round(2))


if __name__ == "__main__":
    main(*sys.argv[1:])
