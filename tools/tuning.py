"""Fit the constants of the verified solver: score weights, calibration of the confidence and tie margin.

Run from the root of the repository, on objects of training categories:

    zsp-lite synth --category training --out outputs/training
    python -m tools.tuning outputs/training --pairs 30

The tool prints the fitted values; the constants in `zsp_lite/verified` are these, rounded. Folders with validation or
evaluation categories are refused, because the solver could then not be evaluated on them.

The weights are those of a conditional logit (McFadden 1974): among the hypotheses of a pair, the probability that one
is correct is the softmax of their scores. They are fitted to hypotheses that the solver finds with its present
weights; if the fitted ones differ much, run the tool again with these as defaults.
"""

import argparse
import logging
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from sklearn.linear_model import LogisticRegression

from zsp_lite.backbones.load import load_backbone
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import PoseLabel, read_labels, relative_pose
from zsp_lite.data.pairs import Pair, sample_pairs
from zsp_lite.errors import InputError
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.synthetic.export import SPLITS
from zsp_lite.verified import VerifiedSolver
from zsp_lite.verified.confidence import MODE_ANGLE, Calibration, reliability, score_margins
from zsp_lite.verified.verification import TERM_NAMES, ScoreWeights
from zsp_lite.views import extract_views, object_crop, usable_targets

CORRECT_ANGLE = 30.0  # degrees
# A hypothesis counts as correct to the degree exp(-(error / 12 degrees)^2); pairs without one above 0.3 are not used.
_SOFT_ANGLE, _MIN_CORRECTNESS = 12.0, 0.3
_WEIGHT_RIDGE = 1e-2
_CALIBRATION_RIDGE = 1e-3
_TIE_MARGINS = (0.25, 0.5, 1.0, 1.5, 2.0, 3.0)
_log = logging.getLogger("zsp_lite.tuning")
_Fit = TypeVar("_Fit")


@dataclass(frozen=True, eq=False)
class Outcome:
    """The hypotheses of the verified solver for one pair, with their errors.

    Attributes:
        category: Category of the pair.
        terms: (m, terms) score terms of the m hypotheses, in the order of `TERM_NAMES`.
        errors: (m,) rotation errors in degrees.
        angles: (m, m) angles between the hypotheses' rotations in degrees.
        view_std: Standard deviation of the target views' similarity to the reference.
    """

    category: str
    terms: Float[np.ndarray, "m terms"]
    errors: Float[np.ndarray, " m"]
    angles: Float[np.ndarray, "m m"]
    view_std: float = 0.0

    def best(self, weights: ScoreWeights) -> tuple[float, float]:
        """Return the score margin in nats and the error in degrees of the hypothesis with the highest score."""
        scores = self.terms @ np.array(astuple(weights))
        index = int(scores.argmax())
        return float(score_margins(scores, self.angles)[index]), float(self.errors[index])


def collect_outcomes(root: str, pairs: int, backbone: Any, n_targets: int = 5, seed: int = 0) -> list[Outcome]:
    """Run the verified solver on `pairs` pairs of each category of a folder.

    Raises:
        InputError: The folder has a validation or evaluation category, or a sequence has no pose label.
    """
    dataset = Co3D(root)
    categories = dataset.categories()
    check_training_categories(categories)
    outcomes = []
    for category in categories:
        labels = read_labels(root, category)
        sampled = sample_pairs(dataset, category, pairs, n_targets, seed)
        found = [solve_pair(dataset, pair, backbone, labels) for pair in sampled]
        outcomes += found
        accuracy = np.mean([one.errors[0] < CORRECT_ANGLE for one in found])
        _log.info("%s: %d pairs, Acc30 %.0f %%", category, len(found), 100 * accuracy)
    return outcomes


def check_training_categories(categories: Sequence[str]) -> None:
    """Raise InputError if one of the categories is a validation or evaluation category."""
    for category in categories:
        for split in ("validation", "evaluation"):
            if category in SPLITS[split]:
                raise InputError(f"category {category} is for {split}, expected only training categories")


