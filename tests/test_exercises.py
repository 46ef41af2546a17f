"""The exercises: given cells run, the solutions pass every test, the students' version none,
typical mistakes fail."""

import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from copy import deepcopy
from datetime import datetime
from pathlib import Path

import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest
from nbgrader.api import Gradebook
from nbgrader.apps import ZipCollectApp
from nbgrader.coursedir import CourseDirectory
from nbgrader.preprocessors import ClearHiddenTests, ClearMarkScheme, ClearSolutions
from nbgrader.tests import run_nbgrader
from traitlets.config import PyFileConfigLoader

pytestmark = pytest.mark.slow

EXERCISES = Path(__file__).parents[1] / "notebooks" / "exercises"
ASSIGNMENTS = sorted(folder.name for folder in (EXERCISES / "source").iterdir())

# For each assignment and task: the name of a mistake, the part of the solution to replace, and its
# replacement.
MISTAKES = json.loads(
    Path(__file__).with_name("exercise_mistakes.json").read_text(encoding="utf-8")
)

# For each assignment: a statement of a marking guide, and an expression that holds for what the
# given cells computed.
STATEMENTS = {
    "01_features": {
        (
            "the similarity of true partners falls even if every key stays the same"
        ): "turned_similarity(lambda x: log_bin(x[None])[0].numpy(), views[0])"
        " < 0.99 * turned_similarity(np.asarray, views[0])",
    },
    "02_cyclical_maps": {
        (
            "39 % against 37 % on the bicycles, 32 % against 32 % on the cars"
        ): "counts.iloc[[1, 0], [1, 3]].to_numpy().tolist() == [[39, 32], [37, 32]]",
        (
            "up to 2 patches are the best broad rule, 48 % and 38 %, and leave more than 100"
        ): "counts.loc['up to 2 patches'].tolist() == [105, 48, 279, 38]",
        (
            "48 % against 35 % without a limit, and 152 of 278 matches are left"
        ): "limits.iloc[[2, 5], [2, 5]].to_numpy().tolist() == [[152, '48%'], [278, '35%']]",
        (
            "12 % against 6 %: 2 right ones of 16 and 4 of 33"
        ): "limits.iloc[[6, 7, 11], 3:].to_numpy().tolist() == [[16, 2, '12%'], [33, 4, '12%'], "
        "[118, 7, '6%']]",
    },
    "03_best_view": {
        (
            "turned by 171°, one of 23° was offered, and it wins clearly, -29.9 against -33.5"
        ): "wrong == (171, 23)",
        (
            "the chosen one does so on three of the four pairs"
        ): "sum((np.diff(one) > 0).any() for _, one in views.groupby('category')['chosen (°)']) "
        "== 3"
        " and all(one.is_monotonic_decreasing for _, one in "
        "views.groupby('category')['nearest (°)'])",
    },
    "04_umeyama_ransac": {
        (
            "The number of inliers never falls as the threshold grows"
        ): "all(table['inliers'].is_monotonic_increasing for table in tables.values())",
        (
            "the error is smallest, 5°, at 0.2 and 0.5"
        ): "tables['chair']['error (°)'].tolist() == [30, 15, 9, 5, 5, 9, 28]",
        (
            "the motorcycles have 19 inliers and the chairs 18, but the error is 135° against 5°"
        ): "[table.loc[0.5].tolist() for table in tables.values()] == [[18, 4, 5], [19, 9, 135]]",
        (
            "750 trials with samples of 3, 5,049 with samples of 4 and 348,471 with samples of 6"
        ): "[trials(10, 50, size) for size in (3, 4, 6)] == [750, 5049, 348471]",
        (
            "8 % of the poses are more than 30° off with samples of 3, 22 % with samples of 4 "
            "and 43 %"
        ): "np.allclose(settings['above 30° (%)'], [8, 22, 43, 0, 0, 0], atol=1)",
    },
    "05_metrics": {
        (
            "two intervals that overlap, and p = 0.002"
        ): "intervals['new'][0] < intervals['old'][1] and round(paired_test(old, "
        "new)['sign_test_p'], 3) == 0.002",
        (
            "13 that only the new method solves against 1"
        ): "[np.sum((a < 30) & (b >= 30)) for a, b in ((new, old), (old, new))] == [13, 1]",
        # A gain of 3 points at a discordance of 12 %: z = 2, and z = 1.96 + 0.84 for a power of 80
        # %.
        (
            "exceeded from about 530 pairs on, and a power of 80 % takes about 1,050"
        ): "round(0.12 * (2 / 0.03) ** 2, -1) == 530 and round(0.12 * (2.8 / 0.03) ** 2, -1) == "
        "1050",
        (
            "A has the smaller median and the larger Acc30, B the smaller mean and no error "
            "above 45°"
        ): "(figures['A'] - figures['B'] > 0).tolist() == [False, True, True] and "
        "method_b.max() <= 45",
    },
}


