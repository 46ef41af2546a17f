"""How the verified solver's numbers were chosen: weights, calibration and the bound of "equally good".

    python -m zsp_lite.benchmark.tuning ROOT --pairs N

ROOT holds objects of training categories (`zsp-lite synth --category training`); validation and evaluation categories
are refused, for a solver fitted to them could not be judged by them. The weights are a conditional logit: the chance
that of a pair's hypotheses one is right is in proportion to e^score, and the pairs seen are to be as likely as can be.
Weights under which the search would have found other hypotheses ask for another round.
"""

import argparse
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float

from zsp_lite.benchmark.store import FrameStore
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import PoseLabel, read_labels, relative_pose
from zsp_lite.data.pairs import Pair, sample_pairs
from zsp_lite.errors import InputError
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.synthetic.export import SPLITS
from zsp_lite.verified import VerifiedSolver
from zsp_lite.verified.confidence import MODES_APART, Calibration, fit_calibration, margins, reliability
from zsp_lite.verified.verification import TERMS, Weights

# Errors of so many degrees make a hypothesis e times less right; what no hypothesis comes near teaches nothing.
_RIGHT_WIDTH, _TEACHES = 12.0, 0.3
_RIDGE = 1e-2
_RIGHT = 30.0
_Fit = TypeVar("_Fit")


@dataclass(frozen=True, eq=False)
class Outcome:
    """What the solver found for one pair of a category.

    terms: of its m hypotheses, in the order of `TERMS`.  errors: their rotation errors in degrees.  apart: degrees
    between them.  spread: of the target views' likeness to the reference.
    """

    category: str
    terms: Float[np.ndarray, "m terms"]
    errors: Float[np.ndarray, " m"]
    apart: Float[np.ndarray, "m m"]
    spread: float = 0.0

    def scores(self, weights: Weights) -> Float[np.ndarray, " m"]:
        """The hypotheses' scores under some weights."""
        return self.terms @ np.array(astuple(weights))

    def best(self, weights: Weights) -> tuple[float, float, float]:
        """Score, margin and error in degrees of the hypothesis that some weights prefer."""
        scores = self.scores(weights)
        at = int(scores.argmax())
        return float(scores[at]), float(margins(scores, self.apart)[at]), float(self.errors[at])


def collect(root: str, pairs: int, backbone: Any, n_targets: int = 5, seed: int = 0,
            said: Callable[[str], None] = lambda line: None) -> list[Outcome]:  # fmt: skip
    """The verified solver's outcomes on `pairs` pairs of each category in a folder.  said: is told each category.

    Raises InputError where the folder holds a validation or evaluation category, or a sequence without a pose label.
    """
    dataset = Co3D(root)
    categories = dataset.categories()
    check_training(categories)
    outcomes = []
    for category in categories:
        store, labels = FrameStore(dataset, category, {"backbone": backbone}), read_labels(root, category)
        found = [outcome(pair, store, labels) for pair in sample_pairs(dataset, category, pairs, n_targets, seed)]
        outcomes += found
        right = np.mean([one.errors[0] < _RIGHT for one in found])
        said(f"{category}: {len(found)} pairs, {100 * right:.0f} % within 30 degrees")
    return outcomes


def check_training(categories: Sequence[str]) -> None:
    """Raises InputError where one of the categories is for validation or evaluation."""
    for category in categories:
        for split in ("validation", "evaluation"):
            if category in SPLITS[split]:
                raise InputError(f"category {category} is for {split}, expected training categories alone to tune on")


