"""The exercises: given cells run, the solutions pass every test, the students' version none, typical mistakes fail."""

import ast
import builtins
import os
import re
import shutil
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import nbformat
import numpy as np
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
        },
        "attention_head": {
            "scale forgotten": (" / np.sqrt(query.shape[1])", ""),
            "softmax over the columns": ("axis=1", "axis=0"),
            "overflow": (" - logits.max(axis=1, keepdims=True)", ""),
        },
        "log_bin": {
            "rows and columns swapped": ("x[rows[:, None], columns]", "x[columns[:, None], rows]"),
            "far ring not pooled": ("shifted(pooled", "shifted(keys"),
        },
    },
    "02_cyclical_maps": {
        "nearest": {
            "rows and columns swapped": (
                "sim.argmax(axis=1), sim.argmax(axis=0)",
                "sim.argmax(axis=0), sim.argmax(axis=1)",
            )
        },
        "cycle": {
            "rows and columns swapped": ("rows, columns = grid", "columns, rows = grid"),
            "distance along the reading order": ("np.hypot(row_step, column_step)", "np.abs(here - there)"),
        },
        "cyclical_map": {
            "return not checked": (" & on1[back[forth]]", ""),
            "target's foreground not checked": (" & on2[forth]", ""),
        },
        "mutual": {
            "one way only": ("np.flatnonzero(back[forth] == here)", "here"),
            "ends swapped": ("[closed, forth[closed]]", "[forth[closed], closed]"),
        },
    },
    "03_best_view": {
        "score": {
            "missing matches cost nothing": (" - (k - len(distances)) * np.sqrt(2)", ""),
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
            "scale from the spreads": (
                "(sign * singular).sum() / np.square(centred_x).sum()",
                "np.sqrt(np.square(centred_y).sum() / np.square(centred_x).sum())",
            ),
            "rotation transposed": ("centred_y.T @ centred_x", "centred_x.T @ centred_y"),
        },
        "trials": {
            "one match, not a sample": ("inlier_share**size", "inlier_share"),
            "chance of failure for success": ("math.log(1 - confidence)", "math.log(confidence)"),
        },
        "consensus": {
            "last trial, not the best": ("if (residuals < threshold).sum() > best.sum():", "if True:"),
            "no fit to all inliers": ("library_umeyama(x[best], y[best])", "library_umeyama(x[sample], y[sample])"),
            "source and target swapped": ("library_umeyama(x[best], y[best])", "library_umeyama(y[best], x[best])"),
        },
    },
    "05_metrics": {
        "geodesic": {
            "radians": ("np.degrees(np.arctan2", "(np.arctan2"),
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
        },
        "accuracy": {
            "drawn without replacement": (
                "rng.choice(errors, size=(resamples, len(errors)))",
                "rng.permuted(np.tile(errors, (resamples, 1)), axis=1)",
            ),
            "30 degrees count as below 30": ("< threshold", "<= threshold"),
        },
    },
}


