"""Widget for labelling poses: keypoints by clicks on point clouds, residuals, overlay, accept.

The widget only displays and forwards. `zsp_lite.labelling.Labelling` holds the keypoints and writes every change at
once, so that the work continues after a restart.
"""

import html
from collections.abc import Callable

import numpy as np

from zsp_lite.data.labels import read_labels
from zsp_lite.errors import InputError
from zsp_lite.labelling.keypoints import MIN_KEYPOINTS, Alignment
from zsp_lite.labelling.session import OPEN, Labelling
from zsp_lite.viz.plots import BLUE, ORANGE
from zsp_lite.widgets.cloud_view import subsample
from zsp_lite.widgets.common import Widget
from zsp_lite.widgets.labelling_panel import Panel


def label_poses(labelling: Labelling) -> Widget:
    """Label a category: the point cloud of the reference on the left, that of the current sequence on the right."""
    return _LabellingWidget(labelling).panel.box


_PROPOSED = "A proposal is laid over the cloud: accept it if both clouds agree; otherwise click keypoints, or skip."


class _LabellingWidget:
    """The actions of the widget, each of which returns the message to show, and what it displays after each."""

    def __init__(self, labelling: Labelling):
        self.labelling = labelling
        self.shown: dict[str, object] = {}
        self.asked: tuple[str, str, bytes] | None = None  # the label in doubt that accept was pressed for
        self.refreshing = False
        self.actions = {
            "undo": self.undo, "redo": self.redo, "accept": self.accept, "skip": self.skip, "next": self.next,
            "pick": lambda: self.pick(self.current, self._slider_point()),
        }  # fmt: skip
        self.panel = Panel(labelling.sequences, self._clicked, self._changed, lambda name: self._do(self.actions[name]))
        self.controls, self.views = self.panel.controls, self.panel.views
        started = any(row.picks for row in labelling.progress())
        self.controls["sequence"].value = self._next_open(labelling.reference) if started else labelling.reference
        self._do(lambda: "The earlier keypoints are loaded." if started else "")

    @property
    def current(self) -> str:
        return self.controls["sequence"].value

    @property
    def on_reference(self) -> bool:
        return self.current == self.labelling.reference

    def pick(self, sequence: str, point: np.ndarray | None) -> str:
        """Add the next keypoint."""
        if point is None:
            return "There is no point of the cloud at the click."
        labelling, number = self.labelling, len(self.labelling.picks(sequence)) + 1
        same = np.flatnonzero((labelling.picks(sequence) == point).all(axis=1))
        if len(same):
            raise InputError(f"keypoint {same[0] + 1}, {labelling.names[same[0]]}, is at this point already")
        if sequence != labelling.reference and len(labelling.names) < MIN_KEYPOINTS:
            raise InputError(f"the reference has {len(labelling.names)} keypoints, expected {MIN_KEYPOINTS} first")
        labelling.pick(sequence, point, self.controls["name"].value.strip())
        self.controls["name"].value = ""
        if sequence != labelling.reference and number == len(labelling.names):
            self.controls["overlay"].value = labelling.alignment(sequence) is not None
            return self._instruction()
        return f"Keypoint {number}, {labelling.names[number - 1]}, picked on {sequence}."

    def undo(self) -> str:
        self.labelling.undo(self.current)
        return f"{len(self.labelling.picks(self.current))} keypoints on {self.current}."

    def redo(self) -> str:
        self.labelling.clear(self.current)
        return f"All keypoints of {self.current} removed."

    def accept(self) -> str:
        """Write the label; one in doubt only if accept is pressed twice in a row."""
        sequence, doubt = self.current, self.labelling.doubt(self.current)
        asked = sequence, doubt, self.labelling.picks(sequence).tobytes()
        if doubt and self.asked != asked:
            self.asked = asked
            raise InputError(f"{doubt}. Correct the keypoints, or press accept again to write the label nevertheless")
        path = self.labelling.accept(sequence, confirmed=True)
        return f"Written: {'/'.join(path.parts[-3:])}. {self.next()}"

    def skip(self) -> str:
        sequence = self.current
        self.labelling.skip(sequence)
        return f"{sequence} is skipped. {self.next()}"

    def next(self) -> str:
        """Go to the next open sequence."""
        following = self._next_open(self.current)
        if len(self.labelling.names) < MIN_KEYPOINTS and not self._proposed(following):
            self.controls["sequence"].value = self.labelling.reference
            return f"Pick at least {MIN_KEYPOINTS} keypoints on the reference first."
        is_open = any(row.state == OPEN for row in self.labelling.progress())
        self.controls["sequence"].value = following
        self.controls["overlay"].value |= self._proposed(following)
        now = f"Now {following}. {_PROPOSED if self._proposed(following) else ''}".strip()
        return now if is_open else "No sequence is open."

    def _clicked(self, view: str, point: np.ndarray | None) -> None:
        self._do(lambda: self.pick(self.labelling.reference if view == "reference" else self.current, point))

    def _changed(self, control: str) -> None:
        if self.refreshing or control == "name":
            return
        if control == "point":
            self._move_cursor()
        else:
            self._do(self._instruction)

    def _do(self, action: Callable[[], str]) -> None:
        """Run an action and update the display; an InputError is shown as a message."""
        outermost, self.refreshing = not self.refreshing, True
        try:
            text, problem = action(), False
        except InputError as error:
            text, problem = str(error), True
        if not outermost:
            return
        try:
            self._refresh()
        except InputError as error:
            text, problem = str(error), True
        finally:
            self.refreshing = False
        self.panel.show_message(text or self._instruction(), problem)

    def _next_open(self, sequence: str) -> str:
        """Return the next open sequence after this one, cyclically; itself if none is open."""
        rows = self.labelling.progress()
        index = [row.sequence for row in rows].index(sequence)
        following = rows[index + 1 :] + rows[:index]
        return next((row.sequence for row in following if row.state == OPEN), sequence)

    def _proposed(self, sequence: str) -> bool:
        """Whether a proposal for a sequence waits for confirmation."""
        return not len(self.labelling.picks(sequence)) and self.labelling.proposal(sequence) is not None

    def _instruction(self) -> str:
        """Return what the user can do next."""
        labelling, names = self.labelling, self.labelling.names
        picked = len(labelling.picks(self.current))
        if self.on_reference:
            missing = MIN_KEYPOINTS - len(names)
            more = f"at least {missing} more" if missing > 0 else "enough; add more, or go on with next"
            return f"Click a point of the reference that all objects of the category have: {len(names)} so far, {more}."
        if self._proposed(self.current):
            return _PROPOSED
        if picked < len(names):
            return f"Click the right cloud: keypoint {picked + 1}, {names[picked]}."
        if (alignment := labelling.alignment(self.current)) is None:
            return f"Pick at least {MIN_KEYPOINTS} keypoints on the reference first."
        rms = 100 * alignment.rms
        return f"All {picked} keypoints are picked, residual {rms:.1f} %. Accept if both clouds agree, otherwise redo."

    def _refresh(self) -> None:
        labelling, controls, panel = self.labelling, self.controls, self.panel
        rows = labelling.progress()
        row = next(row for row in rows if row.sequence == self.current)
        picks, names = labelling.picks(self.current), labelling.names
        alignment = None if self.on_reference or row.problem else labelling.alignment(self.current)
        aligned = self._aligned_reference(alignment)
        controls["overlay"].value &= aligned is not None
        controls["overlay"].disabled = aligned is None
        controls["name"].disabled = not self.on_reference
        waiting = not self.on_reference and self._proposed(self.current)
        panel.buttons["accept"].disabled = alignment is None and not waiting
        panel.buttons["skip"].disabled = self.on_reference
        panel.show_progress(rows, self.current)
        panel.show_keypoints(names, len(picks), alignment)
        panel.captions["reference"].value = f"{_dot(BLUE)} reference {html.escape(labelling.reference)}"
        self._show_cloud("reference", labelling.reference, None)
        self.views["reference"].mark(labelling.picks(labelling.reference))
        if self.on_reference:
            self.shown.pop("sequence", None)
            self.views["sequence"].clear("Empty: no other sequence is chosen")
            panel.captions["sequence"].value = "choose another sequence above, or next"
        else:
            overlay = aligned if controls["overlay"].value else None
            suffix = "" if overlay is None else f" and {_dot(BLUE, '✕')} the aligned reference"
            panel.captions["sequence"].value = f"{_dot(ORANGE)} {html.escape(self.current)}{suffix}"
            self._show_cloud("sequence", self.current, overlay)
            self.views["sequence"].mark(picks)
        controls["point"].max = max(len(self._slider_points()) - 1, 0)
        self._move_cursor(only_if_shown=True)
        if row.problem:
            raise InputError(row.problem)

    def _aligned_reference(self, alignment: Alignment | None) -> np.ndarray | None:
        """Return the reference cloud in the world of the sequence, by its keypoints, its label, or a proposal."""
        if self.on_reference:
            return None
        cloud = self.labelling.cloud(self.labelling.reference)[0]
        if alignment is not None:
            return alignment.sim3.apply(cloud)
        labels = read_labels(self.labelling.root, self.labelling.category)
        if len(self.labelling.picks(self.current)):
            return None
        if self.current in labels:
            trans = labels[self.current].trans
            return cloud @ trans[:3, :3].T + trans[:3, 3]
        proposal = self.labelling.proposal(self.current)
        return None if proposal is None else proposal.apply(cloud)

    def _show_cloud(self, name: str, sequence: str, overlay: np.ndarray | None) -> None:
        """Send a cloud to a canvas, unless it is shown already."""
        before = self.shown.get(name, (None, None))
        key = sequence, None if overlay is None else overlay[:: max(len(overlay) // 50, 1)].tobytes()
        if before == key:
            return
        points, colours = self.labelling.cloud(sequence)
        alt = f"Point cloud of {sequence}. The slider named point chooses a point by keyboard, the arrow keys rotate."
        second = None if overlay is None else (overlay, _rgb(BLUE), _rgb(ORANGE))
        view = self.labelling.first_view(sequence) if before[0] != sequence else None
        try:
            self.views[name].show(points, colours, view, alt, second)
        except InputError as error:
            self.shown.pop(name, None)
            self.views[name].clear(f"Empty: {error}")
            raise InputError(f"sequence {sequence}: {error}") from error
        self.shown[name] = key

    def _slider_point(self) -> np.ndarray:
        points = self._slider_points()
        return points[min(self.controls["point"].value, len(points) - 1)]

    def _slider_points(self) -> np.ndarray:
        """Return the points that the slider goes through, neighbours after each other."""
        cloud = self.labelling.cloud(self.current)[0]
        return cloud[subsample(cloud)]

    def _move_cursor(self, only_if_shown: bool = False) -> None:
        """Move the cross-hair to the point of the slider."""
        current, other = ("reference", "sequence") if self.on_reference else ("sequence", "reference")
        self.views[other].point_at(None)
        if not only_if_shown or self.views[current].widget.cursor:
            self.views[current].point_at(self._slider_point())


def _dot(colour: str, symbol: str = "●") -> str:
    return f'<b style="color:{colour}">{symbol}</b>'


def _rgb(colour: str) -> tuple[int, int, int]:
    return tuple(bytes.fromhex(colour[1:]))
