"""Configuration of this course; nbgrader reads it when started in this folder."""

import csv
import filecmp
import re
import shutil
import zipfile
from datetime import UTC, datetime
from functools import cache
from html import escape
from pathlib import Path
from time import monotonic

import nbformat
from jinja2 import pass_context
from latex2mathml.converter import convert
from nbconvert.exporters import HTMLExporter
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath
from nbformat import NotebookNode
from nbformat.v4 import new_output
from nbgrader.api import Gradebook, MissingEntry
from nbgrader.converters import Autograde
from nbgrader.converters.base import NbGraderException
from nbgrader.plugins import ExportPlugin, FileNameCollectorPlugin
from nbgrader.preprocessors import Execute, NbGraderPreprocessor

c = get_config()  # noqa: F821, nbgrader defines it
HERE = Path(__file__).parent

c.CourseDirectory.course_id = "zsp-lite"

# What students find in place of a solution.
c.ClearSolutions.code_stub = {
    "python": "# Your code here, in place of the next line.\n"
    'raise NotImplementedError("not written yet: replace this line by your code")'
}
c.ClearSolutions.text_stub = "*Write your answer here, in place of this line.*"

# Names of handed-in files, for `nbgrader zip_collect`. Moodle:
# NAME_STUDENT_assignsubmission_file_EXERCISE.ipynb, or with "/" before EXERCISE.
# Canvas: NAME_STUDENT_NUMBER_EXERCISE.ipynb, with LATE_ before STUDENT after the
# deadline. Browsers and people add " (1)", "-Copy1".
# From the path: the number of the student and the name of the exercise.
EXERCISES = "|".join(sorted(folder.name for folder in (HERE / "source").glob("*")))
STUDENT = r".*/[^/]+?_(?:LATE_)?(?P<student_id>\d+)_(?:assignsubmission_file_?/?|\d+_)"
HANDED_IN = rf"{STUDENT}(?P<file_id>{EXERCISES})[^/]*\.ipynb$"
c.FileNameCollectorPlugin.named_regexp = HANDED_IN
# A second collection replaces the files of the first.
c.ZipCollectApp.force = c.ExtractorPlugin.force = True


@cache
def downloaded(assignment: str) -> dict:
    """List the files of a download by (student, exercise).

    A student or an exercise that the name of a file does not give is "".
    """
    files = {}
    folder = HERE / "downloaded" / assignment / "extracted"
    for file in sorted(folder.rglob("*")):
        if file.is_file():
            path = file.as_posix()
            named = re.match(HANDED_IN, path) or re.match(STUDENT, path)
            names = named.groupdict() if named else {}
            key = names.get("student_id", ""), names.get("file_id", "")
            files.setdefault(key, []).append(file.relative_to(folder).as_posix())
    return files


class Collector(FileNameCollectorPlugin):
    """Collector of the files whose names match HANDED_IN.

    It collects no file of a student who has two of them.

    `nbgrader autograde` grades what is newer than what it has graded. So a file keeps
    the time of its first collection, until the student hands in another one.
    """

    def collect(self, submitted_file: str) -> dict | None:
        """Return what nbgrader needs to know of a file; None leaves it out."""
        info = super().collect(submitted_file)
        if info:
            student, name = info["student_id"], info["file_id"]
            assignment = self.parent.coursedir.assignment_id
            if len(downloaded(assignment)[student, name]) > 1:
                self.log.warning("%s has several files %s: skipped", student, name)
                return None
            folder = HERE / "submitted" / student / assignment
            time = self.parent.coursedir.get_existing_timestamp(str(folder))
            if not time or not same(folder / f"{name}.ipynb", submitted_file):
                # nbgrader's times are UTC, without a time zone.
                time = datetime.now(UTC).replace(tzinfo=None)
            info["timestamp"] = time
        return info


c.ZipCollectApp.collector_plugin = Collector

# A copy of the hand-in, beside what `nbgrader autograde` made of it.
COPY = "handed_in.copy"
c.CourseDirectory.ignore = [".ipynb_checkpoints", "*.pyc", "__pycache__", COPY]


