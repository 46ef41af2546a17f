"""The exercises: the solutions pass every test, the students' version passes none, and typical mistakes fail."""

import os
import re
import shutil
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import nbformat
import pytest
from nbgrader.api import Gradebook
from nbgrader.apps.api import NbGraderAPI
from nbgrader.preprocessors import ClearHiddenTests, ClearMarkScheme, ClearSolutions
from traitlets.config import PyFileConfigLoader

pytestmark = pytest.mark.slow

EXERCISES = Path(__file__).parents[1] / "notebooks" / "exercises"
ASSIGNMENTS = sorted(folder.name for folder in (EXERCISES / "source").iterdir())

# For each assignment and task: the name of a mistake, the part of the solution to replace, and its replacement.
MISTAKES = {
    "01_features": {
        "patchify": {
            "patches column by column": ("transpose(0, 2, 1, 3, 4)", "transpose(2, 0, 1, 3, 4)"),
            "pixels never regrouped": (".transpose(0, 2, 1, 3, 4)", ""),
        },
        "attention_head": {
            "scale forgotten": (" / np.sqrt(query.shape[1])", ""),
            "softmax over the columns": ("axis=1", "axis=0"),
            "overflow": (" - logits.max(axis=1, keepdims=True)", ""),
        },
        "log_bin": {
            "rows and columns swapped": ("x[rows[:, None], columns]", "x[columns[:, None], rows]"),
            "round the border": (".clip(0, width - 1)", " % width"),
            "far ring not pooled": ("shifted(pooled", "shifted(keys"),
        },
    },
    "02_cyclical_maps": {
        "nearest": {
            "rows and columns swapped": (
                "sim.argmax(axis=1), sim.argmax(axis=0)",
                "sim.argmax(axis=0), sim.argmax(axis=1)",
            ),
        },
        "cycle": {
            "rows and columns swapped": ("rows, columns = grid", "columns, rows = grid"),
            "distance along the reading order": ("np.hypot(row_step, column_step)", "np.abs(here - there)"),
        },
        "cyclical_map": {
            "return not checked": (" & on1[back[forth]]", ""),
            "target's foreground not checked": (" & on2[forth]", ""),
            "sign": ("-distance", "distance"),
        },
        "mutual": {
            "one way only": ("np.flatnonzero(back[forth] == here)", "here"),
            "ends swapped": ("[closed, forth[closed]]", "[forth[closed], closed]"),
        },
    },
    "03_best_view": {
        "score": {
            "missing matches cost nothing": (" - (k - len(distances)) * np.sqrt(2)", ""),
            "distances rewarded": ("return -float", "return float"),
            "cosine above one": ("np.maximum(2 - 2 * np.asarray(cosines, dtype=float), 0)", "2 - 2 * cosines"),
        },
        "choose": {
            "lowest score": ("max(", "min("),
            "few matches are fine": (" if count >= minimum", ""),
        },
        "regret": {
            "angle, not regret": (" - angles.min(axis=1)", ""),
            "nearest of all pairs": ("angles.min(axis=1)", "angles.min()"),
        },
        "self_fit": {
            "turned about the origin": ("points - points.mean(axis=0)", "points"),
            "each point against itself": ("distances.min(axis=1)", "np.diag(distances)"),
            "turned the other way round": ("rotation.T", "rotation"),
        },
    },
    "04_umeyama_ransac": {
        "umeyama": {
            "forgotten reflection": ("np.sign(np.linalg.det(left @ right))", "1"),
            "reflection forgotten in the scale": ("(sign * singular).sum()", "singular.sum()"),
            "scale from the spreads": (
                "(sign * singular).sum() / np.square(centred_x).sum()",
                "np.sqrt(np.square(centred_y).sum() / np.square(centred_x).sum())",
            ),
            "rotation transposed": ("centred_y.T @ centred_x", "centred_x.T @ centred_y"),
        },
        "trials": {
            "one match, not a sample": ("inlier_share**size", "inlier_share"),
            "percent": ("inlier_share**size", "(inlier_share / 100) ** size"),
            "chance of failure for success": ("math.log(1 - confidence)", "math.log(confidence)"),
        },
        "consensus": {
            "last trial, not the best": ("if (residuals < threshold).sum() > best.sum():", "if True:"),
            "no fit to all inliers": (
                "return library_umeyama(x[best], y[best])",
                "return library_umeyama(x[sample], y[sample])",
            ),
            "source and target swapped": (
                "return library_umeyama(x[best], y[best])",
                "return library_umeyama(y[best], x[best])",
            ),
        },
    },
    "05_metrics": {
        "geodesic": {
            "radians": (
                "np.degrees(np.arctan2(sine, np.trace(relative) - 1))",
                "np.arctan2(sine, np.trace(relative) - 1)",
            ),
            "bare arccos": (
                "np.arctan2(sine, np.trace(relative) - 1)",
                "np.arccos(np.clip((np.trace(relative) - 1) / 2, -1, 1))",
            ),
            "no transpose": ("first.T @ second", "first @ second"),
        },
        "ground_truth": {
            "written from left to right": (
                "camera_b @ label_b @ np.linalg.inv(label_a) @ np.linalg.inv(camera_a)",
                "np.linalg.inv(camera_a) @ np.linalg.inv(label_a) @ label_b @ camera_b",
            ),
            "label not inverted": ("np.linalg.inv(label_a)", "label_a"),
        },
        "symmetric_error": {
            "turned in the wrong frame": ("truth @ turn(axis, 360 * k / n)", "turn(axis, 360 * k / n) @ truth"),
            "radians": ("360 * k / n", "2 * np.pi * k / n"),
        },
        "accuracy": {
            "share for percent": ("100 * np.mean", "np.mean"),
            "drawn without replacement": (
                "rng.choice(errors, size=(resamples, len(errors)))",
                "rng.permuted(np.tile(errors, (resamples, 1)), axis=1)",
            ),
            "30 degrees count as below 30": ("< threshold", "<= threshold"),
        },
    },
}