def solve_pair(dataset: Co3D, pair: Pair, backbone: Any, labels: Mapping[str, PoseLabel]) -> Outcome:
    """Run the verified solver on one pair and compute the errors of its hypotheses."""
    method = ZeroShotPose(backbone, seed=pair.seed)
    reference, targets = dataset.load_pair(pair)
    reference, *targets = extract_views(backbone, [object_crop(frame) for frame in (reference, *targets)])
    targets = [targets[index] for index in usable_targets(targets)[0]]
    similarities = method.similarities(reference, targets)
    pairs = [method.match_pair(reference, target, sim) for target, sim in zip(targets, similarities)]
    solution = VerifiedSolver().solve(reference, targets, pairs, pair.seed)

    cameras = [target.frame.camera for target in targets]
    ends = labels[pair.reference_sequence], labels[pair.target_sequence]
    true = [relative_pose(ends[0], reference.frame.camera, ends[1], camera)[:3, :3] for camera in cameras]
    hypotheses = solution.hypotheses
    # Rotations to the targets' world, which hypotheses in different target views have in common.
    in_world = np.stack([cameras[one.view].R.T @ one.sim3.R for one in hypotheses])
    return Outcome(
        pair.category,
        np.array([[one.terms[name] for name in TERM_NAMES] for one in hypotheses]),
        np.array([rotation_error(one.sim3.R, true[one.view]) for one in hypotheses]),
        rotation_error(in_world[:, None], in_world[None]),
        solution.scene.view_similarity_std,
    )