def turned_similarity(described, view):
    """Mean cosine of a grid's descriptors with those of the same grid, turned by 90 degrees and
    back again."""
    keys = view.features.keys.numpy()
    pair = described(keys), np.rot90(described(np.rot90(keys).copy()), -1)
    a, b = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in pair)
    return (a * b).sum(axis=-1).mean()


@pytest.fixture(scope="module")
def config():
    return PyFileConfigLoader("nbgrader_config.py", path=str(EXERCISES)).load_config()


def source(assignment):
    return nbformat.read(EXERCISES / "source" / assignment / f"{assignment}.ipynb", as_version=4)


def graded(notebook, **kind):
    """Cells by grade id whose nbgrader metadata have these values: solution=True,
    grade=False, ..."""
    return {
        cell.metadata.nbgrader.grade_id: cell
        for cell in notebook.cells
        if "nbgrader" in cell.metadata and kind.items() <= cell.metadata.nbgrader.items()
    }


def students_version(assignment, config):
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


def failing_tests(namespace, answers, tests):
    """Names of the test cells of notebook `tests` that fail for the functions defined in notebook
    `answers`."""
    for cell in graded(answers, solution=True, grade=False).values():
        exec(cell.source, namespace)
    failing = set()
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
        ):
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


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_the_given_cells_of_the_handed_out_notebook_run_and_agree_with_the_marking_guides(
    prepared, config, assignment
):
    """No given cell needs more than the first cell of the notebook and the function of its own
    task."""
    handed_out, solutions = (
        students_version(assignment, config),
        graded(source(assignment), solution=True),
    )
    computed, given = {}, 0
    for cells in tasks(handed_out).values():
        namespace = prepared(assignment)
        for cell in graded(handed_out, solution=True, grade=False).values():
            exec(cell.source, namespace)
        for cell in cells:
            if cell.cell_type == "code" and "nbgrader" not in cell.metadata:
                exec(cell.source, namespace)
                given += 1
            elif (
                "nbgrader" in cell.metadata
                and cell.cell_type == "code"
                and cell.metadata.nbgrader.solution
            ):
                exec(solutions[cell.metadata.nbgrader.grade_id].source, namespace)
        computed |= namespace
    plt.close("all")
    assert given == len(tasks(handed_out))
    exec(
        "\n".join(
            cell.source for cell in graded(source(assignment), solution=True, grade=False).values()
        ),
        computed,
    )
    guides = " ".join(
        cell.source for cell in graded(source(assignment), solution=True, grade=True).values()
    )
    for statement, holds in STATEMENTS[assignment].items():
        assert statement in " ".join(guides.split()), statement
        assert eval(holds, computed | {"turned_similarity": turned_similarity}), statement


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_the_solutions_pass_every_test_and_the_students_version_none(prepared, config, assignment):
    notebook, handed_out = source(assignment), students_version(assignment, config)
    text = "\n".join(cell.source for cell in handed_out.cells)
    assert "SOLUTION" not in text and "HIDDEN" not in text and "Guide for marking" not in text
    assert failing_tests(prepared(assignment), notebook, notebook) == set()
    assert failing_tests(prepared(assignment), handed_out, notebook) == set(
        graded(notebook, grade=True, locked=True)
    )


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # some mistakes divide by zero or overflow
@pytest.mark.parametrize(
    ("assignment", "task", "mistake"),
    [
        (a, task, mistake)
        for a, tasks in MISTAKES.items()
        for task, mistakes in tasks.items()
        for mistake in mistakes
    ],
)
def test_each_mistake_fails_its_own_task_and_no_other(prepared, assignment, task, mistake):
    notebook = source(assignment)
    cell, (right, wrong) = (
        graded(notebook, solution=True)[task],
        MISTAKES[assignment][task][mistake],
    )
    assert right in cell.source, f"the solution does not contain {right!r}"
    cell.source = cell.source.replace(right, wrong)
    failing = failing_tests(prepared(assignment), notebook, notebook)
    assert failing and {name.removeprefix("test_")[:-2] for name in failing} == {task}