@pytest.fixture(scope="module")
def config():
    return PyFileConfigLoader("nbgrader_config.py", path=str(EXERCISES)).load_config()


def source(assignment):
    return nbformat.read(EXERCISES / "source" / assignment / f"{assignment}.ipynb", as_version=4)


def graded(notebook, **kind):
    """Cells by grade id whose nbgrader metadata have these values: solution=True, grade=False, ..."""
    cells = [cell for cell in notebook.cells if "nbgrader" in cell.metadata]
    return {
        cell.metadata.nbgrader.grade_id: cell
        for cell in cells
        if all(cell.metadata.nbgrader[key] == value for key, value in kind.items())
    }


def students_version(assignment, config):
    """The source without solutions, hidden tests and guides for marking, as `nbgrader generate_assignment` makes it."""
    notebook = source(assignment)
    for clear in (ClearSolutions, ClearHiddenTests, ClearMarkScheme):
        notebook, _ = clear(config=config).preprocess(notebook, {})
    return notebook


def with_mistake(solution, mistake):
    right, wrong = mistake
    assert right in solution, f"the solution does not contain {right!r}"
    return solution.replace(right, wrong)


@pytest.fixture(scope="module")
def prepared():
    """Function that returns a copy of the names an assignment's setup cell defines; the cell runs once."""
    namespaces = {}

    def prepare(assignment):
        if assignment not in namespaces:
            namespaces[assignment] = {}
            exec(graded(source(assignment), locked=True)["setup"].source, namespaces[assignment])
        return dict(namespaces[assignment])

    return prepare


def failing_tests(namespace, answers, tests):
    """Names of the test cells of notebook `tests` that fail for the functions defined in notebook `answers`."""
    for task, cell in graded(answers, solution=True, grade=False).items():
        if task != "experiment":
            exec(cell.source, namespace)
    failing = set()
    for name, cell in graded(tests, grade=True, solution=False).items():
        try:
            exec(cell.source, dict(namespace))
        except (AssertionError, ValueError, TypeError, IndexError, ArithmeticError, NotImplementedError):
            failing.add(name)
    return failing