# For each assignment: a statement of a marking guide, and a check of it on what the given cells computed.
STATEMENTS = {
    "01_features": {
        "the similarity of true partners falls even if every key stays the same": lambda cells: (
            turned_similarity(cells["log_bin"], cells["keys"]) < 0.99 * turned_similarity(lambda x, _: x, cells["keys"])
        ),
        "9 parts take 9 times the storage of the bare key, 17 parts 17 times": lambda cells: (
            (cells["choices"]["numbers per image"] / cells["choices"]["numbers per image"][0]).tolist() == [1, 9, 17]
        ),
    },
    "02_cyclical_maps": {
        "The counts never fall from *within 0* to *within 2*": lambda cells: (
            np.diff(cells["counts"].iloc[:, 2:].to_numpy()) >= 0
        ).all(),
        "The column *within 0* counts the mutual nearest neighbours": lambda cells: (
            cells["counts"].set_index("category")["within 0"]["chair"]
            == sum(
                cells["fg1"].ravel()[u] and cells["fg2"].ravel()[v]
                for u, v in cells["mutual"](cells["chairs_forth"], cells["chairs_back"])
            )
        ),
        "a larger one never accepts fewer": lambda cells: all(
            group.is_monotonic_increasing for _, group in cells["limits"].groupby("category")["accepted"]
        ),
    },
    "03_best_view": {
        "The nearest view never gets farther away as N grows": lambda cells: all(
            group.is_monotonic_decreasing for _, group in cells["views"].groupby("category")["nearest (°)"]
        ),
    },
    "04_umeyama_ransac": {
        "the number of inliers never falls as the threshold grows": lambda cells: (
            cells["thresholds"]["inliers"].is_monotonic_increasing
        ),
        "at 3 scene units nearly all matches are inliers, also the shuffled ones": lambda cells: (
            cells["thresholds"].iloc[-1, 1:3].min() > 0.8 * len(cells["points"][0])
        ),
        "The shuffled matches have inliers, too, and their number never falls": lambda cells: (
            cells["thresholds"]["inliers if shuffled"].is_monotonic_increasing
            and cells["thresholds"].set_index("threshold")["inliers if shuffled"][0.2] > 0
        ),
        "574 trials with samples of 3, 2,876 with samples of 4 and 1,798,893 with samples of 8": lambda cells: (
            [cells["trials"](0.2, size) for size in (3, 4, 8)] == [574, 2876, 1798893]
        ),
    },
    "05_metrics": {
        "two intervals that overlap, and p = 0.002": lambda cells: (
            cells["bootstrap_ci"](cells["new"], lambda e, drawn: cells["library_accuracy"](e, 30, drawn))[0]
            < cells["bootstrap_ci"](cells["old"], lambda e, drawn: cells["library_accuracy"](e, 30, drawn))[1]
            and round(cells["paired_test"](cells["old"], cells["new"])["sign_test_p"], 3) == 0.002
        ),
        "13 that only the new method solves against 1": lambda cells: (
            np.sum((cells["new"] < 30) & (cells["old"] >= 30)) == 13
            and np.sum((cells["old"] < 30) & (cells["new"] >= 30)) == 1
        ),
        # A gain of 3 points at a discordance of 12 %: z = 2, and z = 1.96 + 0.84 for a power of 80 %.
        "exceeded from about 530 pairs on, and a power of 80 % takes about 1,050": lambda cells: (
            round(0.12 * (2 / 0.03) ** 2, -1) == 530 and round(0.12 * (2.8 / 0.03) ** 2, -1) == 1050
        ),
        "A has the smaller median and the larger Acc30, B the smaller mean and no error above 45°": lambda cells: (
            (cells["figures"]["A"] - cells["figures"]["B"] > 0).tolist() == [False, True, True]
            and cells["method_b"].max() <= 45
        ),
    },
}


def turned_similarity(described, keys):
    """Mean cosine of a grid's descriptors with those of the same grid, turned by 90 degrees and back again."""
    turned = np.rot90(keys)
    pair = described(keys, keys), np.rot90(described(turned, turned), -1)
    a, b = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in pair)
    return (a * b).sum(axis=-1).mean()


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
    for cell in graded(answers, solution=True, grade=False).values():
        exec(cell.source, namespace)
    failing = set()
    for name, cell in graded(tests, grade=True, solution=False).items():
        try:
            exec(cell.source, dict(namespace))
        except (AssertionError, ValueError, TypeError, IndexError, ArithmeticError, NotImplementedError):
            failing.add(name)
    return failing


def tasks(notebook):
    """The cells of each task, by the heading of its first cell."""
    found = {}
    for cell in notebook.cells:
        if cell.cell_type == "markdown" and cell.source.startswith("## Task"):
            found[cell.source.splitlines()[0]] = under = []
        if found:
            under.append(cell)
    return found


