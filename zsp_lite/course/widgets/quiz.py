"""Self-checks: questions with instant feedback in a notebook, from the files `questions/NN.json`,
by jupyterquiz.

A file has the questions of one notebook: a list of self-checks, each a list of questions in
jupyterquiz's format (the types "multiple_choice", "many_choice" and "numeric"). Texts are HTML:
`<i>K</i>`, `<sub>`, `&lt;`; LaTeX is not shown.
"""

import json
from pathlib import Path

from zsp_lite.course.widgets.common import load_package
from zsp_lite.errors import InputError, check_choice, check_integer
from zsp_lite.viz.plots import BLUE

QUESTIONS = Path(__file__).parent / "questions"
# These colours are legible on dark pages, too. Colour-blind readers can tell the blue-green of
# right answers from the orange of wrong ones.
_COLOURS = {
    **{f"--jq-{kind}-bg": BLUE for kind in ("multiple-choice", "many-choice", "numeric")},
    "--jq-correct-color": "#007A5A",
    "--jq-incorrect-color": "#C24E00",
    "--jq-numeric-input-label": "currentColor",
}
_STYLE = """
input.Input-text, input.Input-text:focus { border: 1px solid #555; background: white; color: #222; }
.Quiz .Answer { grid-template-columns: 1fr; }
.Quiz .MCButton { justify-content: flex-start; gap: 0.7em; text-align: left; }
.Quiz .MCButton input { flex: none; margin: 0; color-scheme: light; }
"""


def read_questions(notebook: str) -> list[list[dict]]:
    """Return the self-checks of a notebook ("00"), in their order."""
    known = {path.stem: path for path in sorted(QUESTIONS.glob("*.json"))}
    check_choice("notebook", notebook, known)
    return json.loads(known[notebook].read_text(encoding="utf-8"))


def self_check(notebook: str, number: int) -> None:
    """Show a self-check of a notebook ("00") below the cell, the first by 1; answers get feedback
    without a kernel."""
    checks = read_questions(notebook)
    check_integer("number", number, 1, len(checks))
    jupyterquiz = load_package("jupyterquiz")
    ipython = load_package("IPython")
    if ipython.get_ipython() is None:
        raise InputError("self_check was called outside IPython, expected a notebook")
    with ipython.utils.capture.capture_output() as captured:
        jupyterquiz.display_quiz(checks[number - 1], colors=_COLOURS)
    # The form is a <div> that jupyterquiz leaves open: the style goes inside, and closes it.
    form, script = captured.outputs
    html = f"{form.data['text/html']}<style>{_STYLE}</style></div>"
    display = ipython.display
    display.display(display.HTML(html))
    # Where a page has MathJax, jupyterquiz would replace it by one from the network: hide it from
    # the script.
    hidden = f"{{ let MathJax;\n{script.data['application/javascript']}\n}}"
    display.display(display.Javascript(hidden))
