"""The exercises: given cells run, the solutions pass every test, the students' version none,
typical mistakes fail."""

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest
from nbformat import NotebookNode
from nbgrader.api import Gradebook
from nbgrader.preprocessors import ClearHiddenTests, ClearMarkScheme, ClearSolutions
from nbgrader.tests import run_nbgrader
from traitlets.config import Config, PyFileConfigLoader

from zsp_lite.views import View

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore::sqlalchemy.exc.SAWarning")]

EXERCISES = Path(__file__).parents[1] / "notebooks/exercises"
ASSIGNMENTS = sorted(folder.name for folder in (EXERCISES / "source").iterdir())

# For each assignment and function: the name of a mistake, the part of the solution to replace, and
# its replacement. The first is the commonest.
MISTAKES = json.loads(Path(__file__).with_name("exercise_mistakes.json").read_text("utf-8"))

# For each assignment: a statement of a marking guide, and an expression that holds for what the
# given cells computed. Of the power in 05_metrics: a gain of 3 points at a discordance of 12 %,
# z = 2, and z = 1.96 + 0.84 for a power of 80 %.
STATEMENTS = json.loads(Path(__file__).with_name("exercise_statements.json").read_text("utf-8"))


def turned_similarity(described: Callable[[np.ndarray], np.ndarray], view: View) -> float:
    """Mean cosine of a grid's descriptors with those of the same grid, turned by 90 degrees and
    back again."""
    keys = view.features.keys.numpy()
    turned = np.rot90(described(np.rot90(keys).copy()), -1)
    a, b = [x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (described(keys), turned)]
    return (a * b).sum(axis=-1).mean()


@pytest.fixture(scope="module")
def config() -> Config:
    """The course's settings of nbgrader."""
    return PyFileConfigLoader("nbgrader_config.py", path=str(EXERCISES)).load_config()


def source(assignment: str) -> NotebookNode:
    """The notebook with solutions."""
    return nbformat.read(EXERCISES / "source" / assignment / f"{assignment}.ipynb", as_version=4)


def graded(notebook: NotebookNode, **kind) -> dict[str, NotebookNode]:
    """Cells by grade id whose nbgrader metadata have these values: solution=True,
    grade=False, ..."""
    return {
        cell.metadata.nbgrader.grade_id: cell
        for cell in notebook.cells
        if "nbgrader" in cell.metadata and kind.items() <= cell.metadata.nbgrader.items()
    }


def code(notebook: NotebookNode, **kind) -> str:
    """The source of such cells."""
    return "\n".join(cell.source for cell in graded(notebook, **kind).values())


def students_version(assignment: str, config: Config) -> NotebookNode:
    """The source without solutions, hidden tests and guides for marking, as `nbgrader
    generate_assignment` makes it."""
    notebook = source(assignment)
    for clear in (ClearSolutions, ClearHiddenTests, ClearMarkScheme):
        notebook, _ = clear(config=config).preprocess(notebook, {})
    return notebook


@pytest.fixture(scope="module")
def prepared():
    """Function that returns a copy of the names an assignment's setup cell defines; the cell runs
    once."""
    namespaces = {}

    def prepare(assignment):
        if assignment not in namespaces:
            namespaces[assignment] = {}
            exec(graded(source(assignment), locked=True)["setup"].source, namespaces[assignment])
        return dict(namespaces[assignment])

    return prepare


def failing_tests(namespace: dict, answers: NotebookNode, tests: NotebookNode) -> dict[str, str]:
    """Messages by the name of the test cells of notebook `tests` that fail for the functions
    defined in notebook `answers`."""
    exec(code(answers, solution=True, grade=False), namespace)
    failing = {}
    for name, cell in graded(tests, grade=True, solution=False).items():
        try:
            exec(cell.source, dict(namespace))
        except (
            AssertionError,
            ValueError,
            TypeError,
            IndexError,
            ArithmeticError,
            NotImplementedError,
        ) as error:
            failing[name] = f"{error}"
    return failing


def names_of_tests(assignment: str, function: str) -> set[str]:
    """Names of the test cells of a function: test_FUNCTION_1, ..."""
    names = graded(source(assignment), grade=True)
    return {name for name in names if re.fullmatch(rf"test_{function}_\d", name)}


