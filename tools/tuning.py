"""Fit the constants of the verified solver: the weights of the score, and the calibration.

Run it from the root of the repository. The weights are fitted on training categories. The
calibration is fitted on validation categories, on which neither the backbone nor the weights were
fitted. docs/rebuild.md makes the data:

    python -m tools.tuning weights outputs/training_poses:30 outputs/training:30
    python -m tools.tuning calibration outputs/{validation:60,validation_poses:60}

FOLDER:PAIRS is a data folder and the number of pairs of
each of its categories, in each setting of the target views: all around the object, and but for the
weights also within arcs. Folders with categories of another side (`concepts.csv`) are refused. The
tool prints the fitted values and how well they do on categories left out of the fit. The constants
of the library are the fitted values, rounded.

The weights are those of a conditional logit (McFadden 1974): among the hypotheses of a pair, the
probability that one is correct is the softmax of their scores. They are fitted to hypotheses that
the solver finds with its present weights.
"""

import argparse
import csv
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, astuple, dataclass, replace
from functools import cache
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from tqdm import tqdm

from zsp_lite.backbones.load import load_backbone
from zsp_lite.data.cameras import view_span
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import PoseLabel, read_labels, relative_pose
from zsp_lite.data.pairs import sample_pairs
from zsp_lite.errors import InputError
from zsp_lite.metrics import SAME_ANGLE, rotation_error
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.verified import VerifiedSolver
from zsp_lite.verified.confidence import Calibration, evidence, hidden_share, modes
from zsp_lite.verified.verification import TERM_NAMES, ScoreCoefficients
from zsp_lite.views import View, usable_targets
from zsp_lite.viz.reliability import reliability

CONCEPTS = Path(__file__).with_name("concepts.csv")  # the side of every name of a category
# A hypothesis counts as correct to the degree exp(-(error / _SOFT_ANGLE)^2), in degrees.
_SOFT_ANGLE = 12.0
# A pair is used for the weights if one of its hypotheses is correct to a higher degree.
_MIN_CORRECTNESS = 0.3
# Ridges keep the coefficients finite where the evidence separates right from wrong poses.
_WEIGHT_RIDGE = 1e-2
_CALIBRATION_RIDGE = 1e-3
_SURE = 0.8  # confidences above this are also reported by themselves
# The settings by what is fitted: the number of target views, and the arc in degrees in which they
# lie.
ALL_AROUND = 360.0
_SETTINGS = {
    "weights": ((5, ALL_AROUND),),
    "calibration": (
        *((n, ALL_AROUND) for n in (1, 2, 3, 5, 10)),
        *((5, arc) for arc in (30.0, 60.0, 90.0, 120.0)),
    ),
}
_Fit = TypeVar("_Fit")
# The different poses of a pair, best first: by how many nats each is below the best, and its error
# in degrees.
Poses = tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]


@dataclass(frozen=True, eq=False)
class Outcome:
    """The m hypotheses of the verified solver for one pair, with their errors."""

    category: str
    terms: Float[np.ndarray, "m terms"]  # terms of the score, in the order of `TERM_NAMES`
    errors: Float[np.ndarray, " m"]  # errors of the rotations, degrees
    angles: Float[np.ndarray, "m m"]  # angles between the rotations, degrees
    setting: str  # setting of the target views, in words
    span: float  # angle in degrees that the usable target views span around the target
    n_views: int  # number of usable target views
    # degrees between the reference's camera and the nearest target view's
    nearest: Float[np.ndarray, " m"]
    view_std: float  # standard deviation of the target views' similarity to the reference

    @property
    def correctness(self) -> Float[np.ndarray, " m"]:
        """How correct each hypothesis is, in [0, 1]."""
        return np.exp(-np.square(self.errors / _SOFT_ANGLE))

    def ranked(self, weights: ScoreCoefficients) -> Poses:
        """Return the different poses under the weights."""
        scores = self.terms @ np.array(astuple(weights))
        order = np.argsort(-scores, kind="stable")
        # `modes` gives for each hypothesis the index of the best one with the same pose. The best
        # ones themselves, which have their own index, are the different poses.
        different = order[modes(self.angles[np.ix_(order, order)]) == np.arange(len(order))]
        return scores[order[0]] - scores[different], self.errors[different]

    def evidence(self, weights: ScoreCoefficients) -> Float[np.ndarray, "6"]:
        """Return the evidence for the calibration."""
        best = int((self.terms @ np.array(astuple(weights))).argmax())
        shape_fit = float(self.terms[best] @ np.array(astuple(weights.of_shape())))
        return evidence(self.span, self.n_views, self.nearest[best], self.view_std, shape_fit)