def same(copy: Path, file: Path | str) -> bool:
    """Whether a copy of a file exists and has the same contents."""
    return copy.is_file() and filecmp.cmp(copy, file, shallow=False)


def keep_hand_ins(notebooks: list, **_) -> None:
    """Copy each hand-in that was graded, to compare a later one with it."""
    for path in map(Path, notebooks):
        *_, student, name = path.parent.parts
        shutil.copy(path, HERE / "autograded" / student / name / COPY)


c.Autograde.post_convert_hook = keep_hand_ins


def marked(notebook: NotebookNode) -> dict:
    """List the cells with metadata of nbgrader by their grade id (None without one)."""
    marked_cells = {}
    for cell in notebook.cells:
        if "nbgrader" in cell.metadata:
            grade_id = (cell.metadata.nbgrader or {}).get("grade_id")
            marked_cells.setdefault(grade_id, []).append(cell)
    return marked_cells


def fault(handed_in: NotebookNode, exercise: str) -> str:
    """Say why a notebook cannot be graded; "" if it can be.

    nbgrader puts back a test and the text of the first cell. It cannot know which of
    two solutions or answers counts, nor find one without its metadata. A solution that
    became text may be a note: nbgrader would run it, perhaps after the right code.
    """
    path = HERE / "release" / exercise / f"{exercise}.ipynb"
    if not path.is_file():
        return f"no file release/{exercise}/{path.name}"
    released = marked(nbformat.read(path, as_version=4))
    returned = marked(handed_in)
    returned.pop(None, None)  # cells without an id, which nbgrader does not grade
    faults = {}
    for name in released | returned:
        cells = returned.get(name, [])
        # A release has one cell of each name; a name that it does not have is a fault.
        (original,) = released.get(name, [None])
        data = original and original.metadata.nbgrader
        if any(cell.metadata.nbgrader != data for cell in cells):
            cause = "cells of another release"
        elif not cells and (data.solution or not data.grade):
            cause = "cells deleted or without metadata"
        elif data.solution and len(cells) > 1:
            cause = "cells that are there twice"
        elif (
            data.solution
            and original.cell_type == "code"
            and cells[0].cell_type != "code"
        ):
            cause = "solutions that are not code"
        else:
            continue
        faults.setdefault(cause, []).append(name)
    return "; ".join(f"{cause}: {', '.join(faults[cause])}" for cause in faults)


class CheckHandIn(NbGraderPreprocessor):
    """Refuse what cannot be graded, and remove metadata that nbgrader stumbles over."""

    def preprocess(self, nb: NotebookNode, resources: dict) -> tuple:
        names = resources["nbgrader"]
        cause = fault(nb, names["assignment"])
        if cause:
            raise NbGraderException(
                f"not graded: submitted/{names['student']}/{names['assignment']}/"
                f"{names['notebook']}.ipynb: {cause}"
            )
        for grade_id, cells in marked(nb).items():
            if grade_id:
                cells.pop()  # The last copy of a test counts and keeps its metadata.
            for cell in cells:
                del cell.metadata["nbgrader"]
        return nb, resources


c.Autograde.sanitize_preprocessors.insert(0, CheckHandIn)
c.OverwriteCells.add_missing_cells = True

# JupyterLab, started with this file: no offer to build it, no question about news.
c.ServerApp.tornado_settings = {"page_config_data": {"buildCheck": False}}
c.LabApp.news_url = None


# Seconds that a hand-in may lose to cells that do not end.
LOST = 30
# Seconds for a cell of a task with tests: about 8 times what slow but right code takes.
LIMIT = 10


