"""The frames of one's own objects that an estimate uses: load and turn them, and flag what is
doubtful about them."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np
from jaxtyping import Float

from zsp_lite.data.azimuths import view_span
from zsp_lite.data.frames import Frame, frame_defect, with_images
from zsp_lite.errors import Doubt, NoPoseError
from zsp_lite.importers.sources import Source
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.points import axis_deviation, world_cloud
from zsp_lite.scans.judge import asked_positions
from zsp_lite.scans.shapes import FRAMES, Shape
from zsp_lite.scans.upright import find_up
from zsp_lite.views import View, object_crop

# These values are chosen, not fitted.
_TRIED = 8  # frames that are loaded to find a single reference: the first usable one
# Target views that span less than this angle, in degrees, show one side of the object.
_ALL_SIDES = 120.0


@dataclass(frozen=True, eq=False)
class Scan:
    """The frames of a source that an estimate uses, whole and as views."""

    source: Source
    # positions of the frames that are solved against target views of other objects, in their order
    references: list[int]
    targets: list[int]  # positions of the target views
    frames: dict[int, Frame]
    views: dict[int, View]
    size: float  # standard deviation of the object
    cloud: Float[np.ndarray, "n 3"]  # points of the object in the frames, in their world
    quarters: int = 0  # by which the frames are turned

    @classmethod
    def of(
        cls,
        source: Source,
        method: ZeroShotPose,
        references: int,
        targets: int,
        first: int | None = None,
    ) -> "Scan":
        """Load frames of a source (see `Source.select`), and extract their features.

        The references are among the targets; without targets, there is one.
        """
        alone = targets == 0
        count = max(references, targets)
        if alone and first is None:
            count = _TRIED
        usable, frames = source.select(count, references > 0, first)
        if alone:
            frames = {usable[0]: frames[usable[0]]}
        chosen = [usable[k] for k in asked_positions(references, len(usable))] if references else []
        cloud = world_cloud(list(frames.values()))[0]
        size = 1.0  # that of sequences of data folders
        if source.format != "sequence" and len(cloud):
            size = axis_deviation(cloud) or 1.0
        views = [replace(view, size=size) for view in method.views(frames.values())]
        shown = [] if alone else sorted(frames)
        return cls(source, chosen, shown, frames, dict(zip(frames, views)), size, cloud)

    def shape(self) -> tuple[Shape, str]:
        """Return the fused shape, and why its vertical is not known, if sources disagree."""
        usable, loaded = self.source.select(FRAMES, references=True)
        frames = [object_crop(turn_frame(loaded[k], self.quarters)) for k in usable]
        if isinstance(self.source.up, str):
            up, problem = find_up(frames)
            return Shape.of(frames, up), problem
        up = np.array(self.source.up, float)
        return Shape.of(frames, up if up.any() else None), ""

    @property
    def target_views(self) -> list[View]:
        """The views that reference frames of other objects are solved against."""
        return [self.views[position] for position in self.targets]

    @property
    def seen(self) -> tuple[int, float]:
        """Number of usable target views, and the angle in degrees that they span around the
        object."""
        frames = [self.frames[position] for position in self.targets]
        cameras = [frame.camera for frame in frames if not frame_defect(frame)]
        if not len(self.cloud):
            return len(cameras), 0.0
        return len(cameras), view_span(cameras, np.median(self.cloud, axis=0))


def stood_up(scan: Scan, target: Scan, method: ZeroShotPose) -> tuple[Scan, int]:
    """Turn the frames of a scan by 0 to 3 quarters, so that its first reference frame fits best.

    Returns the scan and the turn in degrees. The scores are of the same pixels and target views,
    and so comparable between the turns: of 48 pairs of samples, the best score finds the turn of
    42. The highest confidence, which compares the poses of one turn only, finds that of 14.
    """

    def views_of(positions: Iterable[int], quarters: int) -> list[View]:
        turned = method.views([turn_frame(scan.frames[k], quarters) for k in positions])
        return [replace(view, size=scan.size) for view in turned]

    scores = {}
    for quarters in range(4):
        (view,) = views_of(scan.references[:1], quarters)
        with suppress(NoPoseError):
            estimate = method.estimate_from_views(view, target.target_views)
            if estimate.hypotheses:
                scores[quarters] = estimate.hypotheses[0].score
            else:
                scores[quarters] = estimate.view_scores.max()
    best = max(scores, key=scores.get, default=0)
    frames = {position: turn_frame(frame, best) for position, frame in scan.frames.items()}
    views = dict(zip(scan.views, views_of(scan.views, best)))
    return replace(scan, frames=frames, views=views, quarters=best), 90 * best


def scan_flags(scans: Sequence[Scan]) -> tuple[str, ...]:
    """Flag objects of different categories, doubtful frames, and objects seen from one side."""
    flags = []
    categories = sorted(
        {
            scan.source.path.resolve().parent.name
            for scan in scans
            if scan.source.format == "sequence"
        }
    )
    if len(categories) > 1:
        flags.append(Doubt(f"the objects are of different categories: {', '.join(categories)}"))
    for scan in scans:
        frames = [scan.frames[position] for position in scan.views]
        path = scan.source.path
        flags += [type(flag)(f"{path}: {flag}") for flag in scan.source.flags(frames)]
    # Of the two objects, the one whose views span more. Two views show two sides at most, however
    # far they are apart.
    seen = [scan.seen for scan in scans[:2] if scan.targets]
    count, span = max(seen, key=itemgetter(1, 0))
    if count < 3 or span < _ALL_SIDES:
        sides = "two sides" if span >= _ALL_SIDES else "one side"
        what = "each object was"
        other = "one"
        if len(seen) < 2:
            what = "the target was"
            other = "the reference"
        seen_from = f"seen from {sides} only ({span:.0f} degrees)"
        flags.append(
            f"{what} {seen_from}: if {other} was taken from another side, this pose is wrong"
        )
    return tuple(flags)


def turn_frame(frame: Frame, quarters: int) -> Frame:
    """Turn a frame and its camera by quarter turns as in `numpy.rot90`; world points stay."""
    return with_images(
        frame,
        frame.camera.turn(quarters),
        lambda image: np.ascontiguousarray(np.rot90(image, quarters)),
    )
