"""Fit the constants of the verified solver: weights of the score, of the channels of `agreement`, and the calibration.

Run from the root of the repository. The weights are fitted on training categories, the calibration on validation
categories, that neither the backbone nor the weights were fitted on. docs/rebuild.md makes the data:

    python -m tools.tuning weights outputs/training_poses:30 outputs/training:30
    python -m tools.tuning orientation outputs/training_poses:36 --head outputs/head_{1,2,3,4}.safetensors
    python -m tools.tuning agreement outputs/training8:16 outputs/variants:8 --out outputs/agreement.safetensors
    python -m tools.tuning calibration outputs/{validation:10,validation_poses:20,validation_variants:4}

FOLDER:PAIRS is a data folder and the number of pairs of each of its categories. Folders with categories of another
side (`concepts.csv`) are refused. The tool prints the fitted values and how well they do on categories left out of the
fit; the constants in `zsp_lite/verified` are these, rounded.

The terms `orientation` and `agreement` were trained on training categories themselves. Therefore the fit of the weights
leaves both out, in the search for hypotheses as well, and prints 0 for them. That of `orientation` searches without
both, too, and uses each position head on the categories that it was trained without (`tools/position_head.py
--without`). That of the agreement searches without `agreement`, and leaves `orientation` out of the score.

All weights are those of a conditional logit (McFadden 1974): among the hypotheses of a pair, the probability
that one is correct is the softmax of their scores. They are fitted to hypotheses that the solver finds with its present
weights; if the fitted ones differ much, run the tool again with these as defaults.
"""

import argparse
import logging
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, astuple, dataclass, replace
from itertools import chain, product
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from safetensors.torch import save_file

from tools.concepts import DATA_HELP, check_sides, folder_and_pairs
from tools.position_head import WITHOUT
from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.checkpoints import read_checkpoint
from zsp_lite.backbones.load import load_backbone
from zsp_lite.backbones.positions import load_position_head
from zsp_lite.backbones.pretrained import DEFAULT
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import PoseLabel, read_labels, relative_pose
from zsp_lite.data.pairs import sample_pairs
from zsp_lite.errors import InputError
from zsp_lite.metrics import rotation_error
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.verified import VerifiedSolver
from zsp_lite.verified.agreement import channel_agreement
from zsp_lite.verified.confidence import Calibration, different_poses, modes, reliability
from zsp_lite.verified.verification import FEATURE_TERMS, TERM_NAMES, ScoreWeights
from zsp_lite.views import View, usable_targets

CORRECT_ANGLE = 30.0  # degrees
# A hypothesis counts as correct to the degree exp(-(error / 12 degrees)^2); pairs without one above 0.3 are not used.
_SOFT_ANGLE, _MIN_CORRECTNESS = 12.0, 0.3
_WEIGHT_RIDGE = 1e-2
_AGREEMENT_RIDGE, _FOLDS = 2.0, 5
_CALIBRATION_RIDGE = 1e-3
_VIEWS = (1, 2, 3, 5, 7, 10)  # of the calibration
# Terms that the search for hypotheses leaves out, by what is fitted.
_UNUSED = {
    "weights": ("orientation", "agreement"), "orientation": ("orientation", "agreement"), "agreement": ("agreement",),
    "calibration": (),
}  # fmt: skip
_UNTRAINED = np.array([name not in _UNUSED["weights"] for name in TERM_NAMES])
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
        n_views: Number of usable target views.
        channels: (m, channels) agreement of every channel (see `verified.agreement`); None without photo features.
    """

    category: str
    terms: Float[np.ndarray, "m terms"]
    errors: Float[np.ndarray, " m"]
    angles: Float[np.ndarray, "m m"]
    view_std: float = 0.0
    n_views: int = 5
    channels: Float[np.ndarray, "m channels"] | None = None

    @property
    def correctness(self) -> Float[np.ndarray, " m"]:
        """How correct each hypothesis is, in [0, 1]."""
        return np.exp(-np.square(self.errors / _SOFT_ANGLE))

    @property
    def informative(self) -> bool:
        """Whether there are several hypotheses, one of them correct enough to learn from."""
        return len(self.errors) > 1 and bool(self.correctness.max() > _MIN_CORRECTNESS)

    def ranked(self, weights: ScoreWeights) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Return by how many nats each different pose is below the best under the weights, and its error."""
        scores = self.terms @ np.array(astuple(weights))
        order = np.argsort(-scores, kind="stable")
        different = order[different_poses(modes(self.angles[np.ix_(order, order)]))]
        return scores[order[0]] - scores[different], self.errors[different]

    def circumstances(self, weights: ScoreWeights) -> tuple[int, float, float]:
        """Return what the probability of "none of these" depends on: number of views, view_std and shape fit."""
        best = self.terms[(self.terms @ np.array(astuple(weights))).argmax()]
        return self.n_views, self.view_std, float(best @ np.array(astuple(weights.without(*FEATURE_TERMS))))


