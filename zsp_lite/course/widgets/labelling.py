"""Widget for labelling poses: keypoints by clicks on point clouds, residuals, overlay, accept.

The widget only displays and forwards. `zsp_lite.course.labelling.Labelling` holds the keypoints and
writes every change at once, so that the work continues after a restart.
"""

import html
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from zsp_lite.alignment import Sim3
from zsp_lite.course.labelling.session import (
    ACCEPTED,
    MIN_KEYPOINTS,
    OPEN,
    Alignment,
    Labelling,
    Progress,
)
from zsp_lite.course.widgets.cloud_view import CloudView
from zsp_lite.course.widgets.common import Widget, load_package
from zsp_lite.data.labels import read_labels
from zsp_lite.errors import InputError
from zsp_lite.viz.plots import BLUE, ORANGE

_STATE_SYMBOLS = {ACCEPTED: "✓", OPEN: "○"}
_PROPOSED = (
    "A proposal is laid over the cloud: accept it if both clouds agree; otherwise click keypoints."
)
_TOOLTIPS = {
    "undo": "Remove the last keypoint of this sequence",
    "redo": "Remove all keypoints of this sequence",
    "accept": "Write the label of this sequence",
    "next": "Go to the next open sequence",
}
_HELP = (
    "Click: pick. Drag: rotate. Shift and drag: pan. Wheel: zoom, after a click on the "
    "cloud. Keyboard: arrows and + − on a cloud."
)
_STYLE = """<style>
.zsp-label table { border-collapse: collapse; margin: 0 1.5em 0 0; }
.zsp-label th, .zsp-label td { padding: 1px 8px; text-align: left; line-height: 1.4; }
.zsp-label th { border-bottom: 1px solid; }
.zsp-label td:nth-child(n+4) { text-align: right; }
.zsp-progress tr:has(td:first-child:not(:empty)) td { font-weight: bold; }
.zsp-label .widget-html-content { line-height: 1.4; }
.zsp-message p { margin: 2px 0; min-height: 1.4em; line-height: 1.4; }
.zsp-message .problem { border-left: 5px solid #D55E00; padding-left: 6px; }
</style>"""


def label_poses(labelling: Labelling) -> Widget:
    """Label a category, with the point clouds of the reference (left) and of the current sequence
    (right)."""
    return _LabellingWidget(labelling).box