def mistaken(assignment: str, function: str, mistake: str) -> NotebookNode:
    """The source with a mistake in the solution."""
    notebook = source(assignment)
    cell = graded(notebook, solution=True)[function]
    right, wrong = MISTAKES[assignment][function][mistake]
    assert right in cell.source, f"the solution does not contain {right!r}"
    cell.source = cell.source.replace(right, wrong)
    return notebook


def tasks(notebook: NotebookNode) -> list[list[NotebookNode]]:
    """The cells of each task, which begins with a heading."""
    found = []
    for cell in notebook.cells:
        if cell.cell_type == "markdown" and cell.source.startswith("## Task"):
            found.append([])
        if found:
            found[-1].append(cell)
    return found


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_the_given_cells_run_and_agree_with_the_expected_outputs_and_the_guides(
    prepared, config, assignment, capsys
):
    """No given cell needs more than the first cell of the notebook and the functions of its own
    task."""
    handed_out = students_version(assignment, config)
    solutions = graded(source(assignment), solution=True)
    computed = {"turned_similarity": turned_similarity}
    expected = 0
    for cells in tasks(handed_out):
        namespace = prepared(assignment)
        exec(code(handed_out, solution=True, grade=False), namespace)
        for cell, following in zip(cells, [*cells[1:], None], strict=True):
            if cell.cell_type == "code" and "nbgrader" not in cell.metadata:
                capsys.readouterr()
                exec(cell.source, namespace)
                if following.source.startswith("Expected:"):
                    (text,) = re.findall(r"```text\n(.*?)\n```", following.source, re.DOTALL)
                    assert capsys.readouterr().out.strip() == text.strip()
                    expected += 1
            elif cell.cell_type == "code" and cell.metadata.nbgrader.solution:
                exec(solutions[cell.metadata.nbgrader.grade_id].source, namespace)
        computed |= namespace
    plt.close("all")
    assert expected == len(MISTAKES[assignment])
    exec(code(source(assignment), solution=True, grade=False), computed)
    guides = " ".join(code(source(assignment), solution=True, grade=True).split())
    for statement, expression in STATEMENTS[assignment].items():
        assert statement in guides
        assert eval(expression, computed), statement


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_the_solutions_pass_every_test_and_the_students_version_none(prepared, config, assignment):
    notebook = source(assignment)
    handed_out = students_version(assignment, config)
    text = "\n".join(cell.source for cell in handed_out.cells)
    assert not re.search("SOLUTION|HIDDEN|Guide for marking", text)
    assert failing_tests(prepared(assignment), notebook, notebook) == {}
    every = set(graded(notebook, grade=True, locked=True))
    assert failing_tests(prepared(assignment), handed_out, notebook).keys() == every


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # some mistakes divide by zero or overflow
@pytest.mark.parametrize(
    "assignment, function, mistake",
    [
        (assignment, function, mistake)
        for assignment, of_functions in MISTAKES.items()
        for function, mistakes in of_functions.items()
        for mistake in mistakes
    ],
)
def test_each_mistake_fails_its_own_function_and_students_see_that_of_the_commonest(
    prepared, config, assignment, function, mistake
):
    notebook = mistaken(assignment, function, mistake)
    failing = failing_tests(prepared(assignment), notebook, notebook)
    assert failing and failing.keys() <= names_of_tests(assignment, function)
    if mistake == next(iter(MISTAKES[assignment][function])):
        seen = failing_tests(prepared(assignment), notebook, students_version(assignment, config))
        # The message says what to look at.
        assert seen and all(len(message.split()) > 4 for message in seen.values())


def test_the_minutes_of_the_labs_add_up_in_the_guide_and_on_the_slides():
    # The guide has a table for the lab of 90 minutes: until when, what, and how many minutes. The
    # slides of this lab name the same times; those of three longer ones, the minutes of each part.
    guide = (EXERCISES.parent / "README.md").read_text("utf-8")
    rows = re.findall(r"^\| (\d+) \| .* \| ([\d +]+) \|$", guide, re.MULTILINE)
    ends = np.cumsum([int(part) for _, minutes in rows for part in minutes.split("+")])
    *three, one = sorted(EXERCISES.parents[1].glob("docs/slides/lab_*"))
    until = re.findall(r"until \D*(\d+)", one.read_text("utf-8"))
    assert {"90", *until, *dict(rows)} <= {*map(str, ends)}
    for deck in three:
        assert sum(map(int, re.findall(r"(\d+) min\b", deck.read_text("utf-8")))) == 120  # 2 h


