"""The computation of `zsp-lite estimate`: the pose between two objects of one's own, from files to files."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from zsp_lite.alignment import Sim3
from zsp_lite.backbones.load import BackboneConfig, load_backbone
from zsp_lite.backbones.pretrained import DEFAULT
from zsp_lite.data.depth import unproject_depth
from zsp_lite.data.frames import ON_OBJECT, Frame
from zsp_lite.data.labels import read_labels
from zsp_lite.errors import InputError, check_integer
from zsp_lite.estimates import PoseEstimate
from zsp_lite.features import FeatureExtractor
from zsp_lite.importers.fusion import scale_frame, unit_scale
from zsp_lite.io.locks import writing
from zsp_lite.io.ply import write_ply
from zsp_lite.pair_result import (
    SEQUENCE_FRAMES,
    SOLVER_CHOICES,
    PairResult,
    label_error,
    solve_pair,
)
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.points import near_median
from zsp_lite.sources import Source, open_pair, open_source
from zsp_lite.views import View, frame_defect, has_saliency

_FAR = 4.0  # points farther from the median than this multiple of the median distance are not written


@dataclass(frozen=True, eq=False)
class OwnPair:
    """Pose estimates between two objects of one's own. `print` shows them.

    Attributes:
        result: Estimates, and errors where both sequences have pose labels.
        reference: Reference frame, whole.
        targets: Target frames, whole.
        masks: Where the masks of the reference and of the targets come from: "given", "box" or "auto".
        backbone: Name of the backbone.
    """

    result: PairResult
    reference: Frame
    targets: tuple[Frame, ...]
    masks: tuple[str, str]
    backbone: str

    @property
    def estimates(self) -> dict[str, PoseEstimate]:
        """Estimate of each solver by its name."""
        return self.result.estimates

    def __repr__(self) -> str:
        return "\n".join(f"{solver}: {estimate!r}" for solver, estimate in self.estimates.items())

    def as_json(self) -> dict[str, Any]:
        """Return all numbers in the types of JSON. Matrices are for column vectors; `null` marks what is unknown."""
        solved = {}
        for solver, estimate in self.estimates.items():
            solved[solver] = {
                "view": estimate.view,
                "view_name": self.targets[estimate.view].name,
                "matrix": estimate.sim3.matrix.tolist(),
                "rotation": estimate.sim3.R.tolist(),
                "translation": estimate.sim3.t.tolist(),
                "scale": float(estimate.sim3.scale),
                "inliers": int(estimate.inliers.sum()),
                "matches": len(estimate.matches),
                "reference_turn_degrees": estimate.reference_turn,
                "confidence": estimate.confidence,
                "error_degrees": self.result.errors.get(solver),
                "flags": list(estimate.flags),
                "one_of_two": estimate.one_of_two,
                "alternatives": [
                    {
                        "view": one.view, "matrix": one.sim3.matrix.tolist(), "probability": one.probability,
                        "degrees_from_best": one.angle, "score_below_best": one.deficit,
                    }
                    for one in estimate.alternatives
                ],
                "seconds": dict(estimate.timings),
            }  # fmt: skip
        return {
            "reference": {"source": self.result.reference, "masks": self.masks[0]},
            "target": {
                "source": self.result.target, "masks": self.masks[1], "views": [frame.name for frame in self.targets],
            },
            "backbone": self.backbone,
            "estimates": solved,
            "degrees_between_solvers": self.result.disagreement,
        }  # fmt: skip

    def write(self, out: str | Path) -> list[Path]:
        """Write the report and the point clouds.

        Args:
            out: Folder to write; created if missing.

        Returns:
            `report.html`; `target.ply`, the points of the target object in all its views; and for each solver
            `aligned_SOLVER.ply`, the points of the reference object after the pose, and `aligned_SOLVER_2.ply`, after
            the first alternative, where the answer is one of two. The clouds are in the world of the target views,
            which for an image is its camera's frame.
        """
        from zsp_lite.viz.report import write_pair_report

        out = Path(out)
        parts = [_coloured_points(frame) for frame in self.targets if not frame_defect(frame)]
        cloud = np.concatenate([frame_points for frame_points, _ in parts])
        colours = np.concatenate([frame_colours for _, frame_colours in parts])
        write_ply(out / "target.ply", cloud, colours)
        paths = [out / "target.ply"]
        points, colours = _coloured_points(self.reference)
        points = self.reference.camera.to_camera(points)
        for solver, estimate in self.estimates.items():
            poses = {f"aligned_{solver}.ply": estimate}
            if estimate.one_of_two:
                poses[f"aligned_{solver}_2.ply"] = estimate.alternatives[0]
            for name, pose in poses.items():
                paths.append(out / name)
                write_ply(paths[-1], self.targets[pose.view].camera.to_world(pose.sim3.apply(points)), colours)
        return [write_pair_report(out / "report.html", self.result, self.backbone, self.masks), *paths]


def estimate_pose(
    reference: str | Path | Source,
    target: str | Path | Source,
    solver: str = "verified",
    reference_frame: int | None = None,
    targets: int = 5,
    mask: str | None = None,
    intrinsics: tuple[float, float, float, float] | None = None,
    backbone: str | BackboneConfig | FeatureExtractor = DEFAULT,
    out: str | Path | None = None,
    upright: bool = True,
) -> OwnPair:
    """Estimate the pose between two objects of one category, each named by a path.

    Each path is a sequence of a data folder, a folder with a capture, or an image with depth. `open_source` explains
    them, and takes the settings that only one of the two has, such as a box around the object. No label is needed.

    Args:
        reference: The reference object.
        target: The target object.
        solver: "verified", "paper" or "both".
        reference_frame: Frame number of the reference; by default its first frame with known depth and an object.
        targets: Number of target views, evenly spaced over the target's frames.
        mask: Where the masks of both come from: "given", "auto", or as `open_source` decides. For "box", open the
            sources, which take a box each.
        intrinsics: Camera intrinsics of both, where they are images.
        backbone: Backbone, or what `load_backbone` takes.
        out: Folder for the report and the point clouds (see `OwnPair.write`); None writes nothing.
        upright: Whether the reference image is upright; False tries its four turns by 90 degrees (see `ZeroShotPose`).

    Raises:
        InputError: An input cannot be read, an option is missing, `out` cannot be written, or the pose cannot be
            estimated.
    """
    if solver not in SOLVER_CHOICES:
        raise InputError(f"solver is {solver!r}, expected one of {', '.join(SOLVER_CHOICES)}")
    check_integer("targets", targets, 1)
    if out is not None:
        with writing(out):  # before the computation: a folder that cannot be written is an error at once
            pair = estimate_pose(
                reference, target, solver, reference_frame, targets, mask, intrinsics, backbone, upright=upright
            )
            pair.write(out)
        return pair
    options = {"mask": mask, "intrinsics": intrinsics}
    options = {name: value for name, value in options.items() if value is not None}
    if isinstance(reference, Source) or isinstance(target, Source):
        first, second = (one if isinstance(one, Source) else open_source(one, **options) for one in (reference, target))
    else:
        first, second = open_pair(reference, target, {name: (value,) for name, value in options.items()})
    if reference_frame is None:
        position, frame = first.first_usable()
    else:
        position = first.position(reference_frame)
        (frame,) = first.load([position])
    positions, shown = second.spread(targets), second.spread(SEQUENCE_FRAMES)
    wanted = sorted({*positions, *shown})
    loaded = dict(zip(wanted, second.load(wanted)))
    frames = [loaded[k] for k in positions]

    model = load_backbone(backbone) if isinstance(backbone, str | BackboneConfig) else backbone
    method = ZeroShotPose(model, foreground="saliency" if has_saliency(model) else "mask", upright=upright)
    # The method expects objects of about unit standard deviation. Sequences of data folders have it.
    scales = [
        1.0 if source.kind == "sequence" else _unit_scale(some) for source, some in ((first, [frame]), (second, frames))
    ]
    scaled = [scale_frame(one, scales[1]) for one in frames]
    estimates = solve_pair(method, scale_frame(frame, scales[0]), scaled, SOLVER_CHOICES[solver])
    estimates = {name: _in_units(estimate, *scales) for name, estimate in estimates.items()}
    result = PairResult(
        f"{first.name} to {second.name}", first.describe([position]), second.describe(positions), estimates,
        _errors(first, second, frame, frames, estimates), tuple(loaded[k] for k in shown),
    )  # fmt: skip
    return OwnPair(result, frame, tuple(frames), (first.mask, second.mask), getattr(model, "name", str(backbone)))


def _errors(
    first: Source, second: Source, reference: Frame, targets: Sequence[Frame], estimates: dict[str, PoseEstimate]
) -> dict[str, float]:
    """Compute rotation errors if both are labelled sequences of one category; {} otherwise."""
    folders = [source.path.resolve().parent for source in (first, second)]
    if {first.kind, second.kind} != {"sequence"} or folders[0] != folders[1]:
        return {}
    labels = read_labels(folders[0].parent, folders[0].name)
    names = [source.path.resolve().name for source in (first, second)]
    if any(name not in labels for name in names):
        return {}
    return {
        solver: label_error(estimate, labels[names[0]], reference, labels[names[1]], targets)
        for solver, estimate in estimates.items()
    }


def _unit_scale(frames: Sequence[Frame]) -> float:
    """Compute the factor that gives the visible points of the object unit standard deviation; 1 without points."""
    clouds = [_coloured_points(frame)[0] for frame in frames if not frame_defect(frame)]
    return unit_scale(np.concatenate(clouds)) if sum(map(len, clouds)) > 1 else 1.0


def _in_units(estimate: PoseEstimate, reference_scale: float, target_scale: float) -> PoseEstimate:
    """Express an estimate on scaled frames in the lengths before scaling."""

    def unscaled(sim3: Sim3) -> Sim3:
        return Sim3(sim3.scale * reference_scale / target_scale, sim3.R, sim3.t / target_scale)

    def view(one: View, scale: float) -> View:
        return replace(one, frame=scale_frame(one.frame, 1 / scale))

    return replace(
        estimate,
        sim3=unscaled(estimate.sim3),
        hypotheses=tuple(replace(one, sim3=unscaled(one.sim3)) for one in estimate.hypotheses),
        reference_view=view(estimate.reference_view, reference_scale),
        target_views=tuple(view(one, target_scale) for one in estimate.target_views),
    )


def _coloured_points(frame: Frame) -> tuple[Float[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Return the world points and colours of the pixels on the object, without outliers."""
    inside = (frame.depth > 0) & (frame.mask > ON_OBJECT)
    points = frame.camera.to_world(unproject_depth(frame.depth, frame.camera)[inside])
    if not len(points):
        return points, frame.rgb[inside]
    kept = near_median(points, _FAR)
    return points[kept], frame.rgb[inside][kept]