class _LabellingWidget:
    """The parts of the widget, the actions of its buttons, and the display.

    Each button calls the method of its name, which returns the message to show.
    """

    def __init__(self, labelling: Labelling):
        self.labelling = labelling
        # For each canvas, the sequence that it shows.
        self.shown: dict[str, str] = {}
        # Sequence and picks of the label in doubt for which accept was pressed once.
        self.asked = ()
        # Whether the display is being updated, which must not start another update.
        self.refreshing = False
        self.box = self._build()
        sequence = labelling.reference
        text = ""
        if any(row.picks for row in labelling.progress()):
            sequence = self._next_open(labelling.reference)
            text = "The earlier keypoints are loaded."
        self.controls["sequence"].value = sequence
        self._do(lambda: text)

    def _build(self) -> Widget:
        """Create the parts and arrange them; the names of CSS classes begin with `zsp-`."""
        widgets = load_package()
        style = {"description_width": "initial"}
        narrow = {"width": "auto"}
        reference, *others = self.labelling.sequences
        options = [(f"{reference} (reference)", reference), *zip(others, others)]
        self.controls = controls = {
            "sequence": widgets.Dropdown(options=options, description="sequence", style=style),
            "name": widgets.Text(
                description="name",
                placeholder="for example: left arm",
                continuous_update=False,
                style=style,
                layout={"width": "16em"},
            ),
            "overlay": widgets.ToggleButton(
                description="overlay",
                tooltip="Show both clouds, aligned, in two colours",
                layout=narrow,
            ),
        }
        self.buttons = buttons = {
            name: widgets.Button(description=name, tooltip=tooltip, layout=narrow)
            for name, tooltip in _TOOLTIPS.items()
        }
        self.views = {
            name: CloudView(name, partial(self._clicked, name))
            for name in ("reference", "sequence")
        }
        self.captions = {name: widgets.HTML() for name in self.views}
        self.tables = {name: widgets.HTML() for name in ("progress", "keypoints")}
        self.message = widgets.HTML()

        # CSS classes, and what controls and buttons do.
        parts = {**controls, **buttons, **self.tables, "message": self.message}
        for name, part in parts.items():
            part.add_class(f"zsp-{name}")
        for name in ("sequence", "overlay"):
            controls[name].observe(self._changed, names="value")
        for name, button in buttons.items():
            button.on_click(lambda _, name=name: self._do(getattr(self, name)))

        # The rows of the widget, from top to bottom.
        clouds = [
            widgets.VBox([self.captions[name], view.widget], layout={"margin": "0 8px 0 0"})
            for name, view in self.views.items()
        ]
        actions = [parts[name] for name in ("undo", "redo", "overlay", "accept", "next")]
        wrap = {"flex_flow": "row wrap"}
        row = partial(widgets.HBox, layout={**wrap, "align_items": "center"})
        rows = [
            widgets.HTML(_STYLE),
            row([controls["sequence"], controls["name"]]),
            row(actions),
            self.message,
            widgets.HBox(clouds, layout=wrap),
            widgets.HTML(_HELP),
            widgets.HBox([*self.tables.values()], layout={**wrap, "align_items": "flex-start"}),
        ]
        box = widgets.VBox(rows)
        box.add_class("zsp-label")
        # The caller has only the box: the parts, so far, are its attributes.
        vars(box).update(vars(self))
        return box

    @property
    def current(self) -> str:
        """Name of the sequence that is chosen."""
        return self.controls["sequence"].value

    @property
    def on_reference(self) -> bool:
        """Whether the reference is chosen."""
        return self.current == self.labelling.reference

    def undo(self) -> str:
        """Remove the last keypoint of the sequence."""
        self.labelling.undo(self.current)
        return f"{len(self.labelling.picks(self.current))} keypoints on {self.current}."

    def redo(self) -> str:
        """Remove all keypoints of the sequence."""
        self.labelling.put(self.current, [])
        return f"All keypoints of {self.current} removed."

    def accept(self) -> str:
        """Write the label; one in doubt only if accept is pressed twice in a row."""
        sequence = self.current
        doubt = self.labelling.doubt(sequence)
        asked = (sequence, self.labelling.picks(sequence).tobytes())
        if doubt and self.asked != asked:
            self.asked = asked
            raise InputError(
                f"{doubt}. Correct the keypoints, or press accept again to write the label "
                "nevertheless"
            )
        path = self.labelling.accept(sequence, confirmed=True)
        return f"Written: {'/'.join(path.parts[-3:])}. {self.next()}"

    def next(self) -> str:
        """Go to the next open sequence."""
        following = self._next_open(self.current)
        proposed = self._proposed(following)
        if len(self.labelling.names) < MIN_KEYPOINTS and not proposed:
            self.controls["sequence"].value = self.labelling.reference
            return f"Pick at least {MIN_KEYPOINTS} keypoints on the reference first."
        self.controls["sequence"].value = following
        if proposed:
            self.controls["overlay"].value = True
        if not any(row.state == OPEN for row in self.labelling.progress()):
            return "No sequence is open."
        return f"Now {following}. {_PROPOSED}" if proposed else f"Now {following}."

    def _add(self, sequence: str, point: np.ndarray | None) -> str:
        """Add the next keypoint."""
        if point is None:
            return "There is no point of the cloud at the click."
        labelling = self.labelling
        picks = labelling.picks(sequence)
        same = np.flatnonzero((picks == point).all(axis=1))
        if len(same):
            raise InputError(
                f"keypoint {same[0] + 1}, {labelling.names[same[0]]}, is at this point already"
            )
        if sequence != labelling.reference and len(labelling.names) < MIN_KEYPOINTS:
            raise InputError(
                f"the reference has {len(labelling.names)} keypoints, expected "
                f"{MIN_KEYPOINTS} first"
            )
        labelling.pick(sequence, point, self.controls["name"].value.strip())
        self.controls["name"].value = ""
        if sequence != labelling.reference and len(picks) + 1 == len(labelling.names):
            self.controls["overlay"].value = labelling.alignment(sequence) is not None
            return self._instruction()
        return f"Keypoint {len(picks) + 1}, {labelling.names[len(picks)]}, picked on {sequence}."

    def _clicked(self, view: str, point: np.ndarray | None) -> None:
        """Add the keypoint that is clicked in a view."""
        sequence = self.labelling.reference if view == "reference" else self.current
        self._do(lambda: self._add(sequence, point))

    def _changed(self, change: Any) -> None:
        """Follow a control that the user moves."""
        if not self.refreshing:
            self._do(self._instruction)

    def _do(self, action: Callable[[], str]) -> None:
        """Run an action and update the display; an InputError is shown as a message."""
        self.refreshing = True
        text = problem = ""
        try:
            # The display is updated even if the action fails.
            for step in (action, self._refresh):
                try:
                    text = step() or text
                except InputError as error:
                    problem = f"Not done: {error}" if step is action else str(error)
        finally:
            self.refreshing = False
        kind = "problem" if problem else "info"
        shown = problem or text or self._instruction()
        # With this role, screen readers announce the message.
        self.message.value = (
            f'<p class="{kind}" role="status" aria-live="polite">{html.escape(shown)}</p>'
        )

    def _next_open(self, sequence: str) -> str:
        """Return the next open sequence, cyclically; the given one if none is open."""
        rows = self.labelling.progress()
        index = [row.sequence for row in rows].index(sequence)
        following = rows[index + 1 :] + rows[:index]
        return next((row.sequence for row in following if row.state == OPEN), sequence)

    def _proposed(self, sequence: str) -> bool:
        """Whether a proposal for a sequence waits for confirmation."""
        return (
            not len(self.labelling.picks(sequence))
            and self.labelling.proposal(sequence) is not None
        )

    def _instruction(self) -> str:
        """Return what the user can do next."""
        names = self.labelling.names
        picked = len(self.labelling.picks(self.current))
        if self.on_reference:
            more = f"at least {MIN_KEYPOINTS - len(names)} more"
            if len(names) >= MIN_KEYPOINTS:
                more = "enough; add more, or go on with next"
            return (
                "Click a point of the reference that all objects of the category have: "
                f"{len(names)} so far, {more}."
            )
        if self._proposed(self.current):
            return _PROPOSED
        if picked < len(names):
            return f"Click the right cloud: keypoint {picked + 1}, {names[picked]}."
        alignment = self.labelling.alignment(self.current)
        if alignment is None:
            return f"Pick at least {MIN_KEYPOINTS} keypoints on the reference first."
        return (
            f"All {picked} keypoints are picked, residual {100 * alignment.rms:.1f} %. Accept if "
            "both clouds agree, otherwise redo."
        )

    def _refresh(self) -> None:
        """Show the state of the session; raise InputError if the picks give no alignment."""
        labelling = self.labelling
        controls = self.controls
        rows = labelling.progress()
        row = next(row for row in rows if row.sequence == self.current)
        alignment = None if self.on_reference or row.problem else labelling.alignment(self.current)
        aligned = self._aligned_reference(alignment)

        # Controls and tables.
        if aligned is None:
            controls["overlay"].value = False
        controls["overlay"].disabled = aligned is None
        controls["name"].disabled = not self.on_reference
        waiting = not self.on_reference and self._proposed(self.current)
        self.buttons["accept"].disabled = alignment is None and not waiting
        self.tables["progress"].value = _progress_table(rows, self.current)
        self.tables["keypoints"].value = _keypoint_table(labelling.names, row.picks, alignment)

        # Clouds.
        caption = f"{_dot(BLUE)} reference {html.escape(labelling.reference)}"
        self.captions["reference"].value = caption
        self._show_cloud("reference", labelling.reference, overlay=None)
        if self.on_reference:
            self.shown.pop("sequence", None)
            self.views["sequence"].clear("Empty: no other sequence is chosen")
            self.captions["sequence"].value = "choose another sequence above, or next"
        else:
            overlay = aligned if controls["overlay"].value else None
            suffix = "" if overlay is None else f" and {_dot(BLUE, '✕')} the aligned reference"
            self.captions["sequence"].value = f"{_dot(ORANGE)} {html.escape(self.current)}{suffix}"
            self._show_cloud("sequence", self.current, overlay)
        if row.problem:
            raise InputError(row.problem)

    def _aligned_reference(self, alignment: Alignment | None) -> np.ndarray | None:
        """Return the reference cloud in the world of the sequence, by its keypoints, its label, or
        a proposal."""
        labelling = self.labelling
        if self.on_reference:
            return None
        label = read_labels(labelling.root, labelling.category).get(self.current)
        if alignment is not None:
            sim3 = alignment.sim3
        elif len(labelling.picks(self.current)):
            return None  # The picks are not complete.
        elif label is not None:
            sim3 = Sim3.from_matrix(label.trans)
        else:
            sim3 = labelling.proposal(self.current)
        return sim3 and sim3.apply(labelling.cloud(labelling.reference)[0])

    def _show_cloud(self, name: str, sequence: str, overlay: np.ndarray | None) -> None:
        """Show a cloud and its keypoints."""
        points, colours = self.labelling.cloud(sequence)
        alt = f"Point cloud of {sequence}. The arrow keys rotate."
        # A cloud that is shown already stays as the user has turned it.
        shown = self.shown.pop(name, None) == sequence
        view = None if shown else self.labelling.first_view(sequence)
        try:
            self.views[name].show(points, colours, view, alt, overlay)
        except InputError as error:
            self.views[name].clear(f"Empty: {error}")
            raise InputError(f"sequence {sequence}: {error}") from error
        self.shown[name] = sequence
        self.views[name].mark(self.labelling.picks(sequence))