CALLS_THE_LIBRARY = """
own = {0}
def {0}(*arguments):
    from zsp_lite.metrics import rotation_angle as alias
    alias(np.eye(3), np.eye(3))
    return own(*arguments)"""


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_a_function_that_calls_the_library_fails_all_its_tests(prepared, assignment):
    for function in MISTAKES[assignment]:
        notebook = source(assignment)
        graded(notebook, solution=True)[function].source += CALLS_THE_LIBRARY.format(function)
        failing = failing_tests(prepared(assignment), notebook, notebook)
        assert failing.keys() == names_of_tests(assignment, function)


def copied(cell: NotebookNode) -> NotebookNode:
    """Copy a cell as JupyterLab does, with an id of its own."""
    return NotebookNode(deepcopy(cell), id=f"{cell.id}-copy")


def turn_into_text(cell: NotebookNode) -> None:
    """Make a text cell of a code cell."""
    cell.cell_type = "markdown"
    del cell["outputs"], cell["execution_count"]


# Reasons that the list of grades has, and the damage to a solution that is the cause of each.
DAMAGES = {
    "cells that are there twice": lambda cell, cells: cells.append(copied(cell)),
    "solutions that are not code": lambda cell, _: turn_into_text(cell),
    "cells deleted or without metadata": lambda cell, _: cell.metadata.pop("nbgrader"),
    "cells of another release": lambda cell, _: cell.metadata.nbgrader.update(
        checksum="", schema_version=2
    ),
}


METRICS = "05_metrics"
LAB = "lab_90_minutes"
RIGHT, CALLS, _ = MISTAKES[METRICS]  # the task that Ada has right, and where she calls the library


class Collected(NamedTuple):
    """What the commands of a lecturer make of the hand-ins of an assignment."""

    folder: Path  # of the exercises
    times: list[list[str]]  # of the hand-ins of Ada and Bob, at the first and the second collection
    log: str  # of `autograde`
    exported: str  # the output of `export` before the answers are graded by hand
    points: dict[str, float]  # of the tests of Ada's notebook
    unignored: str  # what git would add


@pytest.fixture(scope="module")
def collected(tmp_path_factory) -> Collected:
    """Ada has one task right and calls the library in another; Bob's file is damaged, Eve's a PDF,
    Dan has two."""
    root = tmp_path_factory.mktemp("course")
    folder = copy_course(root)
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("MPLBACKEND", raising=False)  # the kernel draws as it does for students
        # nbgrader starts the program `alembic`, which is installed beside the interpreter.
        patch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
        patch.setenv("PYTHONPATH", str(EXERCISES.parents[1]))
        patch.setattr(os, "environ", os.environ)  # run_nbgrader replaces it
        patch.setattr(sys, "path", [*sys.path])
        patch.chdir(folder)
        git(root, "init")
        git(root, "add", ".")
        run_nbgrader(["generate_assignment", METRICS])
        times = []
        for bob in ("{", "{{"):  # a second time, after another download
            download(folder, answered(folder), bob)
            run_nbgrader(["zip_collect", METRICS])
            stored = sorted(folder.glob("submitted/12[34]/*/timestamp.txt"))
            times.append([path.read_text() for path in stored])
        log = run_nbgrader(["autograde", METRICS], retcode=1)  # as one is damaged
        exported = run_nbgrader(["export"])
        points = grade_by_hand(folder)
        run_nbgrader(["export"])
        run_nbgrader(["generate_feedback", METRICS, "--force"])
    unignored = git(root, "ls-files", "--others", "--exclude-standard")
    return Collected(folder, times, log, exported, points, unignored)


def git(root: Path, *words: str) -> str:
    """Run git on a folder; returns what it printed."""
    return subprocess.run(["git", *words], cwd=root, capture_output=True, text=True).stdout


def copy_course(root: Path) -> Path:
    """Copy what a lecturer needs of the repository; returns the folder of the exercises."""
    folder = root / "notebooks/exercises"
    shutil.copytree(EXERCISES / "source" / METRICS, folder / "source" / METRICS)
    shutil.copy(EXERCISES / "nbgrader_config.py", folder)
    shutil.copy(EXERCISES.parents[1] / ".gitignore", root)
    return folder