def unseen_categories(heads: Sequence[Path]) -> list[list[str]]:
    """Return for each file of a position head the categories that the head was trained without.

    Raises:
        InputError: A file is damaged or names no such categories, or two files name the same one.
    """
    found = [read_checkpoint(file)[1].get(WITHOUT, "").split() for file in heads]
    for index, (file, names) in enumerate(zip(heads, found)):
        if not names:
            raise InputError(f"{file}: trained on all categories, expected a head of tools.position_head --without")
        if repeated := set(names).intersection(chain(*found[:index])):
            raise InputError(f"{file}: trained without {sorted(repeated)[0]}, as an earlier head, expected one of them")
    return found


def use_head(backbone: Backbone, file: Path) -> None:
    """Replace a backbone's position head by that of a file.

    Raises:
        InputError: The backbone has no position head, or the file is damaged.
    """
    if getattr(backbone, "position_head", None) is None:
        raise InputError(f"backbone {backbone.name} has no position head, expected one with it")
    dims = backbone.position_head.key.in_features, backbone.position_head.photo.in_features
    backbone.position_head = load_position_head(file, *dims)


def collect_outcomes(
    root: str | Path, pairs: int, backbone: Any, solver: VerifiedSolver, view_numbers: Sequence[int], seed: int = 0,
    categories: Sequence[str] | None = None,
) -> list[Outcome]:  # fmt: skip
    """Run the verified solver on `pairs` pairs of each category of a folder, for each of several numbers of views.

    Features are extracted once per image. `categories`, as FOLDER/CATEGORY, takes only some of the folder's.

    Raises:
        InputError: A sequence has no pose label.
    """
    dataset, outcomes = Co3D(root), []
    for category in dataset.categories():
        name = f"{Path(root).name}/{category}"  # folders may mean different objects by one name
        if categories is not None and name not in categories:
            continue
        labels, views = read_labels(root, category), {}
        for n_targets in view_numbers:
            found = []
            for pair in sample_pairs(dataset, category, pairs, n_targets, seed):
                method = ZeroShotPose(backbone, solver=solver, seed=pair.seed)
                frames = [
                    (pair.reference_sequence, pair.reference_frame),
                    *((pair.target_sequence, number) for number in pair.target_frames),
                ]
                new = [one for one in frames if one not in views]
                views |= zip(new, method.views(dataset.load(dataset.frame(category, *one)) for one in new))
                reference, *targets = (views[one] for one in frames)
                ends = labels[pair.reference_sequence], labels[pair.target_sequence]
                found.append(solve_views(method, name, reference, targets, ends))
            outcomes += found
            accuracy = np.mean([one.errors[0] < CORRECT_ANGLE for one in found])
            _log.info("%s: %d pairs of %d views, Acc30 %.0f %%", category, len(found), n_targets, 100 * accuracy)
    return outcomes


def solve_views(
    method: ZeroShotPose, category: str, reference: View, targets: Sequence[View], labels: tuple[PoseLabel, PoseLabel]
) -> Outcome:
    """Run a method's verified solver on the views of a pair and compute the errors of its hypotheses."""
    targets = [targets[index] for index in usable_targets(targets)[0]]
    similarities = method.similarities(reference, targets)
    pairs = [method.match_pair(reference, target, sim) for target, sim in zip(targets, similarities)]
    solution = method.solver.solve(reference, targets, pairs, method.seed)

    cameras = [target.frame.camera for target in targets]
    true = [relative_pose(labels[0], reference.frame.camera, labels[1], camera)[:3, :3] for camera in cameras]
    hypotheses = solution.hypotheses
    # Rotations to the targets' world, which hypotheses in different target views have in common.
    in_world = np.stack([cameras[one.view].R.T @ one.sim3.R for one in hypotheses])
    scene, channels = solution.scene, None
    if scene.reference_photo is not None:
        channels = channel_agreement(scene, solution.poses).double().numpy()
    return Outcome(
        category,
        np.array([[one.terms[name] for name in TERM_NAMES] for one in hypotheses]),
        np.array([rotation_error(one.sim3.R, true[one.view]) for one in hypotheses]),
        rotation_error(in_world[:, None], in_world[None]),
        scene.view_similarity_std,
        len(targets),
        channels,
    )