def _progress_table(rows: Sequence[Progress], current: str) -> str:
    """Return the table of all sequences, the current one marked."""
    cells = []
    for row in rows:
        residual = "see above" if row.problem else ""
        if row.rms is not None:
            residual = f"{100 * row.rms:.1f} %"
        marker = "▸" if row.sequence == current else ""
        state = f"{_STATE_SYMBOLS.get(row.state, '●')} {row.state}"
        cells.append((marker, row.sequence, state, row.picks, residual))
    return _table(("", "sequence", "state", "keypoints", "residual"), cells)


def _keypoint_table(names: Sequence[str], picked: int, alignment: Alignment | None) -> str:
    """Return the table of keypoints, of which the first `picked` are picked on the current
    sequence."""
    residuals = [""] * len(names)
    if alignment is not None:
        residuals = [f"{100 * residual:.1f} %" for residual in alignment.residuals]
        residuals[int(alignment.residuals.argmax())] += " ← largest"
    cells = [
        (k + 1, name, "✓" if k < picked else "next" if k == picked else "", residual)
        for k, (name, residual) in enumerate(zip(names, residuals))
    ]
    return _table(("", "keypoint", "picked", "residual"), cells or [("", "none yet", "", "")])


def _table(head: Sequence[str], rows: Sequence[tuple]) -> str:
    """Format a table as HTML."""
    with pd.option_context("display.max_colwidth", None):
        return pd.DataFrame(rows, columns=head).to_html(index=False, border=0)


def _dot(colour: str, symbol: str = "●") -> str:
    """Format a coloured symbol as HTML."""
    return f'<b style="color:{colour}">{symbol}</b>'