class ExecuteHandIn(Execute):
    """Stop a cell that does not end, and run no further cell of its function."""

    def preprocess(self, nb: NotebookNode, *args: object) -> tuple:
        self.left = LOST
        self.limit = LIMIT
        self.stopped = False
        return super().preprocess(nb, *args)

    def preprocess_cell(self, cell: NotebookNode, resources: dict, index: int) -> tuple:
        data = cell.metadata.get("nbgrader", {})
        heading = cell.cell_type == "markdown" and cell.source.startswith("## ")
        if heading:
            self.limit = LOST if "read by a person" in cell.source else LIMIT
        if heading or data.get("solution"):
            self.stopped = False
        if cell.cell_type == "code" and (self.stopped or self.left == 0):
            error = new_output("error", ename="CellTimeoutError", evalue="")
            error.traceback = ["not run: a cell before this one did not end"]
            cell.outputs = [error]
            return cell, resources
        # The cell of the set-up imports torch.
        setup = data.get("grade_id") == "setup"
        self.timeout = 120 if setup else min(self.limit, self.left)
        start = monotonic()
        cell, resources = super().preprocess_cell(cell, resources, index)
        errors = [output.get("ename") for output in cell.get("outputs", [])]
        if "CellTimeoutError" in errors:
            self.stopped = True
            self.left = max(0, self.left - round(monotonic() - start))
        return cell, resources


# nbgrader's own steps, but for the execution.
steps = Autograde().autograde_preprocessors
steps[steps.index(Execute)] = ExecuteHandIn
c.Autograde.autograde_preprocessors = steps
# A cell that catches its interruption costs its own points, not those of the hand-in.
c.Execute.raise_on_iopub_timeout = False


class Renderer(IPythonRenderer):
    """Renderer of formulas as MathML, which needs no script from the network."""

    def inline_math(self, body: str, display: str = "inline") -> str:
        try:
            return convert(body, display=display)
        except Exception:  # The formula of a student may be anything.
            return f"<code>{escape(body)}</code>"

    def block_math(self, body: str) -> str:
        return f"<p>{self.inline_math(body, 'block')}</p>"


class FeedbackPage(HTMLExporter):
    """nbgrader's page, without a network, with the names of the tasks in its list."""

    @pass_context
    def markdown2html(self, context: object, source: str) -> str:
        pictures = context.get("cell", {}).get("attachments", {})
        renderer = Renderer(escape=False, attachments=pictures)
        return MarkdownWithMath(renderer=renderer).render(source)

    def from_notebook_node(
        self, nb: NotebookNode, resources: dict | None = None, **options: object
    ) -> tuple:
        page, resources = super().from_notebook_node(nb, resources, **options)
        page = re.sub(r"(?s)<script.*?</script>", "", page)

        # A graded cell is named by its task, a test also by the comment in line 1.
        names = {}  # by grade id
        task = ""
        for cell in nb.cells:
            heading = re.match(r"## (Task .*?) \(\d+ points", cell.source)
            if heading:
                task = heading[1]
            part = re.match(r"# (.*)\.\n", cell.source)
            name = f"{task}: {part[1]}" if task and part else task
            names[cell.metadata.get("nbgrader", {}).get("grade_id")] = name

        def with_name(link: re.Match) -> str:
            name = escape(names.get(link["cell"], ""))
            if not name:  # The link is a student's own.
                return link[0]
            suffix = ": comment" if link["comment"] else ""
            return f"{link['start']}{name}{suffix}"

        # A link to a cell, or to the comment on it, with the text that nbgrader gives.
        link = (
            r'(?P<start><a href="#(?P<comment>comment-)?(?P<cell>\w+)">)'
            "(?:Test cell|Written response|Comment)(?=</a>)"
        )
        return re.sub(link, with_name, page), resources


c.GenerateFeedback.exporter_class = FeedbackPage

# The name of the column for the grade in Moodle's grading worksheet.
GRADE = "Grade"