def collect_outcomes(
    root: Path, category: str, pairs: int, settings: Sequence[tuple[int, float]], seed: int = 0
) -> list[Outcome]:
    """Run the verified solver on `pairs` pairs of a category in each setting; features are
    extracted once per image."""
    torch.set_num_threads(1)  # Each category has a process of its own.
    dataset = Co3D(root)
    method = ZeroShotPose(load_backbone(device="cpu"), solver="verified")
    labels = read_labels(root, category)
    name = f"{root.name}/{category}"  # Folders may share names of categories.
    numbers: dict[str, list[int]] = {}
    for frame in dataset.frame_list(category):
        numbers.setdefault(frame.sequence_name, []).append(frame.frame_number)

    @cache
    def view(sequence: str, number: int) -> View:
        return method.views([dataset.load(dataset.frame(category, sequence, number))])[0]

    outcomes = []
    for n_targets, arc in settings:
        setting = f"{n_targets} views all around"
        if arc < ALL_AROUND:
            setting = f"views within {arc:.0f} degrees"
        for pair in sample_pairs(dataset, category, pairs, n_targets, seed):
            # Within an arc, the target views are drawn from all frames of the sequence.
            target_frames = pair.target_frames
            if arc < ALL_AROUND:
                target_frames = sorted(numbers[pair.target_sequence])
            targets = [view(pair.target_sequence, number) for number in target_frames]
            if arc < ALL_AROUND:
                targets = views_within(targets, arc, np.random.default_rng(pair.seed))
            reference = view(pair.reference_sequence, pair.reference_frame)
            ends = (labels[pair.reference_sequence], labels[pair.target_sequence])
            seeded = replace(method, seed=pair.seed)
            outcomes.append(solve_views(seeded, (name, setting), reference, targets, ends))
    return outcomes


def views_within(around: Sequence[View], arc: float, rng: np.random.Generator) -> list[View]:
    """Draw two to ten views from a random arc.

    `around` has the views that go once around an object, in their order.
    """
    points = [
        view.frame.camera.to_world(view.measured_points[0][view.known_foreground])
        for view in around
    ]
    centre = np.median(np.concatenate(points), axis=0)
    first = int(rng.integers(len(around)))
    turned = [*around[first:], *around[:first]]
    cameras = [view.frame.camera for view in turned]
    count = 1
    while count < len(turned) and view_span(cameras[: count + 1], centre) <= arc:
        count += 1
    wanted = min(int(rng.choice([2, 3, 5, 10])), count)
    return [turned[k] for k in np.linspace(0, count - 1, wanted).round().astype(int)]


def solve_views(
    method: ZeroShotPose,
    names: tuple[str, str],
    reference: View,
    targets: Sequence[View],
    labels: tuple[PoseLabel, PoseLabel],
) -> Outcome:
    """Run the verified solver on the views of a pair, and measure its hypotheses.

    `names` are the category and the setting of the outcome.
    """
    targets = [targets[index] for index in usable_targets(targets)[0]]
    solution = VerifiedSolver().solve(
        reference, targets, method.match_views(reference, targets), method.seed
    )

    cameras = [target.frame.camera for target in targets]
    true = [
        relative_pose(labels[0], reference.frame.camera, labels[1], camera)[:3, :3]
        for camera in cameras
    ]
    hypotheses = solution.hypotheses
    # Rotations to the targets' world, which hypotheses in different target views have in common.
    in_world = np.stack([cameras[pose.view].R.T @ pose.sim3.R for pose in hypotheses])
    return Outcome(
        names[0],
        np.array([[pose.terms[name] for name in TERM_NAMES] for pose in hypotheses]),
        np.array([rotation_error(pose.sim3.R, true[pose.view]) for pose in hypotheses]),
        rotation_error(in_world[:, None], in_world[None]),
        names[1],
        solution.scene.view_span,
        len(targets),
        np.array([float(rotation_error(np.eye(3), pose.sim3.R)) for pose in hypotheses]),
        solution.scene.view_similarity_std,
    )