def outcome(pair: Pair, store: FrameStore, labels: Mapping[str, PoseLabel]) -> Outcome:
    """One pair, solved and judged."""
    first, second = labels[pair.reference_sequence], labels[pair.target_sequence]
    keys = [(pair.reference_sequence, pair.reference_frame), *((pair.target_sequence, n) for n in pair.target_frames)]
    store.load(keys)
    solver = ZeroShotPose(store.extractors["backbone"], solver="verified", seed=pair.seed)
    settings = solver.foreground, solver.saliency_threshold
    reference, *targets = [store.view("backbone", key, *settings) for key in keys]
    sims = solver.similarities(reference, targets)
    pairs = [solver.match_pair(reference, target, sim) for target, sim in zip(targets, sims)]
    solution = VerifiedSolver().solve(reference, targets, pairs, pair.seed)
    found = solution.hypotheses
    cameras = [target.frame.camera for target in targets]
    truth = [relative_pose(first, reference.frame.camera, second, camera)[:3, :3] for camera in cameras]
    errors = np.array([rotation_error(one.sim3.R, truth[one.view]) for one in found])
    # Seen from the target's world, so that hypotheses against different views can be compared.
    turned = np.stack([cameras[one.view].R.T @ one.sim3.R for one in found])
    return Outcome(
        pair.category, np.array([[one.terms[name] for name in TERMS] for one in found]), errors,
        rotation_error(turned[:, None], turned[None]), solution.scene.spread,
    )  # fmt: skip


def fit_weights(outcomes: Sequence[Outcome], ridge: float = _RIDGE) -> Weights:
    """The weights of a conditional logit: -sum log sum_i softmax(score)_i right_i, right_i = exp(-(error / 12)^2).

    ridge: of the weights per standard deviation of their terms. Raises InputError where no pair has a right hypothesis.
    """
    rights = [np.exp(-np.square(one.errors / _RIGHT_WIDTH)) for one in outcomes]
    taught = [(one.terms, right) for one, right in zip(outcomes, rights) if right.max() > _TEACHES and len(right) > 1]
    if not taught:
        raise InputError(f"{len(outcomes)} pairs, none with a right hypothesis among several, expected some")
    spread = np.concatenate([terms - terms.mean(axis=0) for terms, _ in taught]).std(axis=0) + 1e-9
    # One row per pair, as long as the longest; what is beyond a pair's hypotheses has no chance.
    longest = max(len(right) for _, right in taught)
    terms = torch.zeros(len(taught), longest, len(TERMS), dtype=torch.float64)
    right = torch.full((len(taught), longest), -torch.inf, dtype=torch.float64)
    there = torch.full_like(right, -torch.inf)
    for row, (some, how_right) in enumerate(taught):
        n = len(how_right)
        terms[row, :n] = torch.from_numpy((some - some.mean(axis=0)) / spread)
        right[row, :n] = torch.from_numpy(np.log(how_right.clip(1e-12)))
        there[row, :n] = 0
    with torch.enable_grad():
        w = torch.zeros(len(TERMS), dtype=torch.float64, requires_grad=True)
        descent = torch.optim.LBFGS([w], max_iter=200, line_search_fn="strong_wolfe")

        def loss() -> Float[torch.Tensor, ""]:
            descent.zero_grad()
            score = terms @ w + there
            lost = torch.logsumexp(score, dim=1) - torch.logsumexp(score + right, dim=1)
            value = lost.mean() + ridge * w.square().sum()
            value.backward()
            return value

        descent.step(loss)
    return Weights(*(float(value) for value in w.detach().numpy() / spread))


def calibrate(outcomes: Sequence[Outcome], weights: Weights) -> Calibration:
    """The calibration of the hypotheses that the weights prefer."""
    _, margin, error = np.array([one.best(weights) for one in outcomes]).T
    return fit_calibration(margin, _spreads(outcomes), error < _RIGHT)


def _spreads(outcomes: Sequence[Outcome]) -> Float[np.ndarray, " n"]:
    return np.array([one.spread for one in outcomes])


def leave_one_out(outcomes: Sequence[Outcome], fit: Callable[[Sequence[Outcome]], _Fit]) -> list[_Fit]:
    """For each outcome what was fitted without its category."""
    categories = dict.fromkeys(one.category for one in outcomes)
    fitted = {name: fit([one for one in outcomes if one.category != name]) for name in categories}
    return [fitted[one.category] for one in outcomes]