def fit_weights(outcomes: Sequence[Outcome], ridge: float = _WEIGHT_RIDGE) -> ScoreWeights:
    r"""Fit the weights of a conditional logit with soft labels.

    Minimises -mean_pairs \log \sum_i softmax(S)_i c_i + ridge |w|^2 with c_i = \exp(-(error_i / 12 degrees)^2) and w
    the weights per standard deviation of their terms.

    Raises:
        InputError: No pair has a correct hypothesis among several.
    """
    used = [one for one in outcomes if one.informative]
    if not used:
        raise InputError(f"{len(outcomes)} pairs, none with a correct hypothesis among several, expected some")
    std = np.concatenate([one.terms - one.terms.mean(axis=0) for one in used]).std(axis=0) + 1e-9
    columns, correctness = [one.terms / std for one in used], [one.correctness for one in used]
    return ScoreWeights(*(conditional_logit(columns, correctness, np.full(len(std), ridge)) / std).tolist())


def orientation_column(outcome: Outcome) -> Float[np.ndarray, "m 1"]:
    """Return the term `orientation` of the hypotheses."""
    return outcome.terms[:, [TERM_NAMES.index("orientation")]]


def channel_columns(outcome: Outcome) -> Float[np.ndarray, "m channels"] | None:
    """Return the agreement of every channel under the hypotheses; None without photo features."""
    return outcome.channels


def fit_orientation(outcomes: Sequence[Outcome], ridge: float = _WEIGHT_RIDGE) -> Float[np.ndarray, " 1"]:
    """Fit the weight of the term `orientation`, beside the score without it and without `agreement` (`fit_beside`)."""
    return fit_beside(outcomes, orientation_column, ScoreWeights().without("orientation", "agreement"), ridge)


def fit_agreement(
    outcomes: Sequence[Outcome], weights: ScoreWeights, ridge: float = _AGREEMENT_RIDGE
) -> Float[np.ndarray, " channels"]:
    """Fit the channel weights of the term `agreement`, beside the score without that term (`fit_beside`)."""
    return fit_beside(outcomes, channel_columns, weights.without("agreement"), ridge)


def fit_beside(
    outcomes: Sequence[Outcome], columns: Callable[[Outcome], Float[np.ndarray, "m k"] | None], weights: ScoreWeights,
    ridge: float,
) -> Float[np.ndarray, " k"]:  # fmt: skip
    r"""Fit the weights of further columns beside a score, in nats of that score.

    The score gets a weight of its own, which is not penalised. Pairs count by one over the root of the number of pairs
    of their category.

    Args:
        outcomes: Outcomes of several pairs.
        columns: Returns the k columns of an outcome's hypotheses; None where there are none.
        weights: Weights of the score.
        ridge: Penalty on the squared weights, per standard deviation of all columns together.

    Raises:
        InputError: No pair with columns has a correct hypothesis among several, or the score is of no use on them.
    """
    found = [(one, columns(one)) for one in outcomes if one.informative]
    used = [(one, further) for one, further in found if further is not None]
    if not used:
        raise InputError(f"{len(outcomes)} pairs, none with the term and a correct hypothesis among several")
    std = np.concatenate([further - further.mean(axis=0) for _, further in used]).std() + 1e-9
    score = np.array(astuple(weights))
    count = Counter(one.category for one, _ in used)
    fitted = conditional_logit(
        [np.column_stack([further / std, one.terms @ score]) for one, further in used],
        [one.correctness for one, _ in used],
        np.append(np.full(used[0][1].shape[1], ridge), 0.0),
        np.array([count[one.category] ** -0.5 for one, _ in used]),
    )
    if fitted[-1] <= 0:
        raise InputError(f"{len(used)} pairs: the score without the term has no positive weight, expected it to help")
    return fitted[:-1] / (std * fitted[-1])


