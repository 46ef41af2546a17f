"""The controls, canvases and tables of the labelling widget, without its behaviour."""

import html
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from zsp_lite.labelling.keypoints import Alignment
from zsp_lite.labelling.session import ACCEPTED, OPEN, SKIPPED, Progress
from zsp_lite.widgets.cloud_view import CloudView
from zsp_lite.widgets.common import load_package

_STATE_SYMBOLS = {ACCEPTED: "✓", OPEN: "○", SKIPPED: "–"}
_TOOLTIPS = {
    "undo": "Remove the last keypoint of this sequence",
    "redo": "Remove all keypoints of this sequence",
    "accept": "Write the label of this sequence",
    "skip": "Leave this sequence without a label",
    "next": "Go to the next open sequence",
    "pick": "Pick the point under the cross-hair",
}
_HELP = (
    "Click: pick. Drag: rotate. Shift and drag: pan. Wheel: zoom, after a click on the cloud. Keyboard: arrows and + − "
    "on a cloud; the slider chooses a point, the button picks it."
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


class Panel:
    """The parts of the labelling widget by name; `box` contains them all. CSS classes begin with `zsp-`."""

    def __init__(
        self,
        sequences: Sequence[str],
        on_click: Callable[[str, np.ndarray | None], Any],
        on_change: Callable[[str], Any],
        on_button: Callable[[str], Any],
    ):
        """Create the widgets; `on_click` gets the name of a canvas and the world point, the others that of a part."""
        widgets = load_package()
        options = [(f"{sequences[0]} (reference)", sequences[0]), *((name, name) for name in sequences[1:])]
        style = {"description_width": "initial"}
        self.views = {
            name: CloudView(f"zsp-cloud-{name}", lambda point, name=name: on_click(name, point))
            for name in ("reference", "sequence")
        }
        self.controls = {
            "sequence": widgets.Dropdown(options=options, description="sequence", style=style),
            "name": widgets.Text(description="name", placeholder="for example: left arm", continuous_update=False,
                                 style=style, layout={"width": "16em"}),
            "overlay": widgets.ToggleButton(description="overlay", tooltip="Show both clouds, aligned, in two colours",
                                            layout={"width": "auto"}),
            "point": widgets.IntSlider(description="point", style=style, layout={"width": "32em"}),
        }  # fmt: skip
        self.buttons = {
            name: widgets.Button(description=name, tooltip=tooltip, layout={"width": "auto"})
            for name, tooltip in _TOOLTIPS.items()
        }
        self.tables = {name: widgets.HTML() for name in ("progress", "keypoints")}
        self.message, self.captions = widgets.HTML(), {name: widgets.HTML() for name in self.views}
        self.message.add_class("zsp-message")
        for name, part in (self.controls | self.buttons | self.tables).items():
            part.add_class(f"zsp-{name}")
        for name, control in self.controls.items():
            control.observe(lambda _, name=name: on_change(name), names="value")
        for name, button in self.buttons.items():
            button.on_click(lambda _, name=name: on_button(name))
        self.box = widgets.VBox(self._rows(widgets))
        self.box.add_class("zsp-label")
        self.box.controls = {name: control for name, control in self.controls.items() if name != "name"}
        self.box.name, self.box.buttons, self.box.views = self.controls["name"], self.buttons, self.views
        self.box.message, self.box.tables = self.message, self.tables

    def _rows(self, widgets) -> list:
        controls, buttons = self.controls, self.buttons
        edit, finish = ([buttons[name] for name in names] for names in (("undo", "redo"), ("accept", "skip", "next")))
        clouds = [
            widgets.VBox([self.captions[name], view.widget], layout={"margin": "0 8px 0 0"})
            for name, view in self.views.items()
        ]
        wrap = {"flex_flow": "row wrap"}
        centred = wrap | {"align_items": "center"}
        return [
            widgets.HTML(_STYLE),
            widgets.HBox([controls["sequence"], controls["name"]], layout=centred),
            widgets.HBox([*edit, controls["overlay"], *finish], layout=centred),
            self.message,
            widgets.HBox(clouds, layout=wrap),
            widgets.HTML(_HELP),
            widgets.HBox([controls["point"], buttons["pick"]], layout=centred),
            widgets.HBox(list(self.tables.values()), layout=wrap | {"align_items": "flex-start"}),
        ]

    def show_message(self, text: str, problem: bool = False) -> None:
        """Show one line above the clouds, announced by screen readers."""
        kind, prefix = ("problem", "Not done: ") if problem else ("info", "")
        self.message.value = f'<p class="{kind}" role="status" aria-live="polite">{prefix}{html.escape(text)}</p>'

    def show_progress(self, rows: Sequence[Progress], current: str) -> None:
        """Fill the table of sequences."""
        cells = []
        for row in rows:
            residual = "see above" if row.problem else "" if row.rms is None else f"{100 * row.rms:.1f} %"
            marker = "▸" if row.sequence == current else ""
            state = f"{_STATE_SYMBOLS.get(row.state, '●')} {row.state}"
            cells.append((marker, row.sequence, state, str(row.picks), residual))
        current_index = [row.sequence for row in rows].index(current)
        head = ("", "sequence", "state", "keypoints", "residual")
        self.tables["progress"].value = _table(head, cells, numbers=(3, 4), current=current_index)

    def show_keypoints(self, names: Sequence[str], picked: int, alignment: Alignment | None) -> None:
        """Fill the table of keypoints, of which the first `picked` are picked on the current sequence."""
        worst = None if alignment is None else int(alignment.residuals.argmax())
        cells = []
        for index, name in enumerate(names):
            state = "✓" if index < picked else "next" if index == picked else ""
            residual = "" if alignment is None else f"{100 * alignment.residuals[index]:.1f} %"
            cells.append((str(index + 1), name, state, residual, " ← largest" if index == worst else ""))
        head = ("", "keypoint", "picked", "residual", "")
        self.tables["keypoints"].value = _table(head, cells or [("", "none yet", "", "", "")], numbers=(3,))


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], numbers: Sequence[int], current: int = -1) -> str:
    """Return an HTML table; the columns `numbers` are right-aligned, the row `current` is highlighted."""
    body = ""
    for index, row in enumerate(rows):
        cells = (
            f'<td class="number">{html.escape(cell)}</td>' if column in numbers else f"<td>{html.escape(cell)}</td>"
            for column, cell in enumerate(row)
        )  # fmt: skip
        body += f"<tr{' aria-current=true' if index == current else ''}>{''.join(cells)}</tr>"
    header = "".join(f"<th>{cell}</th>" for cell in head)
    return f"<table><thead><tr>{header}</tr></thead><tbody>{body}</tbody></table>"