CALLS_THE_LIBRARY = """
own = {0}
def {0}(*arguments):
    from zsp_lite.metrics import rotation_angle as alias
    alias(np.eye(3), np.eye(3))
    return own(*arguments)"""


@pytest.mark.parametrize("assignment", ASSIGNMENTS)
def test_a_function_that_calls_the_library_fails_all_tests_of_its_task(prepared, assignment):
    for task in MISTAKES[assignment]:
        notebook = source(assignment)
        graded(notebook, solution=True)[task].source += CALLS_THE_LIBRARY.format(task)
        assert failing_tests(prepared(assignment), notebook, notebook) == {
            f"test_{task}_1",
            f"test_{task}_2",
        }


def turn_into_text(cell):
    cell.cell_type = "markdown"
    del cell["outputs"], cell["execution_count"]


# What is listed, and a damage to a solution that is its cause.
DAMAGES = {
    "cells that are there twice": lambda cell, cells: cells.append(deepcopy(cell)),
    "solutions that are not code": lambda cell, _: turn_into_text(cell),
    "cells deleted or without metadata": lambda cell, _: cell.metadata.pop("nbgrader"),
    "cells of another release": lambda cell, _: cell.metadata.nbgrader.update(
        checksum="", schema_version=2
    ),
}


@pytest.mark.filterwarnings("ignore::sqlalchemy.exc.SAWarning")
def test_the_commands_of_a_lecturer_lose_no_hand_in_and_git_sees_none(tmp_path, monkeypatch):
    """Ada has one task right and calls the library in another; Bob's file is damaged, Eve's a PDF,
    Dan has two."""
    name, folder = "05_metrics", tmp_path / "notebooks" / "exercises"
    shutil.copytree(EXERCISES / "source" / name, folder / "source" / name)
    shutil.copy(EXERCISES / "nbgrader_config.py", folder)
    shutil.copy(EXERCISES.parents[1] / ".gitignore", tmp_path)
    monkeypatch.delenv("MPLBACKEND", raising=False)  # the kernel draws as it does for students
    # nbgrader starts the program `alembic`, which is installed beside the interpreter.
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
    monkeypatch.setenv("PYTHONPATH", str(EXERCISES.parents[1]))
    monkeypatch.setattr(os, "environ", os.environ)  # run_nbgrader replaces it
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.chdir(folder)

    def git(*words):
        return subprocess.run(["git", *words, tmp_path], capture_output=True, text=True).stdout

    git("init"), git("add")
    run_nbgrader(["generate_assignment", name])
    handed_in = nbformat.read(folder / "release" / name / f"{name}.ipynb", as_version=4)
    solutions, answers = graded(source(name), solution=True), graded(handed_in, solution=True)
    first, second, _ = MISTAKES[name]
    answers[first].source = solutions[first].source
    answers[second].source = solutions[second].source + CALLS_THE_LIBRARY.format(second)
    answers["better"].source = "See my remark: [Comment](#mine), $\\lambda R$ and $\\broken{$"
    downloads = folder / "downloaded" / name
    (downloads / "archive").mkdir(parents=True)
    with zipfile.ZipFile(downloads / "archive" / "all.zip", "w") as archive:
        for number, damage in enumerate(DAMAGES.values(), 110):
            notebook = deepcopy(handed_in)
            damage(graded(notebook)[first], notebook.cells)
            archive.writestr(
                f"A_{number}_assignsubmission_file_{name}.ipynb", nbformat.writes(notebook)
            )
        # nbgrader puts them back
        text, test, stripped, *_ = graded(handed_in, grade=True, locked=True).values()
        (
            turn_into_text(text),
            handed_in.cells.insert(1, deepcopy(test)),
            stripped.metadata.pop("nbgrader"),
        )
        archive.writestr(
            f"Ada Lovelace_123_assignsubmission_file_{name} (1).ipynb", nbformat.writes(handed_in)
        )
        archive.writestr(f"Bob_124_assignsubmission_file_{name}.ipynb", "{")
        archive.writestr("Eve_125_assignsubmission_file_homework.pdf", "")
        for end in ("", " (1)"):
            archive.writestr(
                f"Dan_126_assignsubmission_file_{name}{end}.ipynb", nbformat.writes(handed_in)
            )
    lines = "".join(f"\nParticipant {number}," for number in range(123, 127))
    (downloads / "worksheet.csv").write_text(f"\ufeffIdentifier,Grade{lines}")

    for _ in range(2):  # a second time, after another download
        run_nbgrader(["zip_collect", name])
    log = run_nbgrader(["autograde", name], retcode=1)  # as one is damaged
    assert "123: answers to be graded by hand" in run_nbgrader(["export"])
    with Gradebook(f"sqlite:///{folder / 'gradebook.db'}", "zsp-lite") as gradebook:
        grades = gradebook.find_submission(name, "123").notebooks[0].grades
        points = {
            grade.name: grade.auto_score for grade in grades if grade.cell.cell_type == "code"
        }
        for grade in grades:
            if grade.needs_manual_grade:
                grade.manual_score, grade.needs_manual_grade = 1.5, False
        gradebook.db.commit()
    assert points == {
        f"test_{task}_{i}": 2 * (task == first) for task in MISTAKES[name] for i in (1, 2)
    }
    assert set(re.findall("(?:'checksum' for|Missing grade) cell (\\w+)", log)) == set(points)
    run_nbgrader(["export"])
    states = [
        line.removeprefix(name + ",")
        for line in (folder / "grades.csv").read_text().splitlines()[1:]
    ]
    not_graded = "{0},,20,not graded: submitted/{0}/05_metrics/05_metrics.ipynb: {1}".format
    assert states[:4] == [
        not_graded(i, f"{cause}: {first}") for i, cause in enumerate(DAMAGES, 110)
    ]
    assert states[4:6] == ["123,5.5,20,graded", not_graded(124, "damaged file")]
    assert states[6] == "125,,20,not collected: all/Eve_125_assignsubmission_file_homework.pdf"
    assert states[7].startswith('126,,20,"not collected: 2 files, all/Dan_126') and len(states) == 8
    assert all(state.removeprefix(f"{i},,20,") in log for i, state in enumerate(states[:4], 110))
    filled = (downloads / "worksheet_filled.csv").read_text().splitlines()
    assert filled[1:] == [
        "Participant 123,5.5",
        "Participant 124,",
        "Participant 125,",
        "Participant 126,",
    ]

    run_nbgrader(["generate_feedback", name, "--force"])
    page = (folder / "feedback" / "123" / name / f"{name}.html").read_text(encoding="utf-8")
    scores = re.findall(r'<li><a href="#\w+">(.*?)</a> \(Score: ([\d.]+) / ([\d.]+)\)</li>', page)
    assert (
        scores[0] == ("Task 1 · Symmetric objects: An n-fold symmetry", "2.0", "2.0")
        and "HIDDEN TESTS" in page
    )
    assert len(scores) == 8 and "Test cell" not in page
    # the student's own link, and no other
    assert re.findall(r'href="([^"]*)">Comment</a>', page) == ["#mine"]
    assert "<math" in page and "<code>\\broken{</code>" in page
    assert "<script" not in page and not re.search(
        r"""(src|href)=["'](?!#|data:)|url\(["']?http""", page
    )
    assert git("ls-files", "--others", "--exclude-standard") == ""