def fit_weights(outcomes: Sequence[Outcome]) -> ScoreCoefficients:
    r"""Fit the weights of a conditional logit with soft labels.

    Minimises -mean_pairs \log \sum_i softmax(S)_i c_i + _WEIGHT_RIDGE |w|^2. S_i is the score of
    hypothesis i, c_i its correctness, and w are the weights per standard deviation of their terms.

    Raises:
        InputError: No pair has a correct hypothesis among several.
    """
    used = [
        outcome
        for outcome in outcomes
        if len(outcome.errors) > 1 and outcome.correctness.max() > _MIN_CORRECTNESS
    ]
    if not used:
        raise InputError(
            f"{len(outcomes)} pairs, none with a correct hypothesis among several, expected some"
        )
    centred = [outcome.terms - outcome.terms.mean(axis=0) for outcome in used]
    std = np.concatenate(centred).std(axis=0) + 1e-9

    # One row per pair, padded to the longest list with hypotheses of probability 0.
    shape = (len(used), max(len(outcome.errors) for outcome in used))
    x = torch.zeros(*shape, len(std), dtype=torch.float64)
    log_correctness = torch.full(shape, -torch.inf, dtype=torch.float64)
    padding = torch.full(shape, -torch.inf, dtype=torch.float64)
    for row, outcome in enumerate(used):
        number = len(outcome.errors)
        columns = outcome.terms / std
        x[row, :number] = torch.from_numpy(columns - columns.mean(axis=0))
        log_correctness[row, :number] = torch.from_numpy(np.log(outcome.correctness.clip(1e-12)))
        padding[row, :number] = 0

    w = torch.zeros(x.shape[2], dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([w], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> Float[torch.Tensor, ""]:
        optimiser.zero_grad()
        score = x @ w + padding
        negative = torch.logsumexp(score, dim=1) - torch.logsumexp(score + log_correctness, dim=1)
        value = negative.mean() + _WEIGHT_RIDGE * w.square().sum()
        value.backward()
        return value

    with torch.enable_grad():
        optimiser.step(loss)
    return ScoreCoefficients(*(w.detach().numpy() / std).tolist())


def fit_calibration(outcomes: Sequence[Outcome], weights: ScoreCoefficients) -> Calibration:
    """Fit the calibration by maximum likelihood: which of the different poses, if any, is right?

    Every category counts the same, so that the numbers of pairs chosen per category do not decide.
    A ridge is on coefficients per standard deviation of the evidence.

    Raises:
        InputError: All outcomes have a right pose, or none has.
    """
    ranked = [outcome.ranked(weights) for outcome in outcomes]
    right = [np.flatnonzero(errors < SAME_ANGLE) for _, errors in ranked]
    if min(map(len, right)) > 0 or max(map(len, right)) == 0:
        raise InputError(
            f"{len(outcomes)} pairs: all have a right pose or none has, expected both kinds"
        )

    # The deficits of the poses, a row per outcome, padded with one whose probability is 0. The
    # target is the class of the first right pose; the class `most` is "none is right".
    most = max(len(deficit) for deficit, _ in ranked)
    deficits = torch.full((len(outcomes), most), 1e3, dtype=torch.float64)
    for row, (deficit, _) in zip(deficits, ranked):
        row[: len(deficit)] = torch.from_numpy(deficit)
    target = torch.tensor([int(indices[0]) if len(indices) else most for indices in right])
    count = Counter(outcome.category for outcome in outcomes)
    importance = torch.tensor(
        [1 / (count[outcome.category] * len(count)) for outcome in outcomes], dtype=torch.float64
    )

    # The evidence without its constant, standardised.
    known = np.array([outcome.evidence(weights) for outcome in outcomes])[:, 1:]
    mean = known.mean(axis=0)
    std = known.std(axis=0) + 1e-9
    x = torch.from_numpy(np.column_stack([np.ones(len(known)), (known - mean) / std]))
    hidden = torch.from_numpy(hidden_share(known[:, 0]))
    theta = torch.zeros(2, x.shape[1], dtype=torch.float64, requires_grad=True)  # alpha and beta
    unseen = torch.tensor(-2.0, dtype=torch.float64, requires_grad=True)  # logit of lambda
    optimiser = torch.optim.LBFGS([theta, unseen], max_iter=300, line_search_fn="strong_wolfe")

    def loss() -> Float[torch.Tensor, ""]:
        optimiser.zero_grad()
        log_scale, none = theta @ x.T
        logits = torch.cat([-log_scale.exp()[:, None] * deficits, none[:, None]], dim=1)
        look_alike = (unseen.sigmoid() * hidden)[:, None]
        probability = (1 - look_alike) * logits.softmax(dim=1)
        probability = torch.cat([probability[:, :-1], probability[:, -1:] + look_alike], dim=1)
        likelihood = probability.gather(1, target[:, None])[:, 0].clamp_min(1e-12)
        value = _CALIBRATION_RIDGE * theta[:, 1:].square().sum() - importance @ likelihood.log()
        value.backward()
        return value

    with torch.enable_grad():
        optimiser.step(loss)
    # From coefficients of standardised evidence to coefficients of the evidence itself.
    fitted = theta.detach().numpy()
    slopes = fitted[:, 1:] / std
    scale, none = np.column_stack([fitted[:, 0] - slopes @ mean, slopes]).tolist()
    return Calibration(tuple(scale), tuple(none), unseen.sigmoid().item())


def leave_out(outcomes: Sequence[Outcome], fit: Callable[[Sequence[Outcome]], _Fit]) -> list[_Fit]:
    """Return for each outcome a fit that has not seen its category."""
    fitted = {}
    for category in {outcome.category for outcome in outcomes}:
        fitted[category] = fit([seen for seen in outcomes if seen.category != category])
    return [fitted[outcome.category] for outcome in outcomes]


def report_weights(outcomes: Sequence[Outcome], present: ScoreCoefficients) -> list[str]:
    """Format the fit of the weights and its accuracy on categories that the fit has not seen."""
    lines = [
        f"{len(outcomes)} pairs of {len({outcome.category for outcome in outcomes})} categories"
    ]
    held_out = leave_out(outcomes, fit_weights)
    # Errors of the best pose: `ranked` gives deficits and errors, best first.
    rows = {
        "present weights": [outcome.ranked(present)[1][0] for outcome in outcomes],
        "fitted weights, held-out category": [
            outcome.ranked(weights)[1][0] for outcome, weights in zip(outcomes, held_out)
        ],
        "most accurate hypothesis": [outcome.errors.min() for outcome in outcomes],
    }
    for name, errors in rows.items():
        lines.append(f"{name:35s}{_accuracy(np.array(errors))}")
    weights = asdict(fit_weights(outcomes)).items()
    lines.append(f"fitted weights: {', '.join(f'{name} {value:.1f}' for name, value in weights)}")
    return lines


def report_calibration(outcomes: Sequence[Outcome], weights: ScoreCoefficients) -> list[str]:
    """Format the fit of the calibration, and how well it holds on categories that the fit has not
    seen."""
    fitted = fit_calibration(outcomes, weights)
    held_out = leave_out(outcomes, lambda seen: fit_calibration(seen, weights))

    # Probability and correctness of the best pose of each outcome, and of all other poses.
    best = []
    others = []
    for outcome, calibration in zip(outcomes, held_out):
        deficit, errors = outcome.ranked(weights)
        probabilities = calibration.probabilities(deficit, outcome.evidence(weights))
        first, *rest = zip(probabilities, errors < SAME_ANGLE)
        best.append(first)
        others += rest
    confidence, right = map(np.array, zip(*best))
    categories = {outcome.category for outcome in outcomes}
    lines = [
        f"{len(outcomes)} outcomes of {len(categories)} categories",
        f"scale: {_numbers(fitted.scale)}; none: {_numbers(fitted.none)}; unseen: "
        f"{fitted.unseen:.3f}",
        "confidence, held-out category:",
        str(reliability(confidence, right, min(10, len(right)))),
    ]

    # The same for each setting.
    settings = np.array([outcome.setting for outcome in outcomes])
    for setting in dict.fromkeys(settings.tolist()):
        chosen = settings == setting
        sure = chosen & (confidence > _SURE)
        bins = min(5, int(chosen.sum()))
        error = reliability(confidence[chosen], right[chosen], bins).calibration_error
        lines.append(
            f"  {setting}: {chosen.sum()} outcomes, mean confidence "
            f"{100 * confidence[chosen].mean():.0f} %, right "
            f"{100 * right[chosen].mean():.0f} %, expected calibration error "
            f"{100 * error:.1f} points; "
            f"{right[sure].sum()} of {sure.sum()} with a confidence above {_SURE} are right"
        )
    if others:
        probability, right = map(np.array, zip(*others))
        lines += ["probabilities of the other poses, held-out category:"]
        lines += [str(reliability(probability, right, min(10, len(right))))]
    return lines


def _numbers(values: Sequence[float]) -> str:
    """Format coefficients."""
    return ", ".join(f"{value:.3f}" for value in values)


def _accuracy(errors: Float[np.ndarray, " n"]) -> str:
    """Format the accuracy of poses by their errors in degrees."""
    return f"median {np.median(errors):.1f} degrees, Acc30 {100 * np.mean(errors < 30):.1f} %"


def folder_and_pairs(text: str) -> tuple[Path, int]:
    """Parse a tool's argument FOLDER:PAIRS, a data folder and the number of pairs of each of its
    categories."""
    folder, _, pairs = text.rpartition(":")
    if not folder or not pairs.isdecimal() or int(pairs) < 1:
        raise argparse.ArgumentTypeError(f"{text}: expected FOLDER:PAIRS, PAIRS at least 1")
    return Path(folder), int(pairs)


def check_sides(folders: Iterable[str | Path], side: str) -> None:
    """Raise InputError if a data folder has a category that `concepts.csv` does not list for a
    side."""
    with CONCEPTS.open(newline="") as file:
        sides = {row["name"]: row["side"] for row in csv.DictReader(file)}
    for folder in folders:
        for category in Co3D(folder).categories():
            # A concept is the part of a name before its hyphen.
            own_side = sides.get(category.partition("-")[0], "no side")
            if own_side != side:
                raise InputError(
                    f"{folder}: category {category} is for {own_side}, expected {side}"
                )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.tuning", description=__doc__.split("\n")[0]
    )
    parser.add_argument("constants", choices=_SETTINGS, help="what to fit")
    parser.add_argument("data", nargs="+", type=folder_and_pairs, metavar="FOLDER:PAIRS")
    options = parser.parse_args(arguments)
    fit = options.constants
    side = "training" if fit == "weights" else "validation"
    report = report_weights if fit == "weights" else report_calibration
    try:
        check_sides([folder for folder, _ in options.data], side)
        jobs = [
            (root, category, pairs)
            for root, pairs in options.data
            for category in Co3D(root).categories()
        ]
        with ProcessPoolExecutor(os.cpu_count()) as pool:
            parts = pool.map(collect_outcomes, *zip(*jobs), [_SETTINGS[fit]] * len(jobs))
            outcomes = []
            for part in tqdm(parts, "categories", len(jobs)):
                outcomes += part
        print("\n".join(report(outcomes, ScoreCoefficients())))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