class Marks(ExportPlugin):
    """`nbgrader export`: grades.csv, Moodle's worksheets, and what has no grade yet.

    `marks` has the score and the state of each hand-in, as text, by student. A hand-in
    that was not graded has an empty score, never 0, and is listed.
    """

    def export(self, gradebook: Gradebook) -> None:
        rows = [["assignment", "student_id", "score", "max_score", "state"]]
        for assignment in gradebook.assignments:
            name = assignment.name
            if self.assignment and name not in self.assignment:
                continue
            marks = self.not_collected(name)
            for folder in HERE.glob(f"submitted/*/{name}"):
                student = folder.parent.name
                if student not in marks:
                    marks[student] = self.score(gradebook, name, student)
            marks = dict(sorted(marks.items()))
            rows += [
                [name, student, score, f"{assignment.max_score:g}", state]
                for student, (score, state) in marks.items()
            ]
            self.list_open(name, marks)
            if (HERE / "downloaded" / name).is_dir():
                self.fill_worksheet(name, marks)
                self.pack_feedback(name, marks)
        with open(self.to or HERE / "grades.csv", "w", newline="") as file:
            csv.writer(file).writerows(rows)

    def not_collected(self, name: str) -> dict:
        """Return no score, and the reason, for students without exactly one valid file.

        What was copied by hand counts: only `zip_collect` writes timestamp.txt.
        """
        files = downloaded(name)
        marks = {}
        for student in {student for student, _ in files}:
            folder = HERE / "submitted" / student / name
            valid = files.get((student, name), [])
            collected = len(valid) == 1 or not (folder / "timestamp.txt").is_file()
            if collected and (folder / f"{name}.ipynb").is_file():
                continue
            count = f"{len(valid)} files, " if len(valid) > 1 else ""
            # Without a valid file, all files of the student are listed.
            keys = [key for key in files if key[0] == student]
            names = ", ".join(valid or [file for key in keys for file in files[key]])
            marks[student] = "", f"not collected: {count}{names}"
        return marks

    def score(self, gradebook: Gradebook, exercise: str, student: str) -> tuple:
        """Return the score as text, "" if there is none, and the state of a hand-in."""
        name = f"{exercise}.ipynb"
        handed_in = HERE / "submitted" / student / exercise / name
        graded = HERE / "autograded" / student / exercise
        if not handed_in.is_file():
            return "", f"not graded: no file {name}"
        if not same(graded / COPY, handed_in):
            try:
                cause = fault(nbformat.read(handed_in, 4), exercise)
            except Exception:  # A damaged file may raise anything.
                cause = "damaged file"
            if cause:
                return "", f"not graded: submitted/{student}/{exercise}/{name}: {cause}"
            again = "handed in again, " if (graded / name).is_file() else ""
            return "", f"{again}not graded"
        try:
            submission = gradebook.find_submission(exercise, student)
        except MissingEntry:
            return "", "not graded"
        if submission.needs_manual_grade:
            return "", "answers to be graded by hand"
        return f"{submission.score - submission.late_submission_penalty:g}", "graded"

    def list_open(self, name: str, marks: dict) -> None:
        """Warn of hand-ins without a grade, and of files that were not collected."""
        for student, (_, state) in marks.items():
            if state != "graded":
                self.log.warning("%s of %s: %s", name, student or "?", state)
        for (student, exercise), files in downloaded(name).items():
            if exercise != name and not marks[student][1].startswith("not collected"):
                self.log.warning(
                    "%s of %s: not collected: %s", name, student, ", ".join(files)
                )

    def fill_worksheet(self, name: str, marks: dict) -> None:
        """Fill in downloaded/EXERCISE/worksheet.csv; its lines are "Participant N"."""
        path = HERE / "downloaded" / name / "worksheet.csv"
        if not path.is_file():
            return
        with path.open(newline="", encoding="utf-8-sig") as file:
            head, *lines = csv.reader(file)
        for line in lines:
            number = re.sub(r"\D", "", line[0])
            score, _ = marks.get(number, ("", ""))
            if score:  # otherwise a grade of the worksheet stays
                line[head.index(GRADE)] = score
        filled = path.with_name("worksheet_filled.csv")
        with filled.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([head, *lines])
        self.log.info("%s: upload %s in Moodle", name, filled)

    def pack_feedback(self, name: str, marks: dict) -> None:
        """Zip the pages of feedback/; Moodle finds the student by the file's name."""
        path = HERE / "downloaded" / name / "feedback_files.zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for student, (_, state) in marks.items():
                page = HERE / "feedback" / student / name / f"{name}.html"
                if state == "graded" and page.is_file():
                    moodle = f"Participant_{student}_assignfeedback_file_{name}.html"
                    archive.write(page, moodle)


c.ExportApp.plugin_class = Marks