def conditional_logit(
    columns: Sequence[Float[np.ndarray, "_ k"]], correctness: Sequence[Float[np.ndarray, " _"]],
    penalty: Float[np.ndarray, " k"], importance: Float[np.ndarray, " pairs"] | None = None,
) -> Float[np.ndarray, " k"]:  # fmt: skip
    r"""Fit weights w of hypotheses' columns x so that softmax(x w) is the probability of being correct.

    Minimises -mean_pairs \log \sum_i softmax(x w)_i c_i + \sum_k penalty_k w_k^2.

    Args:
        columns: For each pair, a row per hypothesis.
        correctness: For each pair, c of every hypothesis, in [0, 1].
        penalty: Penalty of every squared weight.
        importance: Weights of the pairs in the mean; by default equal.
    """
    # One row per pair, padded to the longest list with hypotheses of probability 0.
    shape = len(columns), max(map(len, correctness))
    x = torch.zeros(*shape, len(penalty), dtype=torch.float64)
    log_correctness = torch.full(shape, -torch.inf, dtype=torch.float64)
    padding = torch.full(shape, -torch.inf, dtype=torch.float64)
    for row, (some, c) in enumerate(zip(columns, correctness)):
        x[row, : len(c)] = torch.from_numpy(some - some.mean(axis=0))
        log_correctness[row, : len(c)] = torch.from_numpy(np.log(c.clip(1e-12)))
        padding[row, : len(c)] = 0
    share = torch.from_numpy(np.ones(len(x)) if importance is None else importance)
    share, ridge = share / share.sum(), torch.from_numpy(penalty).double()
    w = torch.zeros(len(penalty), dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([w], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> Float[torch.Tensor, ""]:
        optimiser.zero_grad()
        score = x @ w + padding
        negative = torch.logsumexp(score, dim=1) - torch.logsumexp(score + log_correctness, dim=1)
        value = share @ negative + ridge @ w.square()
        value.backward()
        return value

    with torch.enable_grad():
        optimiser.step(loss)
    return w.detach().numpy()


def fit_calibration(
    outcomes: Sequence[Outcome], weights: ScoreWeights, ridge: float = _CALIBRATION_RIDGE
) -> Calibration:
    """Fit the calibration by maximum likelihood: which of the different poses, if any, is right?

    Every category counts the same, so that the numbers of pairs chosen per category do not decide.

    Args:
        outcomes: Outcomes for several numbers of views.
        weights: Weights of the score.
        ridge: Penalty on the squared coefficients of log N, of the view similarities' standard deviation and of the
            shape fit, per standard deviation of these.

    Raises:
        InputError: All estimates are right, or none is.
    """
    ranked = [one.ranked(weights) for one in outcomes]
    right = [np.flatnonzero(error < CORRECT_ANGLE) for _, error in ranked]
    if min(map(len, right)) > 0 or max(map(len, right)) == 0:
        raise InputError(f"{len(outcomes)} pairs: all have a right pose or none has, expected both kinds")
    most = max(len(deficit) for deficit, _ in ranked)
    deficits = torch.full((len(outcomes), most), 1e3, dtype=torch.float64)
    for row, (deficit, _) in zip(deficits, ranked):
        row[: len(deficit)] = torch.from_numpy(deficit)
    target = torch.tensor([int(found[0]) if len(found) else most for found in right])
    count = Counter(one.category for one in outcomes)
    importance = torch.tensor([1 / (count[one.category] * len(count)) for one in outcomes], dtype=torch.float64)
    inputs = np.array([one.circumstances(weights) for one in outcomes])
    inputs[:, 0] = np.log(inputs[:, 0])
    mean, std = inputs.mean(axis=0), inputs.std(axis=0) + 1e-9
    x = torch.from_numpy((inputs - mean) / std)
    theta = torch.zeros(3 + inputs.shape[1], dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([theta], max_iter=300, line_search_fn="strong_wolfe")

    def loss() -> Float[torch.Tensor, ""]:
        optimiser.zero_grad()
        scale = torch.exp(theta[0] + theta[1] * x[:, 0])
        none = theta[2] + x @ theta[3:]
        logits = torch.cat([-scale[:, None] * deficits, none[:, None]], dim=1)
        negative = torch.nn.functional.cross_entropy(logits, target, reduction="none")
        value = importance @ negative + ridge * torch.cat([theta[1:2], theta[3:]]).square().sum()
        value.backward()
        return value

    with torch.enable_grad():
        optimiser.step(loss)
    scale, scale_n, none, *slopes = theta.detach().numpy()
    slopes = np.array(slopes) / std
    return Calibration(
        *map(float, (scale - scale_n * mean[0] / std[0], scale_n / std[0], none - slopes @ mean, *slopes))
    )


def leave_out(
    outcomes: Sequence[Outcome], fit: Callable[[Sequence[Outcome]], _Fit], folds: int | None = None
) -> list[_Fit]:
    """Return for each outcome a fit that has not seen its category.

    Args:
        outcomes: Outcomes of several categories.
        fit: The fit.
        folds: Number of parts into which the categories are divided; each is left out once. By default one category.
    """
    categories = list(dict.fromkeys(one.category for one in outcomes))
    part = {name: index % (folds or len(categories)) for index, name in enumerate(categories)}
    fitted = {index: fit([one for one in outcomes if part[one.category] != index]) for index in set(part.values())}
    return [fitted[part[one.category]] for one in outcomes]


def report_weights(outcomes: Sequence[Outcome]) -> list[str]:
    """Format the fit of the weights and its accuracy on categories that the fit has not seen."""
    present, fitted = ScoreWeights(), fit_weights(outcomes)
    held_out = leave_out(outcomes, fit_weights)
    rows = (
        ("present weights", [one.ranked(present)[1][0] for one in outcomes]),
        ("fitted weights, held-out category", [one.ranked(w)[1][0] for one, w in zip(outcomes, held_out)]),
        ("most accurate hypothesis", [one.errors.min() for one in outcomes]),
    )
    return [
        f"{len(outcomes)} pairs of {len({one.category for one in outcomes})} categories",
        *(f"{name:35s}{_accuracy(np.array(errors))}" for name, errors in rows),
        "fitted weights: " + ", ".join(f"{name} {value:.1f}" for name, value in asdict(fitted).items()),
        *(f"  best {k} different poses: one is right in {_share(outcomes, present, k):.1f} %" for k in (1, 2, 3, 6)),
    ]


def report_beside(
    outcomes: Sequence[Outcome], columns: Callable[[Outcome], Float[np.ndarray, "m k"] | None], weights: ScoreWeights,
    fitted: Float[np.ndarray, " k"], fit: Callable[[Sequence[Outcome]], Float[np.ndarray, " k"]],
) -> list[str]:  # fmt: skip
    """Format what further columns gain beside a score (`fit_beside`), on categories that the fit has not seen."""
    used = [one for one in outcomes if columns(one) is not None]
    held_out = leave_out(used, fit, _FOLDS)
    score = [one.terms @ np.array(astuple(weights)) for one in used]
    before = np.array([one.errors[s.argmax()] for one, s in zip(used, score)])
    after = np.array([one.errors[(s + columns(one) @ w).argmax()] for one, s, w in zip(used, score, held_out)])
    won, lost = ((one < CORRECT_ANGLE) & (two >= CORRECT_ANGLE) for one, two in ((after, before), (before, after)))
    size = f"root mean square {np.sqrt(np.mean(fitted**2)):.2f} nats"
    return [
        f"{len(used)} pairs of {len({one.category for one in used})} categories",
        f"without the term                   {_accuracy(before)}",
        f"with it, held-out category         {_accuracy(after)}: {won.sum()} pairs won, {lost.sum()} lost",
        f"weight {fitted[0]:.2f}" if len(fitted) == 1 else f"{len(fitted)} weights, {size}",
    ]


def report_calibration(outcomes: Sequence[Outcome], weights: ScoreWeights) -> list[str]:
    """Format the fit of the calibration, and how well it holds on categories that the fit has not seen."""
    fitted = fit_calibration(outcomes, weights)
    held_out = leave_out(outcomes, lambda some: fit_calibration(some, weights))
    first, others = [], []
    for one, calibration in zip(outcomes, held_out):
        deficit, error = one.ranked(weights)
        probability = calibration.probabilities(deficit, *one.circumstances(weights))
        pairs = list(zip(probability, error < CORRECT_ANGLE))
        first.append((one.n_views, *pairs[0]))
        others += pairs[1:]
    views, confidence, right = map(np.array, zip(*first))
    lines = [
        f"{len(outcomes)} outcomes of {len({one.category for one in outcomes})} categories",
        "fitted: " + ", ".join(f"{name} {value:.3f}" for name, value in asdict(fitted).items()),
        "confidence, held-out category:",
        str(reliability(confidence, right, min(10, len(right)))),
    ]
    for n in np.unique(views):
        chosen = views == n
        found = reliability(confidence[chosen], right[chosen], min(5, int(chosen.sum())))
        lines.append(
            f"  {n} views: {chosen.sum()} outcomes, mean confidence {100 * confidence[chosen].mean():.0f} %, right "
            f"{100 * right[chosen].mean():.0f} %, expected calibration error {100 * found.calibration_error:.1f} points"
        )
    if others:
        probability, right = map(np.array, zip(*others))
        found = reliability(probability, right, min(10, len(right)))
        lines += ["probabilities of the other poses, held-out category:", str(found)]
    return lines


def _share(outcomes: Sequence[Outcome], weights: ScoreWeights, k: int) -> float:
    return 100 * float(np.mean([(one.ranked(weights)[1][:k] < CORRECT_ANGLE).any() for one in outcomes]))


def _accuracy(errors: Float[np.ndarray, " n"]) -> str:
    return (
        f"median {np.median(errors):.1f} degrees, Acc30 {100 * np.mean(errors < 30):.1f} %, "
        f"Acc15 {100 * np.mean(errors < 15):.1f} %"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.tuning", description=__doc__.split("\n")[0])
    parser.add_argument("constants", choices=_UNUSED, help="what to fit")
    parser.add_argument("data", nargs="+", type=folder_and_pairs, metavar="FOLDER:PAIRS", help=DATA_HELP)
    parser.add_argument("--backbone", action="append", metavar="NAME", help=f"may be repeated (default {DEFAULT})")
    parser.add_argument("--head", type=Path, nargs="+", metavar="FILE", help="position heads to use, for orientation")
    parser.add_argument("--out", type=Path, metavar="FILE", help="weights to write, for agreement")
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    fit = given.constants
    solver = VerifiedSolver(ScoreWeights().without(*_UNUSED[fit]))
    try:
        for option, value, needed_by in (("--out", given.out, "agreement"), ("--head", given.head, "orientation")):
            if (fit == needed_by) != (value is not None):
                raise InputError(f"{option} FILE is required for `{needed_by}` and refused otherwise")
        if given.out is not None and not given.out.absolute().parent.is_dir():
            raise InputError(f"--out {given.out}: folder {given.out.parent} does not exist")
        check_sides([folder for folder, _ in given.data], "validation" if fit == "calibration" else "training")
        views, outcomes = _VIEWS if fit == "calibration" else (5,), []
        heads = list(zip(given.head, unseen_categories(given.head))) if given.head else [(None, None)]
        for backbone, (head, categories) in product(map(load_backbone, given.backbone or [DEFAULT]), heads):
            if head is not None:
                use_head(backbone, head)
            with torch.no_grad():
                found = [
                    collect_outcomes(root, pairs, backbone, solver, views, categories=categories)
                    for root, pairs in given.data
                ]
            if not any(found):
                raise InputError(f"no pairs of {', '.join(categories or ['any category'])} in the data")
            outcomes += chain(*found)
        if fit == "weights":
            lines = report_weights([replace(one, terms=one.terms * _UNTRAINED) for one in outcomes])
        elif fit == "orientation":
            fitted = fit_orientation(outcomes)
            lines = report_beside(outcomes, orientation_column, solver.weights, fitted, fit_orientation)
        elif fit == "agreement":
            weights = ScoreWeights().without("orientation", "agreement")
            fitted = fit_agreement(outcomes, weights)
            lines = report_beside(outcomes, channel_columns, weights, fitted, lambda some: fit_agreement(some, weights))
            save_file({"weights": torch.from_numpy(fitted).float()}, given.out)
        else:
            lines = report_calibration(outcomes, ScoreWeights())
        print("\n".join(lines))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
