"""The frames of one's own objects that an estimate uses: loaded, scaled, turned, and doubted."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from zsp_lite.data.cameras import view_span
from zsp_lite.data.frames import Frame, frame_defect, turn_frame
from zsp_lite.errors import NoPoseError
from zsp_lite.importers.convert import scale_frame
from zsp_lite.importers.sources import Source
from zsp_lite.pipeline import ZeroShotPose
from zsp_lite.points import axis_deviation, world_cloud
from zsp_lite.views import View

_ALL_SIDES = 120.0  # target views that span less, in degrees, show one side of the object


@dataclass(frozen=True, eq=False)
class Scan:
    """The frames of a source that an estimate uses, whole and as views of an object of unit
    standard deviation."""

    source: Source
    # positions of the frames that are solved against target views of other objects
    references: list[int]
    targets: list[int]  # positions of the target views
    frames: dict[int, Frame]
    views: dict[int, View]
    scale: float  # from the lengths of the frames to those of the views
    cloud: Float[np.ndarray, "n 3"]

    @classmethod
    def of(
        cls,
        source: Source,
        method: ZeroShotPose,
        references: int,
        targets: int,
        first: int | None = None,
    ) -> "Scan":
        """Load frames of a source (see `Source.select`), and extract their features."""
        chosen, shown, frames = source.select(references, targets, first)
        cloud = world_cloud([frames[position] for position in shown or chosen])[0]
        # The method expects objects of about unit standard deviation. Sequences of data folders
        # have it.
        scale = 1.0
        if source.format != "sequence" and len(cloud):
            scale = 1 / (axis_deviation(cloud) or 1)
        used = dict.fromkeys([*chosen, *shown])
        views = method.views([scale_frame(frames[position], scale) for position in used])
        return cls(source, chosen, shown, frames, dict(zip(used, views, strict=True)), scale, cloud)

    @property
    def target_views(self) -> list[View]:
        """The views that reference frames of other objects are solved against."""
        return [self.views[position] for position in self.targets]

    @property
    def seen(self) -> tuple[int, float]:
        """Number of usable target views, and the angle in degrees that they span around the
        object."""
        cameras = [self.frames[k].camera for k in self.targets if not frame_defect(self.frames[k])]
        if not len(self.cloud):
            return len(cameras), 0.0
        return len(cameras), view_span(cameras, np.median(self.cloud, axis=0))


def stood_up(scan: Scan, target: Scan, method: ZeroShotPose) -> tuple[Scan, int]:
    """Turn the frames of a scan by the quarter turns that suit its first reference frame best;
    return the degrees."""

    def views_of(positions: Iterable[int], quarters: int) -> list[View]:
        frames = [scale_frame(scan.frames[position], scan.scale) for position in positions]
        return method.views([turn_frame(frame, quarters) for frame in frames])

    scores = {}
    for quarters in range(4):
        (view,) = views_of(scan.references[:1], quarters)
        with suppress(NoPoseError):
            estimate = method.estimate_from_views(view, target.target_views)
            scores[quarters] = estimate.view_scores.max()
            if estimate.hypotheses:
                scores[quarters] = estimate.hypotheses[0].score
    best = max(scores, key=scores.get, default=0)
    frames = {position: turn_frame(frame, best) for position, frame in scan.frames.items()}
    views = dict(zip(scan.views, views_of(scan.views, best), strict=True))
    return replace(scan, frames=frames, views=views), 90 * best


def scan_flags(scans: Sequence[Scan]) -> tuple[str, ...]:
    """Name two categories, and what is doubtful about the frames in use and the sides that they
    show."""
    flags = []
    sources = [scan.source for scan in scans if scan.source.format == "sequence"]
    categories = sorted({source.path.resolve().parent.name for source in sources})
    if len(categories) > 1:
        flags.append(f"the objects are of different categories: {', '.join(categories)}")
    for scan in scans:
        found = scan.source.flags([scan.frames[position] for position in scan.views])
        flags += [f"{scan.source.path}: {flag}" for flag in found]
    seen = [scan.seen for scan in scans[:2] if scan.targets]
    count, span = max(seen, key=lambda one: (one[1], one[0]))
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