def unknown_names(text, namespace):
    """Names in the inline code of a text that are neither known nor defined there."""
    codes = [code for code in re.findall(r"(?<!`)`([^`\n]+)`(?!`)", text) if "-" not in code and "..." not in code]
    used = [node for code in codes for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Name)]
    defined = {name.id for name in used if isinstance(name.ctx, ast.Store)} | {*namespace, *dir(builtins)}
    return {name.id for name in used} - defined


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_the_given_cells_of_the_handed_out_notebook_run_and_agree_with_the_marking_guides(prepared, config, assignment):
    """No given cell needs more than the first cell of the notebook and the function of its own task."""
    handed_out, solutions = students_version(assignment, config), graded(source(assignment), solution=True)
    computed, given = {}, 0
    for title, cells in tasks(handed_out).items():
        namespace = prepared(assignment)
        for cell in graded(handed_out, solution=True, grade=False).values():
            exec(cell.source, namespace)
        for cell in cells:
            if cell.cell_type == "code" and "nbgrader" not in cell.metadata:
                exec(cell.source, namespace)
                given += 1
            elif "nbgrader" in cell.metadata and cell.cell_type == "code" and cell.metadata.nbgrader.solution:
                exec(solutions[cell.metadata.nbgrader.grade_id].source, namespace)
        if "read by a person" in title:
            assert not unknown_names(cells[0].source, namespace), title
        computed |= namespace
    plt.close("all")
    assert given == len(tasks(handed_out))
    exec("\n".join(cell.source for cell in graded(source(assignment), solution=True, grade=False).values()), computed)
    if assignment == "01_features":
        computed["keys"] = computed["views"][0].features.keys.numpy()
    guides = " ".join(cell.source for cell in graded(source(assignment), solution=True, grade=True).values())
    for statement, holds in STATEMENTS[assignment].items():
        assert statement in " ".join(guides.split()), statement
        assert holds(computed), statement


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_every_test_passes_with_the_solutions(prepared, assignment):
    assert failing_tests(prepared(assignment), source(assignment), source(assignment)) == set()


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_the_students_version_shows_no_solution_and_passes_no_test(prepared, config, assignment):
    notebook = source(assignment)
    tests = set(graded(notebook, grade=True, solution=False))
    assert len(tests) >= 3
    handed_out = students_version(assignment, config)
    text = "\n".join(cell.source for cell in handed_out.cells)
    assert "SOLUTION" not in text and "HIDDEN" not in text and "Guide for marking" not in text
    assert failing_tests(prepared(assignment), handed_out, notebook) == tests


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
def test_nbgrader_generates_grades_and_returns_an_assignment(tmp_path, config, monkeypatch):
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
    answers["better"].source = "See my remark: [Comment](#mine)"
    folder = tmp_path / "submitted" / "student" / assignment
    folder.mkdir(parents=True)
    nbformat.write(handed_in, folder / f"{assignment}.ipynb")
    result = nbgrader.autograde(assignment, "student")
    assert result["success"], result["log"]
    with_hidden_part = {name for name, cell in graded(source(assignment)).items() if "HIDDEN TESTS" in cell.source}
    assert set(re.findall("'checksum' for cell (\\w+) has changed", result["log"])) == with_hidden_part

    with Gradebook(nbgrader.coursedir.db_url, nbgrader.coursedir.course_id) as gradebook:
        grades = gradebook.find_submission(assignment, "student").notebooks[0].grades
        points = {grade.name: grade.auto_score for grade in grades if grade.cell.cell_type == "code"}
    expected = {f"test_{task}": 0 for task in MISTAKES[assignment]}
    expected[f"test_{first}"] = graded(source(assignment))[f"test_{first}"].metadata.nbgrader.points
    assert points == expected

    result = nbgrader.generate_feedback(assignment, "student")
    assert result["success"], result["log"]
    page = (tmp_path / "feedback" / "student" / assignment / f"{assignment}.html").read_text(encoding="utf-8")
    scores = re.findall(r'<li><a href="#\w+">(.*?)</a> \(Score: ([\d.]+) / ([\d.]+)\)</li>', page)
    titles = [title.removeprefix("## ").partition(" (")[0] for title in tasks(source(assignment))]
    assert [name for name, _, _ in scores] == titles and "Test cell" not in page
    assert re.findall(r'href="([^"]*)">Comment</a>', page) == ["#mine"]  # the student's own link, and no other
    assert scores[0] == (titles[0], "4.0", "4.0") and "HIDDEN TESTS" in page


@pytest.mark.parametrize(
    "name",
    [
        "archive/Ada Lovelace_123_assignsubmission_file_05_metrics.ipynb",
        "archive/Ada Lovelace_123_assignsubmission_file_/05_metrics.ipynb",
        "archive/lovelaceada_LATE_123_67890_05_metrics-2.ipynb",
    ],
)
def test_nbgrader_recognises_the_files_of_learning_platforms(config, name):
    found = re.match(config.FileNameCollectorPlugin.named_regexp, f"downloaded/05_metrics/extracted/{name}")
    assert found.groupdict() == {"student_id": "123", "file_id": "05_metrics"}


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_every_task_has_a_mistake_and_the_points_equal_those_in_the_text(assignment):
    notebook = source(assignment)
    tests, answers = graded(notebook, grade=True, solution=False), graded(notebook, grade=True, solution=True)
    assert set(tests) == {f"test_{task}" for task in MISTAKES[assignment]} and len(tests) >= 3
    points = [cell.metadata.nbgrader.points for cell in (*tests.values(), *answers.values())]
    said = re.search(r"(\d+) points: ([\d + ]+) by tests, ([\d + ]+) by a reader", notebook.cells[0].source)
    parts = [int(number) for group in (said[2], said[3]) for number in group.split(" + ")]
    assert parts == points and int(said[1]) == sum(points)
    titles = [re.match(r"## Task .*\((\d+) points", cell.source) for cell in notebook.cells]
    assert [int(title[1]) for title in titles if title] == points
