"""Labelling poses in a notebook: keypoints by clicks on point clouds, residuals, overlay, accept (`label_poses`).

The widget only shows and passes on: `zsp_lite.labelling.Labelling` has what was picked, and writes every change at
once. Run the cell again after a restart and go on.
"""

import html
import shutil
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.data.samples import sample_data
from zsp_lite.errors import InputError
from zsp_lite.labelling.keypoints import MIN_KEYPOINTS, Alignment
from zsp_lite.labelling.session import ACCEPTED, OPEN, SKIPPED, Labelling
from zsp_lite.viz.plots import BLUE, ORANGE
from zsp_lite.widgets.cloud_view import CloudView, subsample
from zsp_lite.widgets.common import load_ipywidgets

if TYPE_CHECKING:
    from ipywidgets import VBox

    from zsp_lite.backbones.backbone import Backbone

_NEXT = -1  # in the menu of keypoints: the one to be picked next
_SIGNS = {ACCEPTED: "✓", OPEN: "○", SKIPPED: "–"}
_HINT = (
    "Click: pick. Drag: turn. Shift and drag: move. Wheel: zoom, once the cloud was clicked or dragged. "
    "By keyboard: arrows and + − on a cloud; the slider chooses a point, the button picks it."
)
_STYLE = """<style>
.zsp-label table { border-collapse: collapse; margin: 0 1.5em 0 0; }
.zsp-label th, .zsp-label td { padding: 1px 8px; text-align: left; line-height: 1.4; }
.zsp-label th { border-bottom: 1px solid; }
.zsp-label tr[aria-current] td { font-weight: bold; }
.zsp-label .widget-html-content { line-height: 1.4; }
.zsp-label .number { text-align: right; }
.zsp-message p { margin: 2px 0; min-height: 1.4em; line-height: 1.4; }
.zsp-message .problem { border-left: 5px solid #D55E00; padding-left: 6px; }
</style>"""


def label_poses(labelling: Labelling, backbone: "Backbone | None" = None) -> "VBox":
    """Label a category by hand: the reference's cloud on the left, on the right the sequence that is being labelled.

    backbone: of the button "guess"; default: zsp-tiny, loaded when it is first pressed. All that is refused is said in
    a line of the widget. The result's `controls`, `buttons` and `views` (two canvases) are its parts by name, `name` is
    the field for a keypoint's name; CSS classes begin with `zsp-`. Raises InputError without ipywidgets or anywidget.
    """
    return _Desk(labelling, backbone).box