def equally_good_shares(
    outcomes: Sequence[Outcome], weights: Weights, bounds: Sequence[float]
) -> list[tuple[float, int, float]]:
    """Per bound in nats: the bound, how many pairs have a rival within it, and the share whose best is right."""
    _, margin, error = np.array([one.best(weights) for one in outcomes]).T
    rows = []
    for bound in bounds:
        right = error[margin < bound] < _RIGHT
        rows.append((bound, len(right), float(right.mean()) if len(right) else float("nan")))
    return rows


def report(outcomes: Sequence[Outcome]) -> list[str]:
    """What the outcomes teach, for people to read: nothing is fitted to the category that it is judged on."""
    weights, now = fit_weights(outcomes), Weights()
    found_now = np.array([one.best(now) for one in outcomes])
    others = leave_one_out(outcomes, lambda some: (w := fit_weights(some), calibrate(some, w)))
    judged = np.array([one.best(w) for one, (w, _) in zip(outcomes, others)])
    trust = np.concatenate([
        one.confidence(found[1:2], spread) for (_, one), found, spread in zip(others, judged, _spreads(outcomes))
    ])  # fmt: skip
    nearest = np.array([one.errors.min() for one in outcomes])
    lines = [
        f"{len(outcomes)} pairs of {len({one.category for one in outcomes})} categories",
        f"present weights           {_accuracy(found_now[:, 2])}",
        f"fitted, left-out category {_accuracy(judged[:, 2])}",
        f"nearest hypothesis        {_accuracy(nearest)}",
        "weights      " + ", ".join(f"{name} {value:.1f}" for name, value in asdict(weights).items()),
    ]
    present = calibrate(outcomes, now)
    lines.append(
        f"calibration of the present weights: bias {present.bias:.2f}, margin {present.margin:.3f}, "
        f"spread {present.spread:.1f}"
    )
    alone = fit_calibration(found_now[:, 1], np.zeros(len(outcomes)), found_now[:, 2] < _RIGHT)
    lines.append(f"from the margin alone: bias {alone.bias:.2f}, margin {alone.margin:.3f}")
    lines += ["confidence, left-out category:", str(reliability(trust, judged[:, 2] < _RIGHT, min(10, len(trust))))]
    lines.append(f"rivals more than {MODES_APART:.0f} degrees apart within so many nats: pairs, of these right")
    for bound, count, right in equally_good_shares(outcomes, now, (0.25, 0.5, 1.0, 1.5, 2.0, 3.0)):
        lines.append(f"{bound:6.2f} {count:5d}" + (f" {100 * right:5.0f} %" if count else ""))
    return lines


def _accuracy(errors: Float[np.ndarray, " n"]) -> str:
    return (
        f"median {np.median(errors):.1f} degrees, Acc30 {100 * np.mean(errors < 30):.1f} %, "
        f"Acc15 {100 * np.mean(errors < 15):.1f} %"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line: see above."""
    parser = argparse.ArgumentParser(prog="python -m zsp_lite.benchmark.tuning", description=__doc__.split("\n")[0])
    parser.add_argument("root", nargs="+", help="folders of training categories in CO3D's layout, with pose labels")
    parser.add_argument("--pairs", type=int, default=30, metavar="N", help="pairs per category (default 30)")
    parser.add_argument("--targets", type=int, default=5, metavar="N", help="target views per pair (default 5)")
    parser.add_argument("--backbone", default="zsp-tiny", help="name or checkpoint (default zsp-tiny)")
    given = parser.parse_args(arguments)
    try:
        from zsp_lite import load_backbone

        for root in given.root:
            check_training(Co3D(root).categories())
        backbone, outcomes = load_backbone(given.backbone), []
        with torch.no_grad():
            for root in given.root:
                outcomes += collect(
                    root, given.pairs, backbone, given.targets, said=lambda line: print(line, flush=True)
                )
        print("\n".join(report(outcomes)))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
