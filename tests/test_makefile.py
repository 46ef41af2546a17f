"""The Makefile: pip's settings reach pip, and `make lab` works on a copy, also as root.

Python is a script here.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

REPOSITORY = Path(__file__).parents[1]
# Writes down its arguments and pip's settings. `-m venv FOLDER` makes a copy of itself.
PYTHON = """#!/bin/sh
echo "$* [$PIP_INDEX_URL] [$PIP_EXTRA_INDEX_URL]" >> "$LOG"
[ "$2" != venv ] || { mkdir -p "$3/bin" && cp "$0" "$3/bin/python"; }
"""

pytestmark = pytest.mark.skipif(
    sys.platform == "win32" or not shutil.which("make"), reason="needs make and a shell"
)


@pytest.fixture
def folder(tmp_path):
    """A repository of the Makefile and what it reads, with `PYTHON`, and an `id` that says who the
    user is."""
    for name in ("Makefile", "environment.txt", "pyproject.toml"):
        shutil.copy(REPOSITORY / name, tmp_path)
    (tmp_path / "notebooks/exercises/source").mkdir(parents=True)
    (tmp_path / "notebooks/00.ipynb").write_text("original")
    for name, content in (("python", PYTHON), ("id", "#!/bin/sh\necho $USER_ID\n")):
        path = tmp_path / "bin" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(content)
        path.chmod(0o755)
    return tmp_path


def make(folder: Path, target: str, **environment) -> tuple[str, list[str]]:
    """What `make` printed, and the calls of Python."""
    log = folder / "calls"
    path = f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}"
    inherited = {
        key: value
        for key, value in os.environ.items()
        if not key.startswith(("PIP_", "MAKE", "MFLAGS"))
    }
    variables = (
        inherited
        | {"LOG": str(log), "PATH": path, "PYTHON": str(folder / "bin/python")}
        | environment
    )
    run = subprocess.run(
        ["make", target], cwd=folder, env=variables, capture_output=True, text=True, check=True
    )
    return run.stdout, log.read_text().splitlines()


def test_the_users_package_index_reaches_pip(folder):
    _, calls = make(
        folder, "doctor", PIP_INDEX_URL="https://mine/simple", PIP_EXTRA_INDEX_URL="https://cpu/whl"
    )
    (install,) = [call for call in calls if "pip install" in call and "environment.txt" in call]
    assert install.endswith("[https://mine/simple] [https://cpu/whl]")


@pytest.mark.parametrize("user, is_root", [("0", True), ("1000", False)])
def test_lab_opens_a_copy_of_the_notebooks_and_says_why_it_allows_root(folder, user, is_root):
    text, calls = make(folder, "lab", USER_ID=user)
    assert ("--allow-root" in calls[-1]) == ("You are root" in text) == is_root
    # The root is the repository, so that links of the notebooks to docs/ lead somewhere.
    options = {
        "--ServerApp.root_dir=.",
        "--LabApp.default_url=/lab/tree/my_notebooks",
    }
    assert options <= set(calls[-1].split())
    assert "labextension disable @jupyterlab/apputils-extension:announcements" in calls[-2]
    assert not (folder / "my_notebooks/exercises/source").exists()
    (folder / "my_notebooks/00.ipynb").write_text("changed")
    text, _ = make(folder, "lab", USER_ID=user)
    assert (folder / "notebooks/00.ipynb").read_text() == "original"
    assert (folder / "my_notebooks/00.ipynb").read_text() == "changed"
    assert "move that folder away" in text
    assert "-m tools.lab my_notebooks.new" in " ".join(calls)


def test_the_copy_keeps_all_outputs_but_those_that_answer_a_prediction(tmp_path):
    made = nbformat.v4
    shown = [made.new_output("stream", text="42")]
    # Two cells of text and three of code, in the order of `cells` below.
    texts = ["A question. **Break it, predict, then run.** How many?", "Text."]
    codes = ["6 * 7", 'self_check("00", 1)', "6 + 7"]
    ask, text = map(made.new_markdown_cell, texts)
    answer, quiz, other = (made.new_code_cell(code, outputs=shown) for code in codes)
    cells = [ask, answer, quiz, text, other]
    nbformat.write(made.new_notebook(cells=cells), tmp_path / "00.ipynb")
    command = [sys.executable, "-m", "tools.lab", str(tmp_path)]
    subprocess.run(command, cwd=REPOSITORY, check=True)
    kept = nbformat.read(tmp_path / "00.ipynb", 4).cells
    # Of the cells with outputs, `answer` loses them, `quiz` and `other` keep them.
    assert [bool(cell.get("outputs")) for cell in kept] == [0, 0, 1, 0, 1]