def test_a_second_collection_renews_only_files_that_changed(config, tmp_path, monkeypatch):
    """`nbgrader autograde` grades again what has a newer time, and then asks for new points by
    hand."""
    plugin = config.ZipCollectApp.collector_plugin
    monkeypatch.setitem(plugin.collect.__globals__, "HERE", tmp_path)
    course = CourseDirectory(root=str(tmp_path), assignment_id="05_metrics")
    kept, extracted = datetime(2026, 1, 2), tmp_path / "downloaded" / "05_metrics" / "extracted"
    extracted.mkdir(parents=True)
    for student, text in (("123", "answers"), ("124", "other answers"), ("125", "answers")):
        submitted = tmp_path / "submitted" / student / "05_metrics"
        submitted.mkdir(parents=True)
        (submitted / "05_metrics.ipynb").write_text("answers")
        if student != "125":  # copied by hand
            (submitted / "timestamp.txt").write_text(f"{kept}")
        (extracted / f"A_{student}_12_05_metrics.ipynb").write_text(text)
    collector = plugin(parent=ZipCollectApp(config=config, coursedir=course))
    times = [collector.collect(str(file))["timestamp"] for file in sorted(extracted.iterdir())]
    assert [time == kept for time in times] == [True, False, False] and min(times) == kept