def answered(folder: Path) -> NotebookNode:
    """Ada's notebook."""
    notebook = nbformat.read(folder / "release" / METRICS / f"{METRICS}.ipynb", as_version=4)
    solutions = graded(source(METRICS), solution=True)
    answers = graded(notebook, solution=True)
    answers[RIGHT].source = solutions[RIGHT].source
    answers[CALLS].source = solutions[CALLS].source + CALLS_THE_LIBRARY.format(CALLS)
    answers["better"].source = "See my remark: [Comment](#mine), $\\lambda R$ and $\\broken{$"
    return notebook


def download(folder: Path, notebook: NotebookNode, bob: str) -> None:
    """Write the hand-ins as a learning platform packs them, with its list of participants."""
    downloads = folder / "downloaded" / METRICS
    (downloads / "archive").mkdir(parents=True, exist_ok=True)
    files = {}
    for number, damage in enumerate(DAMAGES.values(), 110):  # of a participant
        damaged = deepcopy(notebook)
        damage(graded(damaged)[RIGHT], damaged.cells)
        files[f"A_{number}_assignsubmission_file_{METRICS}.ipynb"] = nbformat.writes(damaged)
    # Changes of given cells, which nbgrader puts back.
    text, test, stripped, *_ = graded(notebook, grade=True, locked=True).values()
    turn_into_text(text)
    notebook.cells.insert(1, copied(test))
    stripped.metadata.pop("nbgrader")
    whole = nbformat.writes(notebook)
    files |= {
        f"Ada Lovelace_123_assignsubmission_file_{METRICS} (1).ipynb": whole,
        f"Bob_124_assignsubmission_file_{METRICS}.ipynb": bob,
        "Eve_125_assignsubmission_file_homework.pdf": "",
        f"Dan_126_assignsubmission_file_{METRICS}.ipynb": whole,
        f"Dan_126_assignsubmission_file_{METRICS} (1).ipynb": whole,
    }
    with zipfile.ZipFile(downloads / "archive/all.zip", "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    lines = "".join(f"\nParticipant {number}," for number in range(123, 127))
    (downloads / "worksheet.csv").write_text(f"\ufeffIdentifier,Grade{lines}")


def grade_by_hand(folder: Path) -> dict[str, float]:
    """Give Ada 1.5 points for each answer; returns those of the tests."""
    with Gradebook(f"sqlite:///{folder / 'gradebook.db'}", "zsp-lite") as gradebook:
        grades = gradebook.find_submission(METRICS, "123").notebooks[0].grades
        points = {
            grade.name: grade.auto_score for grade in grades if grade.cell.cell_type == "code"
        }
        for grade in grades:
            if grade.needs_manual_grade:
                grade.manual_score = 1.5
                grade.needs_manual_grade = False
        gradebook.db.commit()
    return points


def test_each_test_of_a_task_that_is_right_gives_two_points_and_the_others_none(collected):
    assert collected.points == {
        f"test_{task}_{i}": 2 * (task == RIGHT) for task in MISTAKES[METRICS] for i in (1, 2)
    }


def test_several_loops_cost_no_more_than_the_limit_and_spare_other_functions(config, monkeypatch):
    execute = config.Autograde.autograde_preprocessors[0]
    # Seconds for a cell, and for all cells that do not end: enough for both loops.
    monkeypatch.setitem(execute.preprocess.__globals__, "LIMIT", 3)
    monkeypatch.setitem(execute.preprocess.__globals__, "LOST", 6)
    cells = []
    for i, statement in enumerate(["while True: pass", "pass", "while True: pass", "pass"]):
        for is_solution, line in ((True, f"def f{i}():\n    {statement}"), (False, f"f{i}()")):
            cells += [
                nbformat.v4.new_code_cell(line, metadata={"nbgrader": {"solution": is_solution}})
            ]
        cells.append(copied(cells[-1]))  # a second test
    notebook, _ = execute(config=config).preprocess(nbformat.v4.new_notebook(cells=cells), {})
    failed = [bool(cell.outputs) for cell in notebook.cells]
    # A function and its two tests. After the second loop no time is left for the last function.
    stopped = [False, True, True]
    passed = [False] * 3
    assert failed == stopped + passed + stopped + [True] * 3
    # The first test did not end; the second one was not run.
    (first, *_), (second, *_) = (notebook.cells[i].outputs[::-1] for i in (1, 2))
    assert first.traceback != second.traceback == ["not run: a cell before this one did not end"]


def test_tests_that_students_changed_are_put_back(collected):
    changed = re.findall("(?:'checksum' for|Missing grade) cell (\\w+)", collected.log)
    assert set(changed) == set(collected.points)


def test_the_export_names_who_has_answers_to_be_graded_by_hand(collected):
    assert "123: answers to be graded by hand" in collected.exported


def test_every_hand_in_is_graded_or_named_with_the_reason(collected):
    _, *lines = (collected.folder / "grades.csv").read_text().splitlines()
    states = [line.removeprefix(f"{METRICS},") for line in lines]
    not_graded = "{0},,20,not graded: submitted/{0}/05_metrics/05_metrics.ipynb: {1}".format
    damaged = [not_graded(i, f"{cause}: {RIGHT}") for i, cause in enumerate(DAMAGES, 110)]
    *graded_or_damaged, dan = states
    assert graded_or_damaged == [
        *damaged,
        "123,5.5,20,graded",  # 4 for two tests, 1.5 for the answer that was written
        not_graded(124, "damaged file"),
        "125,,20,not collected: all/Eve_125_assignsubmission_file_homework.pdf",
    ]
    assert dan.startswith('126,,20,"not collected: 2 files, all/Dan_126')
    for state in damaged:
        assert state.rpartition(",")[2] in collected.log


def test_the_worksheet_of_the_platform_is_filled(collected):
    path = collected.folder / "downloaded" / METRICS / "worksheet_filled.csv"
    _, *lines = path.read_text().splitlines()
    assert lines == [f"Participant {end}" for end in ("123,5.5", "124,", "125,", "126,")]


def test_a_second_collection_renews_only_files_that_changed(collected):
    """`nbgrader autograde` grades again what has a newer time, and then asks for new points by
    hand."""
    (ada, bob), (ada_again, bob_again) = collected.times
    assert ada == ada_again
    assert bob < bob_again


def test_git_sees_no_hand_in(collected):
    assert collected.unignored == ""


@pytest.fixture
def feedback(collected) -> str:
    """The page for Ada."""
    path = collected.folder / "feedback/123" / METRICS / f"{METRICS}.html"
    return path.read_text("utf-8")


def test_the_feedback_has_a_score_for_each_task_and_answer_and_the_hidden_tests(feedback):
    scores = re.findall(
        r'<li><a href="#\w+">(.*?)</a> \(Score: ([\d.]+) / ([\d.]+)\)</li>', feedback
    )
    assert scores[0] == ("Task 1 · Symmetric objects: An n-fold symmetry", "2.0", "2.0")
    assert len(scores) == len(MISTAKES[METRICS]) * 2 + 2  # two tests of each task, two answers
    assert "HIDDEN TESTS" in feedback
    assert "Test cell" not in feedback


def test_the_feedback_shows_formulas_and_loads_nothing(feedback):
    # The student's own link, and no other.
    assert re.findall(r'href="([^"]*)">Comment</a>', feedback) == ["#mine"]
    assert "<math" in feedback
    assert "<code>\\broken{</code>" in feedback
    loads = r"""<script|(src|href)=["'](?!#|data:)|url\(["']?http"""
    assert not re.search(loads, feedback)


@pytest.mark.parametrize(
    "name",
    [
        "Ada Lovelace_123_assignsubmission_file_05_metrics.ipynb",
        "Ada Lovelace_123_assignsubmission_file_/05_metrics.ipynb",
        "Ada Lovelace_123_assignsubmission_file_05_metrics (1).ipynb",
        "lovelaceada_LATE_123_67890_05_metrics-2.ipynb",
        "lovelaceada_123_67890_05_metrics-Copy1.ipynb",
        "Ada Lovelace_123_assignsubmission_file_lab_90_minutes.ipynb",
        "lovelaceada_123_67890_lab_90_minutes-1.ipynb",
    ],
)
def test_nbgrader_recognises_the_files_of_learning_platforms(config, name):
    path = f"downloaded/{METRICS}/extracted/all/{name}"
    found = re.match(config.FileNameCollectorPlugin.named_regexp, path)
    assignment = LAB if LAB in name else METRICS
    assert found.groupdict() == {"student_id": "123", "file_id": assignment}