class _Desk:
    """What the widget knows besides `Labelling`: which sequence and keypoint are looked at, and what to undo."""

    def __init__(self, labelling: Labelling, backbone: "Backbone | None"):
        self.labelling, self.backbone = labelling, backbone
        self.history: list[tuple[str, np.ndarray, tuple[str, ...]]] = []
        self.shown: dict[str, object] = {}
        self.kept: dict[str, np.ndarray] = {}
        self.refreshing = False
        self._build()
        started = any(row.picks for row in labelling.progress())
        first = self._next_open(labelling.reference) if started else labelling.reference
        self.controls["sequence"].value = first
        self._tell(lambda: "What was picked before is here again." if started else "")

    @property
    def current(self) -> str:
        return self.controls["sequence"].value

    @property
    def on_reference(self) -> bool:
        return self.current == self.labelling.reference

    # ---- what the person does ----

    def pick(self, sequence: str, point: np.ndarray | None) -> str:
        """A click on a sequence's canvas."""
        if point is None:
            return "No point of the cloud is there."
        labelling, chosen = self.labelling, self.controls["keypoint"].value
        there = np.flatnonzero((labelling.picks(sequence) == point).all(axis=1))
        if len(there) and there[0] != chosen:
            raise InputError(f"keypoint {there[0] + 1}, {labelling.names[there[0]]}, is at this very point already")
        if chosen != _NEXT:
            with self._change(sequence):
                labelling.move(sequence, chosen, point)
            self.controls["keypoint"].value, self.controls["name"].value = _NEXT, ""
            return f"Keypoint {chosen + 1}, {labelling.names[chosen]}, moved on {sequence}."
        if sequence != labelling.reference and len(labelling.names) < MIN_KEYPOINTS:
            raise InputError(f"the reference has {len(labelling.names)} keypoints, expected {MIN_KEYPOINTS} first")
        name = self.controls["name"].value.strip() if sequence == labelling.reference else ""
        with self._change(sequence):
            labelling.pick(sequence, point, name or None)
        self.controls["name"].value = ""
        number = len(labelling.picks(sequence))
        if sequence != labelling.reference and number == len(labelling.names):
            self.controls["overlay"].value = labelling.alignment(sequence) is not None
            return self._advice()
        return f"Keypoint {number}, {labelling.names[number - 1]}, picked on {sequence}."

    def pick_by_slider(self) -> str:
        return self.pick(self.current, self._slider_point())

    def undo(self) -> str:
        """Take back the last change on this sequence; after a restart, its last pick."""
        index = max((i for i, (name, *_) in enumerate(self.history) if name == self.current), default=None)
        if index is None:
            self.labelling.undo(self.current)
        else:
            sequence, points, names = self.history.pop(index)
            now = self.labelling.names[: len(names)]  # a name that was changed since stays
            self.labelling.put(sequence, points, (*now, *names[len(now) :]))
        return f"{len(self.labelling.picks(self.current))} keypoints on {self.current}."

    def redo(self) -> str:
        with self._change(self.current):
            self.labelling.clear(self.current)
        return f"All keypoints of {self.current} taken back; undo brings them again."

    def guess(self) -> str:
        labelling, sequence = self.labelling, self.current
        if self.on_reference or len(labelling.names) < MIN_KEYPOINTS:
            raise InputError(f"a guess needs {MIN_KEYPOINTS} keypoints on the reference, and another sequence chosen")
        self._say("The method looks at both objects. This takes some seconds.")
        from zsp_lite.backbones.load import load_backbone
        from zsp_lite.labelling.guess import guess_alignment

        self.backbone = self.backbone or load_backbone("zsp-tiny")
        sim3, sure = guess_alignment(
            labelling.dataset, self.backbone, labelling.category, labelling.reference, sequence
        )
        with self._change(sequence):
            labelling.guess(sequence, sim3)
        self.controls["overlay"].value = True
        return f"Guessed, {sure:.0%} sure. Look closely: correct single keypoints, or redo it."

    def accept(self) -> str:
        sequence = self.current
        path = self.labelling.accept(sequence)
        return f"Written: {'/'.join(path.parts[-3:])}. {self.next()}"

    def skip(self) -> str:
        sequence = self.current
        if self.on_reference:
            raise InputError(f"sequence {sequence} is the reference, which cannot be skipped")
        self.labelling.skip(sequence)
        return f"{sequence} is left out. {self.next()}"

    def next(self) -> str:
        """Go to the next sequence that is open."""
        if len(self.labelling.names) < MIN_KEYPOINTS:
            self.controls["sequence"].value = self.labelling.reference
            return f"Pick {MIN_KEYPOINTS} or more keypoints on the reference first."
        following = self._next_open(self.current)
        still = any(row.state == OPEN for row in self.labelling.progress())
        self.controls["sequence"].value = following
        return f"Now {following}." if still else "No sequence is open any more."

    def rename(self) -> str:
        index, name = self.controls["keypoint"].value, self.controls["name"].value
        if index == _NEXT or not name.strip() or name.strip() == self.labelling.names[index]:
            return self._advice()
        self.labelling.rename(index, name)
        return f"Keypoint {index + 1} is now called {self.labelling.names[index]}."

    # ---- what is shown ----

    def _build(self) -> None:
        widgets = load_ipywidgets()
        labelling = self.labelling
        narrow = {"description_width": "initial"}
        self.views = {
            "reference": CloudView("zsp-cloud-reference", lambda point: self._clicked(labelling.reference, point)),
            "sequence": CloudView("zsp-cloud-sequence", lambda point: self._clicked(self.current, point)),
        }
        first, *others = labelling.sequences
        options = [(f"{first} (reference)", first), *((name, name) for name in others)]
        self.controls = {
            "sequence": widgets.Dropdown(options=options, description="sequence", style=narrow),
            "keypoint": widgets.Dropdown(options=[("next", _NEXT)], description="keypoint", style=narrow),
            "name": widgets.Text(description="name", placeholder="such as: left arm", continuous_update=False,
                                 style=narrow, layout={"width": "16em"}),
            "overlay": widgets.ToggleButton(description="overlay", tooltip="Both clouds in plain colours, one on the "
                                            "other", layout={"width": "auto"}),
            "point": widgets.IntSlider(description="point", style=narrow, layout={"width": "32em"}),
        }  # fmt: skip
        for name, control in self.controls.items():
            control.add_class(f"zsp-{name}")
            control.observe(self._changed[name].__get__(self), names="value")
        self.buttons = {
            name: self._button(name, tooltip, action)
            for name, tooltip, action in (
                ("undo", "Take the last change on this sequence back", self.undo),
                ("redo", "Take all keypoints of this sequence back and begin anew", self.redo),
                ("guess", "Let the method propose the alignment", self.guess),
                ("accept", "Write this sequence's label", self.accept),
                ("skip", "Leave this sequence out, without a label", self.skip),
                ("next", "Go to the next open sequence", self.next),
                ("pick", "Pick the point under the cross-hair", self.pick_by_slider),
            )
        }
        self.message, self.captions = widgets.HTML(), [widgets.HTML(), widgets.HTML()]
        self.message.add_class("zsp-message")
        self.tables = {name: widgets.HTML() for name in ("progress", "keypoints")}
        for name, table in self.tables.items():
            table.add_class(f"zsp-{name}")
        wrap = {"flex_flow": "row wrap", "align_items": "center"}
        clouds = [
            widgets.VBox([caption, view.widget], layout={"margin": "0 8px 0 0"})
            for caption, view in zip(self.captions, self.views.values())
        ]
        middle = [self.buttons[name] for name in ("undo", "redo", "guess")]
        last = [self.buttons[name] for name in ("accept", "skip", "next")]
        controls = self.controls
        self.box = widgets.VBox(
            [
                widgets.HTML(_STYLE),
                widgets.HBox([controls["sequence"], controls["keypoint"], controls["name"]], layout=wrap),
                widgets.HBox([*middle, controls["overlay"], *last], layout=wrap),
                self.message,
                widgets.HBox(clouds, layout={"flex_flow": "row wrap"}),
                widgets.HTML(_HINT),
                widgets.HBox([controls["point"], self.buttons["pick"]], layout=wrap),
                widgets.HBox(list(self.tables.values()), layout={"flex_flow": "row wrap", "align_items": "flex-start"}),
            ]
        )
        self.box.add_class("zsp-label")
        self.box.controls = {name: control for name, control in controls.items() if name != "name"}
        self.box.name, self.box.buttons, self.box.views = controls["name"], self.buttons, self.views
        self.box.message, self.box.tables = self.message, self.tables

    def _button(self, name: str, tooltip: str, action: Callable[[], str]):
        button = load_ipywidgets().Button(description=name, tooltip=tooltip, layout={"width": "auto"})
        button.add_class(f"zsp-{name}")
        button.on_click(lambda _: self._tell(action))
        return button

    def _sequence_changed(self, change) -> None:
        if not self.refreshing:
            self._tell(self._advice)

    def _keypoint_changed(self, change) -> None:
        index = change["new"]
        if not self.refreshing and index is not None:
            self.controls["name"].value = "" if index == _NEXT else self.labelling.names[index]
            self._tell(self._advice)

    def _name_changed(self, change) -> None:
        if not self.refreshing and self.controls["keypoint"].value != _NEXT:
            self._tell(self.rename)

    def _overlay_changed(self, change) -> None:
        if not self.refreshing:
            self._tell(self._advice)

    def _point_changed(self, change) -> None:
        if not self.refreshing:
            self._cursor()

    _changed = {
        "sequence": _sequence_changed,
        "keypoint": _keypoint_changed,
        "name": _name_changed,
        "overlay": _overlay_changed,
        "point": _point_changed,
    }

    def _clicked(self, sequence: str, point: np.ndarray | None) -> None:
        self._tell(lambda: self.pick(sequence, point))

    def _tell(self, action: Callable[[], str]) -> None:
        """Do something and show everything anew; what was refused is one line."""
        outermost, self.refreshing = not self.refreshing, True
        try:
            said, wrong = action(), False
        except InputError as error:
            said, wrong = str(error), True
        if not outermost:
            return
        try:
            self._refresh()
        except InputError as error:
            said, wrong = str(error), True
        finally:
            self.refreshing = False
        self._say(said or self._advice(), wrong)

    def _say(self, text: str, wrong: bool = False) -> None:
        kind, sign = ("problem", "Not done: ") if wrong else ("told", "")
        self.message.value = f'<p class="{kind}" role="status" aria-live="polite">{sign}{html.escape(text)}</p>'

    def _advice(self) -> str:
        """What to do next."""
        labelling, names = self.labelling, self.labelling.names
        done = len(labelling.picks(self.current))
        if (index := self.controls["keypoint"].value) not in (_NEXT, None):
            return f"Click where keypoint {index + 1}, {names[index]}, belongs, or write another name."
        if self.on_reference:
            need = MIN_KEYPOINTS - len(names)
            more = f"{need} more at least" if need > 0 else "enough; add more, or go on with next"
            return (
                f"Click on the reference where all objects of the category have a place: {len(names)} so far, {more}."
            )
        if done < len(names):
            return f"Click on the right cloud: keypoint {done + 1}, {names[done]}."
        if (alignment := labelling.alignment(self.current)) is None:
            return f"Pick {MIN_KEYPOINTS} or more keypoints on the reference first."
        rms = 100 * alignment.rms
        return f"All {done} keypoints are picked, residual {rms:.1f} %. Do both clouds agree? Accept it, or redo it."

    def _refresh(self) -> None:
        labelling, controls = self.labelling, self.controls
        rows = labelling.progress()
        row = next(row for row in rows if row.sequence == self.current)
        picks, names = labelling.picks(self.current), labelling.names
        self._fill_keypoints(names, len(picks))
        alignment = None if self.on_reference or row.problem else labelling.alignment(self.current)
        moved = self._reference_moved(alignment)
        if moved is None:
            controls["overlay"].value = False
        controls["overlay"].disabled = moved is None
        controls["name"].disabled = not self.on_reference and controls["keypoint"].value == _NEXT
        self.buttons["accept"].disabled = alignment is None
        self.buttons["skip"].disabled = self.on_reference
        self.buttons["guess"].disabled = self.on_reference or len(names) < MIN_KEYPOINTS
        self.tables["progress"].value = _progress_table(rows, self.current)
        self.tables["keypoints"].value = _keypoint_table(names, len(picks), alignment, self.on_reference)
        chosen = None if controls["keypoint"].value == _NEXT else controls["keypoint"].value
        blue = f'<b style="color:{BLUE}">●</b> reference {html.escape(labelling.reference)}'
        orange = f'<b style="color:{ORANGE}">●</b> {html.escape(self.current)}'
        self.captions[0].value = blue
        self._show_cloud("reference", labelling.reference, None)
        self.views["reference"].mark(labelling.picks(labelling.reference), chosen)
        if self.on_reference:
            self.shown.pop("sequence", None)
            self.views["sequence"].clear("Empty: no other sequence is chosen")
            self.captions[1].value = "choose another sequence above, or next"
        else:
            on_top = moved if controls["overlay"].value else None
            laid = f'{orange} and <b style="color:{BLUE}">✕</b> the reference, moved'
            self.captions[1].value = orange if on_top is None else laid
            self._show_cloud("sequence", self.current, on_top)
            self.views["sequence"].mark(picks, chosen)
        points = len(self._kept(self.current))
        controls["point"].max = max(points - 1, 0)
        self._cursor(only_move=True)
        if row.problem:
            raise InputError(row.problem)

    def _fill_keypoints(self, names: tuple[str, ...], done: int) -> None:
        """The menu: the next keypoint, and those picked on the sequence looked at."""
        menu = self.controls["keypoint"]
        following = f"next: {done + 1}"
        if not self.on_reference:
            following = f"next: {done + 1} {names[done]}" if done < len(names) else "all picked"
        options = [(following, _NEXT), *((f"{i + 1} {name}", i) for i, name in enumerate(names[:done]))]
        if tuple(options) != menu.options:
            chosen = menu.value if menu.value in [value for _, value in options] else _NEXT
            menu.options = options
            menu.value = chosen

    def _reference_moved(self, alignment: Alignment | None) -> np.ndarray | None:
        """The reference's cloud in the sequence's world, by picks or else by an accepted label; None with neither."""
        if self.on_reference:
            return None
        cloud = self.labelling.cloud(self.labelling.reference)[0]
        if alignment is not None:
            return alignment.sim3.apply(cloud)
        labels = read_labels(self.labelling.root, self.labelling.category)
        if self.current not in labels or len(self.labelling.picks(self.current)):
            return None
        trans = labels[self.current].trans
        return cloud @ trans[:3, :3].T + trans[:3, 3]

    def _show_cloud(self, place: str, sequence: str, on_top: np.ndarray | None) -> None:
        """Send a cloud to its canvas, unless it is there."""
        before = self.shown.get(place, (None, None))
        key = sequence, None if on_top is None else on_top[:: max(len(on_top) // 50, 1)].tobytes()
        if before == key:
            return
        points, colours = self.labelling.cloud(sequence)
        alt = f"Point cloud of {sequence}. The slider named point chooses a point by keyboard, the arrow keys turn it."
        overlay = None if on_top is None else (on_top, _rgb(BLUE), _rgb(ORANGE))
        view = self.labelling.first_view(sequence) if before[0] != sequence else None
        try:
            self.views[place].show(points, colours, view, alt, overlay)
        except InputError as error:
            self.shown.pop(place, None)
            self.views[place].clear(f"Nothing: {error}")
            raise InputError(f"sequence {sequence}: {error}") from error
        self.shown[place] = key

    def _kept(self, sequence: str) -> np.ndarray:
        if sequence not in self.kept:
            self.kept[sequence] = subsample(self.labelling.cloud(sequence)[0])
        return self.kept[sequence]

    def _slider_point(self) -> np.ndarray:
        kept = self._kept(self.current)
        return self.labelling.cloud(self.current)[0][kept[min(self.controls["point"].value, len(kept) - 1)]]

    def _cursor(self, only_move: bool = False) -> None:
        """The cross-hair on the slider's point; `only_move`: leave it away where it is not shown."""
        here, other = ("reference", "sequence") if self.on_reference else ("sequence", "reference")
        self.views[other].point_at(None)
        if not only_move or self.views[here].widget.cursor:
            self.views[here].point_at(self._slider_point())

    @contextmanager
    def _change(self, sequence: str):
        """A change of a sequence's picks that can be undone, unless it is refused."""
        names = self.labelling.names if sequence == self.labelling.reference else ()
        before = sequence, self.labelling.picks(sequence), names
        yield
        self.history.append(before)

    def _next_open(self, sequence: str) -> str:
        """The first open sequence after this one, from the start again at the end; itself where none is open."""
        rows = self.labelling.progress()
        place = [row.sequence for row in rows].index(sequence)
        following = rows[place + 1 :] + rows[:place]
        return next((row.sequence for row in following if row.state == OPEN), sequence)


def _rgb(colour: str) -> tuple[int, int, int]:
    return tuple(bytes.fromhex(colour[1:]))


def _progress_table(rows, current: str) -> str:
    body = "".join(
        f"<tr{' aria-current=true' * (row.sequence == current)}><td>{'▸' * (row.sequence == current)}</td>"
        f"<td>{html.escape(row.sequence)}</td><td>{_SIGNS.get(row.state, '●')} {row.state}</td>"
        f'<td class="number">{row.picks}</td><td class="number">{_residual(row)}</td></tr>'
        for row in rows
    )
    head = "<th></th><th>sequence</th><th>state</th><th>keypoints</th><th>residual</th>"
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def _residual(row) -> str:
    return "see above" if row.problem else "" if row.rms is None else f"{100 * row.rms:.1f} %"


def _keypoint_table(names, done: int, alignment: Alignment | None, on_reference: bool) -> str:
    worst = None if alignment is None else int(alignment.residuals.argmax())
    body = ""
    for index, name in enumerate(names):
        state = "✓" if index < done else "next" if index == done else ""
        residual = "" if alignment is None else f"{100 * alignment.residuals[index]:.1f} %"
        far = " ← largest" if index == worst else ""
        body += f"<tr><td>{index + 1}</td><td>{html.escape(name)}</td><td>{state}</td>"
        body += f'<td class="number">{residual}</td><td>{far}</td></tr>'
    if not names:
        body = "<tr><td></td><td>none yet</td><td></td><td></td><td></td></tr>"
    head = "<th></th><th>keypoint</th><th>picked</th><th>residual</th><th></th>"
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def example_label_poses() -> "VBox":
    """The widget on a temporary copy of a sample category, with four keypoints picked on two objects."""
    folder = TemporaryDirectory(prefix="zsp-lite-")
    category = Co3D(sample_data()).categories()[0]
    shutil.copytree(sample_data() / category, Path(folder.name) / category)
    labelling = Labelling(folder.name, category)
    for sequence in labelling.sequences[:2]:
        points = labelling.cloud(sequence)[0]
        for point in points[:: len(points) // 4][:4]:
            labelling.pick(sequence, point)
    box = label_poses(labelling)
    box.controls["sequence"].value = labelling.sequences[1]
    box.folder = folder  # goes when the widget does
    return box