def test_nbgrader_recognises_the_files_of_learning_platforms(config):
    for name in (
        "Ada Lovelace_123_assignsubmission_file_05_metrics.ipynb",
        "Ada Lovelace_123_assignsubmission_file_/05_metrics.ipynb",
        "Ada Lovelace_123_assignsubmission_file_05_metrics (1).ipynb",
        "lovelaceada_LATE_123_67890_05_metrics-2.ipynb",
        "lovelaceada_123_67890_05_metrics-Copy1.ipynb",
    ):
        found = re.match(
            config.FileNameCollectorPlugin.named_regexp,
            f"downloaded/05_metrics/extracted/all/{name}",
        )
        assert found.groupdict() == {"student_id": "123", "file_id": "05_metrics"}


def test_the_five_exercises_have_100_points_and_no_test_decides_more_than_two():
    readme = (EXERCISES / "README.md").read_text(encoding="utf-8")
    for assignment in ASSIGNMENTS:
        notebook = source(assignment)
        points = {
            name: cell.metadata.nbgrader.points
            for name, cell in graded(notebook, grade=True).items()
        }
        tests = [name for name in points if name.startswith("test_")]
        assert tests == [f"test_{task}_{i}" for task in MISTAKES[assignment] for i in (1, 2)]
        assert [*points.values()] == [2] * 6 + [
            4
        ] * 2 and "20 points: 12 by tests, 8 by" in notebook.cells[0].source
        titles = [re.match(r"## Task \d · (.*) \(4 points", cell.source) for cell in notebook.cells]
        assert (
            all(title[1].lower() in readme.lower() for title in titles if title)
            and sum(map(bool, titles)) == 5
        )