@pytest.mark.slow
@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_every_cell_runs_and_every_test_passes_with_the_solutions(prepared, assignment):
    namespace = prepared(assignment)
    for cell in source(assignment).cells:
        if cell.cell_type == "code" and cell.metadata.get("nbgrader", {}).get("grade_id") != "setup":
            exec(cell.source, namespace)
    plt.close("all")


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_the_students_version_passes_no_test(prepared, config, assignment):
    notebook = source(assignment)
    tests = set(graded(notebook, grade=True, solution=False))
    assert len(tests) >= 3
    assert failing_tests(prepared(assignment), students_version(assignment, config), notebook) == tests


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_students_see_neither_solutions_nor_hidden_tests(config, assignment):
    notebook = students_version(assignment, config)
    text = "\n".join(cell.source for cell in notebook.cells)
    assert "SOLUTION" not in text and "HIDDEN" not in text and "Guide for marking" not in text
    for task, cell in graded(notebook, solution=True).items():
        stub = "*Write your answer" if cell.cell_type == "markdown" else "raise NotImplementedError"
        assert stub in cell.source or task == "experiment", task


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # some mistakes divide by zero or overflow
@pytest.mark.parametrize(
    ("assignment", "task", "mistake"),
    [(a, task, mistake) for a, tasks in MISTAKES.items() for task, mistakes in tasks.items() for mistake in mistakes],
)
def test_each_mistake_fails_its_own_task_and_no_other(prepared, assignment, task, mistake):
    notebook = source(assignment)
    cell = graded(notebook, solution=True)[task]
    cell.source = with_mistake(cell.source, MISTAKES[assignment][task][mistake])
    assert failing_tests(prepared(assignment), notebook, notebook) == {f"test_{task}"}


@pytest.mark.slow
def test_nbgrader_generates_and_grades_an_assignment(tmp_path, config, monkeypatch):
    """A hand-in with one solution, one mistake and the other tasks left open gets the points of the first task."""
    assignment = "05_metrics"
    shutil.copytree(EXERCISES / "source" / assignment, tmp_path / "source" / assignment)
    config.CourseDirectory.root = str(tmp_path)
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel draws as it does for students
    # nbgrader starts the program `alembic`, which is installed beside the interpreter.
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
    nbgrader = NbGraderAPI(config=config)
    result = nbgrader.generate_assignment(assignment)
    assert result["success"], result["log"]

    handed_in = nbformat.read(tmp_path / "release" / assignment / f"{assignment}.ipynb", as_version=4)
    solutions, answers = graded(source(assignment), solution=True), graded(handed_in, solution=True)
    first, second, *_ = MISTAKES[assignment]
    answers[first].source = solutions[first].source
    answers[second].source = with_mistake(solutions[second].source, next(iter(MISTAKES[assignment][second].values())))
    folder = tmp_path / "submitted" / "student" / assignment
    folder.mkdir(parents=True)
    nbformat.write(handed_in, folder / f"{assignment}.ipynb")
    result = nbgrader.autograde(assignment, "student")
    assert result["success"], result["log"]

    with Gradebook(nbgrader.coursedir.db_url, nbgrader.coursedir.course_id) as gradebook:
        grades = gradebook.find_submission(assignment, "student").notebooks[0].grades
        points = {grade.name: grade.auto_score for grade in grades if grade.cell.cell_type == "code"}
    expected = {f"test_{task}": 0 for task in MISTAKES[assignment]}
    expected[f"test_{first}"] = graded(source(assignment))[f"test_{first}"].metadata.nbgrader.points
    assert points == expected


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_every_task_has_a_mistake_and_the_points_equal_those_in_the_text(assignment):
    notebook = source(assignment)
    tests, answers = graded(notebook, grade=True, solution=False), graded(notebook, grade=True, solution=True)
    assert set(tests) == {f"test_{task}" for task in MISTAKES[assignment]} and len(tests) >= 3
    points = [cell.metadata.nbgrader.points for cell in (*tests.values(), *answers.values())]
    said = re.search(r"(\d+) points: ([\d + ]+) by tests, (\d+) by a reader", notebook.cells[0].source)
    assert [int(number) for number in (*said[2].split(" + "), said[3])] == points and int(said[1]) == sum(points)
    titles = [re.match(r"## Task .*\((\d+) points", cell.source) for cell in notebook.cells]
    assert [int(title[1]) for title in titles if title] == points
