"""The exercises, graded by nbgrader: solutions get every point, what is handed out none, and typical mistakes fail."""

import os
import re
import shutil
import sys
from pathlib import Path

import nbformat
import pytest
from nbgrader.api import Gradebook
from nbgrader.apps.api import NbGraderAPI
from traitlets.config import PyFileConfigLoader

EXERCISES = Path(__file__).parents[1] / "notebooks" / "exercises"
ASSIGNMENTS = sorted(folder.name for folder in (EXERCISES / "source").iterdir())

# Per assignment and task: what the mistake is, the part of the solution that it is made in, and what it becomes.
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


def source(assignment):
    return nbformat.read(EXERCISES / "source" / assignment / f"{assignment}.ipynb", as_version=4)


def graded(notebook, **kind):
    """Cells by grade id whose nbgrader metadata say so: solution=True, grade=False, ..."""
    cells = [cell for cell in notebook.cells if "nbgrader" in cell.metadata]
    return {
        cell.metadata.nbgrader.grade_id: cell
        for cell in cells
        if all(cell.metadata.nbgrader[key] == value for key, value in kind.items())
    }


def with_mistake(solution, mistake):
    right, wrong = mistake
    assert right in solution, f"the solution has no {right!r} to get wrong"
    return solution.replace(right, wrong)


@pytest.fixture(scope="module")
def course(tmp_path_factory):
    """nbgrader's API over a course folder of its own, in which every assignment is generated."""
    root = tmp_path_factory.mktemp("course")
    shutil.copytree(EXERCISES / "source", root / "source")
    config = PyFileConfigLoader("nbgrader_config.py", path=str(EXERCISES)).load_config()
    config.CourseDirectory.root = str(root)
    config.Exchange.root = str(root / "exchange")
    (root / "exchange").mkdir(mode=0o777)
    with pytest.MonkeyPatch.context() as environment:
        environment.delenv("MPLBACKEND", raising=False)  # kernels draw as they do for students
        # nbgrader calls `alembic` by name, which is beside the interpreter, whether that is on the path or not.
        environment.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
        api = NbGraderAPI(config=config)
        for assignment in ASSIGNMENTS:
            result = api.generate_assignment(assignment)
            assert result["success"], result["log"]
        yield api


def autograde(course, student, assignment, notebook):
    """Points by grade cell, (reached, of), of one student's hand-in; written answers wait for a person."""
    folder = Path(course.coursedir.root) / "submitted" / student / assignment
    folder.mkdir(parents=True)
    nbformat.write(notebook, folder / f"{assignment}.ipynb")
    result = course.autograde(assignment, student)
    assert result["success"], result["log"]
    run = nbformat.read(
        Path(course.coursedir.root) / "autograded" / student / assignment / f"{assignment}.ipynb", as_version=4
    )
    setup = graded(run, locked=True)["setup"]
    assert all(output.output_type != "error" for output in setup.outputs), setup.outputs
    with Gradebook(course.coursedir.db_url, course.coursedir.course_id) as gradebook:
        grades = gradebook.find_submission(assignment, student).notebooks[0].grades
        return {grade.name: (grade.auto_score, grade.max_score) for grade in grades if grade.cell.cell_type == "code"}


def released(course, assignment):
    return nbformat.read(Path(course.coursedir.root) / "release" / assignment / f"{assignment}.ipynb", as_version=4)


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_solutions_get_every_point(course, assignment):
    points = autograde(course, "solution", assignment, source(assignment))
    assert len(points) >= 3 and all(reached == most > 0 for reached, most in points.values()), points


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_what_is_handed_out_gets_no_point(course, assignment):
    points = autograde(course, "blank", assignment, released(course, assignment))
    assert len(points) >= 3 and all(reached == 0 for reached, _ in points.values()), points


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_a_typical_mistake_in_every_task_gets_no_point(course, assignment):
    solutions, notebook = graded(source(assignment), solution=True), released(course, assignment)
    for task, cell in graded(notebook, solution=True, grade=False).items():
        if task in MISTAKES[assignment]:
            cell.source = with_mistake(solutions[task].source, next(iter(MISTAKES[assignment][task].values())))
    points = autograde(course, "mistaken", assignment, notebook)
    assert all(reached == 0 for reached, _ in points.values()), points


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_students_see_neither_solutions_nor_hidden_tests(course, assignment):
    notebook = released(course, assignment)
    text = "\n".join(cell.source for cell in notebook.cells)
    assert "SOLUTION" not in text and "HIDDEN" not in text and "Guide for marking" not in text
    for task, cell in graded(notebook, solution=True).items():
        stub = "*Write your answer" if cell.cell_type == "markdown" else "raise NotImplementedError"
        assert stub in cell.source or task == "experiment", task


@pytest.fixture(scope="module")
def prepared():
    """The names that an assignment's setup cell defines; it is run once."""
    namespaces = {}

    def prepare(assignment):
        if assignment not in namespaces:
            namespaces[assignment] = {}
            exec(graded(source(assignment), locked=True)["setup"].source, namespaces[assignment])
        return dict(namespaces[assignment])

    return prepare


def failing_tests(namespace, notebook):
    """Names of the tests that fail, after all solutions of the notebook are defined."""
    for task, cell in graded(notebook, solution=True, grade=False).items():
        if task != "experiment":
            exec(cell.source, namespace)
    failing = set()
    for name, cell in graded(notebook, grade=True, solution=False).items():
        try:
            exec(cell.source, dict(namespace))
        except (AssertionError, ValueError, TypeError, IndexError, ArithmeticError):
            failing.add(name)
    return failing


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # some mistakes divide by zero or overflow on their way
@pytest.mark.parametrize(
    ("assignment", "task", "mistake"),
    [(a, task, mistake) for a, tasks in MISTAKES.items() for task, mistakes in tasks.items() for mistake in mistakes],
)
def test_each_mistake_fails_its_own_task_and_no_other(prepared, assignment, task, mistake):
    notebook = source(assignment)
    cell = graded(notebook, solution=True)[task]
    cell.source = with_mistake(cell.source, MISTAKES[assignment][task][mistake])
    assert failing_tests(prepared(assignment), notebook) == {f"test_{task}"}


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_every_task_has_a_mistake_and_the_points_are_as_the_text_says(assignment):
    notebook = source(assignment)
    tests, answers = graded(notebook, grade=True, solution=False), graded(notebook, grade=True, solution=True)
    assert set(tests) == {f"test_{task}" for task in MISTAKES[assignment]} and len(tests) >= 3
    points = [cell.metadata.nbgrader.points for cell in (*tests.values(), *answers.values())]
    said = re.search(r"(\d+) points: ([\d + ]+) by tests, (\d+) by a reader", notebook.cells[0].source)
    assert [int(number) for number in (*said[2].split(" + "), said[3])] == points and int(said[1]) == sum(points)
    titles = [re.match(r"## Task .*\((\d+) points", cell.source) for cell in notebook.cells]
    assert [int(title[1]) for title in titles if title] == points