def fit_weights(outcomes: Sequence[Outcome], ridge: float = _WEIGHT_RIDGE) -> ScoreWeights:
    r"""Fit the weights of a conditional logit with soft labels.

    Minimises -mean_pairs \log \sum_i softmax(S)_i c_i + ridge |w|^2 with c_i = \exp(-(error_i / 12 degrees)^2) and w
    the weights per standard deviation of their terms.

    Raises:
        InputError: No pair has a correct hypothesis among several.
    """
    correctness = [np.exp(-np.square(one.errors / _SOFT_ANGLE)) for one in outcomes]
    used = [
        (one.terms - one.terms.mean(axis=0), c)
        for one, c in zip(outcomes, correctness)
        if c.max() > _MIN_CORRECTNESS and len(c) > 1
    ]
    if not used:
        raise InputError(f"{len(outcomes)} pairs, none with a correct hypothesis among several, expected some")
    std = np.concatenate([terms for terms, _ in used]).std(axis=0) + 1e-9
    # One row per pair, padded to the longest list with hypotheses of probability 0.
    shape = len(used), max(len(c) for _, c in used)
    terms = torch.zeros(*shape, len(TERM_NAMES), dtype=torch.float64)
    log_correctness = torch.full(shape, -torch.inf, dtype=torch.float64)
    padding = torch.full(shape, -torch.inf, dtype=torch.float64)
    for row, (some, c) in enumerate(used):
        terms[row, : len(c)] = torch.from_numpy(some / std)
        log_correctness[row, : len(c)] = torch.from_numpy(np.log(c.clip(1e-12)))
        padding[row, : len(c)] = 0

    w = torch.zeros(len(TERM_NAMES), dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([w], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> Float[torch.Tensor, ""]:
        optimiser.zero_grad()
        score = terms @ w + padding
        negative = torch.logsumexp(score, dim=1) - torch.logsumexp(score + log_correctness, dim=1)
        value = negative.mean() + ridge * w.square().sum()
        value.backward()
        return value

    with torch.enable_grad():
        optimiser.step(loss)
    return ScoreWeights(*(float(value) for value in w.detach().numpy() / std))


def fit_calibration(
    margin: Float[np.ndarray, " n"],
    view_std: Float[np.ndarray, " n"],
    correct: Bool[np.ndarray, " n"],
    ridge: float = _CALIBRATION_RIDGE,
) -> Calibration:
    """Fit the calibration by logistic regression.

    Args:
        margin: Score margins of n estimates, nats.
        view_std: Standard deviations of their view similarities.
        correct: Which of the estimates were correct.
        ridge: Penalty on the coefficients per standard deviation of their inputs.

    Raises:
        InputError: All estimates are correct, or all are wrong.
    """
    if correct.min() == correct.max():
        raise InputError(
            f"all {len(correct)} estimates are {'correct' if correct[0] else 'wrong'}, expected both kinds"
        )
    inputs = np.stack([margin, view_std], axis=1)
    std = inputs.std(axis=0) + 1e-9
    model = LogisticRegression(C=1 / (ridge * len(correct)), tol=1e-8).fit(inputs / std, correct)
    return Calibration(float(model.intercept_[0]), *(float(value) for value in model.coef_[0] / std))


def calibrate(outcomes: Sequence[Outcome], weights: ScoreWeights) -> Calibration:
    """Fit the calibration of the hypotheses with the highest score under the weights."""
    margin, error = np.array([one.best(weights) for one in outcomes]).T
    return fit_calibration(margin, _view_stds(outcomes), error < CORRECT_ANGLE)


def leave_one_out(outcomes: Sequence[Outcome], fit: Callable[[Sequence[Outcome]], _Fit]) -> list[_Fit]:
    """Return for each outcome the fit to the outcomes of all other categories."""
    categories = dict.fromkeys(one.category for one in outcomes)
    fitted = {name: fit([one for one in outcomes if one.category != name]) for name in categories}
    return [fitted[one.category] for one in outcomes]


def tie_statistics(
    outcomes: Sequence[Outcome], weights: ScoreWeights, margins: Sequence[float]
) -> list[tuple[float, int, float]]:
    """For each margin in nats: the margin, the number of pairs below it, and the fraction of them that is correct."""
    margin, error = np.array([one.best(weights) for one in outcomes]).T
    rows = []
    for limit in margins:
        correct = error[margin < limit] < CORRECT_ANGLE
        rows.append((limit, len(correct), float(correct.mean()) if len(correct) else float("nan")))
    return rows


def report(outcomes: Sequence[Outcome]) -> list[str]:
    """Format the fits and their accuracy. Accuracies of fits are on categories that the fit has not seen."""
    weights, present = fit_weights(outcomes), ScoreWeights()
    present_margin, present_error = np.array([one.best(present) for one in outcomes]).T
    fits = leave_one_out(outcomes, lambda some: (w := fit_weights(some), calibrate(some, w)))
    margin, error = np.array([one.best(w) for one, (w, _) in zip(outcomes, fits)]).T
    view_std = _view_stds(outcomes)
    confidence = np.array([c.confidence(m, std) for (_, c), m, std in zip(fits, margin, view_std)])
    calibration = calibrate(outcomes, present)
    margin_only = fit_calibration(present_margin, np.zeros(len(outcomes)), present_error < CORRECT_ANGLE)
    lines = [
        f"{len(outcomes)} pairs of {len({one.category for one in outcomes})} categories",
        f"present weights                    {_accuracy(present_error)}",
        f"fitted weights, held-out category  {_accuracy(error)}",
        f"most accurate hypothesis           {_accuracy(np.array([one.errors.min() for one in outcomes]))}",
        "weights: " + ", ".join(f"{name} {value:.1f}" for name, value in asdict(weights).items()),
        f"calibration of the present weights: bias {calibration.bias:.2f}, margin {calibration.margin:.3f}, "
        f"view_std {calibration.view_std:.1f}",
        f"calibration from the margin only: bias {margin_only.bias:.2f}, margin {margin_only.margin:.3f}",
        "confidence, held-out category:",
        str(reliability(confidence, error < CORRECT_ANGLE, min(10, len(outcomes)))),
        f"pairs with a rival more than {MODE_ANGLE:.0f} degrees away within a margin (nats), and their accuracy:",
    ]
    for limit, count, accuracy in tie_statistics(outcomes, present, _TIE_MARGINS):
        lines.append(f"{limit:6.2f} {count:5d}" + (f" {100 * accuracy:5.0f} %" if count else ""))
    return lines


def _view_stds(outcomes: Sequence[Outcome]) -> Float[np.ndarray, " n"]:
    return np.array([one.view_std for one in outcomes])


def _accuracy(errors: Float[np.ndarray, " n"]) -> str:
    return (
        f"median {np.median(errors):.1f} degrees, Acc30 {100 * np.mean(errors < 30):.1f} %, "
        f"Acc15 {100 * np.mean(errors < 15):.1f} %"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.tuning", description=__doc__.split("\n")[0])
    parser.add_argument("root", nargs="+", help="folder of training categories in CO3D's layout, with pose labels")
    parser.add_argument("--pairs", type=int, default=30, metavar="N", help="pairs per category (default 30)")
    parser.add_argument("--targets", type=int, default=5, metavar="N", help="target views per pair (default 5)")
    parser.add_argument("--backbone", default="zsp-tiny", help="name or checkpoint (default zsp-tiny)")
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        for root in given.root:
            check_training_categories(Co3D(root).categories())
        backbone = load_backbone(given.backbone)
        with torch.no_grad():
            outcomes = [o for root in given.root for o in collect_outcomes(root, given.pairs, backbone, given.targets)]
        print("\n".join(report(outcomes)))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
