"""Configuration of this course; nbgrader reads it when started in this folder."""

import csv
import re
import shutil
import zipfile
from datetime import UTC, datetime
from html import escape
from pathlib import Path

import nbformat
from jinja2 import pass_context
from latex2mathml.converter import convert
from nbconvert.exporters import HTMLExporter
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath
from nbgrader.api import MissingEntry
from nbgrader.converters.base import NbGraderException
from nbgrader.plugins import ExportPlugin, FileNameCollectorPlugin
from nbgrader.preprocessors import NbGraderPreprocessor
from traitlets import Dict

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
# Canvas: NAME_STUDENT_NUMBER_EXERCISE.ipynb. Browsers and people add " (1)", "-Copy1".
EXERCISES = "|".join(sorted(folder.name for folder in (HERE / "source").glob("*")))
STUDENT = r".*/[^/]+?_(?:LATE_)?(?P<student_id>\d+)_(?:assignsubmission_file_?/?|\d+_)"
HANDED_IN = rf"{STUDENT}(?P<file_id>{EXERCISES})[^/]*\.ipynb$"
c.FileNameCollectorPlugin.named_regexp = HANDED_IN
# A second collection replaces the files of the first.
c.ZipCollectApp.force = c.ExtractorPlugin.force = True


def downloaded(assignment):
    """Files of a download by (student, exercise); "" for what a name does not have."""
    found, folder = {}, HERE / "downloaded" / assignment / "extracted"
    for file in sorted(folder.rglob("*")):
        if file.is_file():
            path = file.as_posix()
            named = re.match(HANDED_IN, path) or re.match(STUDENT, path)
            names = named.groupdict() if named else {}
            key = names.get("student_id", ""), names.get("file_id", "")
            found.setdefault(key, []).append(file.relative_to(folder).as_posix())
    return found


class Collector(FileNameCollectorPlugin):
    """Files whose names match HANDED_IN. None of a student who has two of them.

    `nbgrader autograde` grades what is newer than what it has graded. So a file keeps
    the time of its first collection, until the student hands in another one.
    """

    files = Dict()

    def collect(self, submitted_file):
        info = super().collect(submitted_file)
        if info:
            student, name = info["student_id"], info["file_id"]
            assignment = self.parent.coursedir.assignment_id
            self.files = self.files or downloaded(assignment)
            if len(self.files[student, name]) > 1:
                self.log.warning("%s has several files %s: skipped", student, name)
                return None
            folder = HERE / "submitted" / student / assignment
            time = self.parent.coursedir.get_existing_timestamp(str(folder))
            if not time or not same(folder / f"{name}.ipynb", Path(submitted_file)):
                time = datetime.now(UTC).replace(tzinfo=None)
            info["timestamp"] = time
        return info


c.ZipCollectApp.collector_plugin = Collector

# A copy of the hand-in, beside what `nbgrader autograde` made of it.
COPY = "handed_in.copy"
c.CourseDirectory.ignore = [".ipynb_checkpoints", "*.pyc", "__pycache__", COPY]


def same(one, other):
    """Whether two files exist and have the same contents."""
    return one.is_file() and other.is_file() and one.read_bytes() == other.read_bytes()


def keep_hand_ins(notebooks, **_):
    """Copy each hand-in that was graded, to compare a later one with it."""
    for path in map(Path, notebooks):
        *_, student, name = path.parent.parts
        shutil.copy(path, HERE / "autograded" / student / name / COPY)


c.Autograde.post_convert_hook = keep_hand_ins


def marked(notebook):
    """Cells with metadata of nbgrader by their grade id; None if there is no id."""
    found = {}
    for cell in notebook.cells:
        if "nbgrader" in cell.metadata:
            grade_id = (cell.metadata.nbgrader or {}).get("grade_id")
            found.setdefault(grade_id, []).append(cell)
    return found


def fault(handed_in, exercise):
    """Why a notebook cannot be graded; empty if it can be.

    nbgrader puts back a test and the text of the first cell. It cannot know which of
    two solutions or answers counts, nor find one without its metadata. A solution that
    became text may be a note: nbgrader would run it, perhaps after the right code.
    """
    path = HERE / "release" / exercise / f"{exercise}.ipynb"
    if not path.is_file():
        return f"no file release/{exercise}/{path.name}"
    release, found = marked(nbformat.read(path, as_version=4)), marked(handed_in)
    found.pop(None, None)
    faults = {}
    for name in release | found:
        given, (wanted,) = found.get(name, []), release.get(name, [None])
        data = wanted and wanted.metadata.nbgrader
        if any(cell.metadata.nbgrader != data for cell in given):
            cause = "cells of another release"
        elif not given and (data.solution or not data.grade):
            cause = "cells deleted or without metadata"
        elif data.solution and len(given) > 1:
            cause = "cells that are there twice"
        elif data.solution and wanted.cell_type == "code" != given[0].cell_type:
            cause = "solutions that are not code"
        else:
            continue
        faults.setdefault(cause, []).append(name)
    return "; ".join(f"{cause}: {', '.join(faults[cause])}" for cause in faults)


class CheckHandIn(NbGraderPreprocessor):
    """Refuse what cannot be graded, and remove metadata that nbgrader stumbles over."""

    def preprocess(self, nb, resources):
        names = resources["nbgrader"]
        if cause := fault(nb, names["assignment"]):
            file = "submitted/{student}/{assignment}/{notebook}.ipynb".format(**names)
            raise NbGraderException(f"not graded: {file}: {cause}")
        for grade_id, cells in marked(nb).items():
            if grade_id:
                cells.pop()  # the last copy of a test counts
            for cell in cells:
                del cell.metadata["nbgrader"]
        return nb, resources


c.Autograde.sanitize_preprocessors.insert(0, CheckHandIn)
c.OverwriteCells.add_missing_cells = True

# JupyterLab, started with this file: no offer to build it, no question about news.
c.ServerApp.tornado_settings = {"page_config_data": {"buildCheck": False}}
c.LabApp.news_url = None


def seconds(cell):
    """Limit for a cell: that of `nbgrader validate`, but time to import torch."""
    first = cell.metadata.get("nbgrader", {}).get("grade_id") == "setup"
    return 120 if first else 30


c.Execute.timeout_func = seconds


class Renderer(IPythonRenderer):
    """Formulas as MathML, which needs no script from the network."""

    def inline_math(self, body, display="inline"):
        try:
            return convert(body, display=display)
        except Exception:  # a formula of a student
            return f"<code>{escape(body)}</code>"

    def block_math(self, body):
        return f"<p>{self.inline_math(body, 'block')}</p>"


class FeedbackPage(HTMLExporter):
    """nbgrader's page, without a network, with the names of the tasks in its list."""

    @pass_context
    def markdown2html(self, context, source):
        pictures = context.get("cell", {}).get("attachments", {})
        renderer = Renderer(escape=False, attachments=pictures)
        return MarkdownWithMath(renderer=renderer).render(source)

    def from_notebook_node(self, nb, resources=None, **keywords):
        page, resources = super().from_notebook_node(nb, resources, **keywords)
        page = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
        names, task = {}, ""
        for cell in nb.cells:
            if heading := re.match(r"## (Task .*?) \(\d+ points", cell.source):
                task = heading[1]
            part = re.match(r"# (.*)\.\n", cell.source)
            name = f"{task}: {part[1]}" if task and part else task
            names[cell.metadata.get("nbgrader", {}).get("grade_id")] = name

        def with_name(link):
            name = escape(names.get(link["cell"], ""))
            if not name:  # a student's own link
                return link[0]
            return link["start"] + (f"{name}: comment" if link["comment"] else name)

        link = r'(?P<start><a href="#(?P<comment>comment-)?(?P<cell>\w+)">)'
        text = "(?:Test cell|Written response|Comment)(?=</a>)"
        return re.sub(link + text, with_name, page), resources


c.GenerateFeedback.exporter_class = FeedbackPage

# The name of the column for the grade in Moodle's grading worksheet.
GRADE = "Grade"


class Marks(ExportPlugin):
    """`nbgrader export`: grades.csv, Moodle's worksheets, and what has no grade yet.

    A hand-in that was not graded has an empty score, never 0, and is listed.
    """

    def export(self, gradebook):
        self.root, rows = Path(self.parent.coursedir.root), []
        for assignment in gradebook.assignments:
            if self.assignment and assignment.name not in self.assignment:
                continue
            folders = sorted(self.root.glob(f"submitted/*/{assignment.name}"))
            found = {
                one.parent.name: self.score(gradebook, assignment, one.parent.name)
                for one in folders
            }
            found = dict(sorted((found | self.not_collected(assignment.name)).items()))
            rows += [
                (assignment.name, student, score, f"{assignment.max_score:g}", state)
                for student, (score, state) in found.items()
            ]
            self.list_open(assignment.name, found)
            if (self.root / "downloaded" / assignment.name).is_dir():
                self.fill_worksheet(assignment.name, found)
                self.pack_feedback(assignment.name, found)
        with open(self.to or self.root / "grades.csv", "w", newline="") as file:
            names = ["assignment", "student_id", "score", "max_score", "state"]
            csv.writer(file).writerows([names, *rows])

    def not_collected(self, name):
        """No score, and the reason, for students without exactly one valid file.

        What was copied by hand counts: only `zip_collect` writes timestamp.txt.
        """
        files, found = downloaded(name), {}
        for student in {student for student, _ in files}:
            folder = self.root / "submitted" / student / name
            valid = files.get((student, name), [])
            collected = len(valid) == 1 or not (folder / "timestamp.txt").is_file()
            if collected and (folder / f"{name}.ipynb").is_file():
                continue
            others = [files[key] for key in files if key[0] == student]
            count = f"{len(valid)} files, " if len(valid) > 1 else ""
            names = ", ".join(valid or sum(others, []))
            found[student] = "", f"not collected: {count}{names}"
        return found

    def score(self, gradebook, assignment, student):
        """The score as text, empty if there is none, and the state of a hand-in."""
        name = f"{assignment.name}.ipynb"
        handed_in = self.root / "submitted" / student / assignment.name
        graded = self.root / "autograded" / student / assignment.name
        if not (handed_in / name).is_file():
            return "", f"not graded: no file {name}"
        if not same(handed_in / name, graded / COPY):
            try:
                cause = fault(nbformat.read(handed_in / name, 4), assignment.name)
            except Exception:  # whatever a damaged file raises
                cause = "damaged file"
            if cause:
                file = f"submitted/{student}/{assignment.name}/{name}"
                return "", f"not graded: {file}: {cause}"
            again = "handed in again, " if (graded / name).is_file() else ""
            return "", f"{again}not graded"
        try:
            submission = gradebook.find_submission(assignment.name, student)
        except MissingEntry:
            return "", "not graded"
        if submission.needs_manual_grade:
            return "", "answers to be graded by hand"
        return f"{submission.score - submission.late_submission_penalty:g}", "graded"

    def list_open(self, name, found):
        for student, (_, state) in found.items():
            if state != "graded":
                self.log.warning("%s of %s: %s", name, student or "?", state)
        for (student, exercise), files in downloaded(name).items():
            if exercise != name and not found[student][1].startswith("not collected"):
                names = ", ".join(files)
                self.log.warning("%s of %s: not collected: %s", name, student, names)

    def fill_worksheet(self, name, found):
        """Fill in downloaded/EXERCISE/worksheet.csv; its lines are "Participant N"."""
        path = self.root / "downloaded" / name / "worksheet.csv"
        if not path.is_file():
            return
        with path.open(newline="", encoding="utf-8-sig") as file:
            head, *lines = csv.reader(file)
        for line in lines:
            number = re.sub(r"\D", "", line[0])
            score, _ = found.get(number, ("", ""))
            line[head.index(GRADE)] = score or line[head.index(GRADE)]
        filled = path.with_name("worksheet_filled.csv")
        with filled.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([head, *lines])
        self.log.info("%s: upload %s in Moodle", name, filled)

    def pack_feedback(self, name, found):
        """Zip the pages of feedback/; Moodle finds the student by the file's name."""
        path = self.root / "downloaded" / name / "feedback_files.zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for student, (_, state) in found.items():
                page = self.root / "feedback" / student / name / f"{name}.html"
                if state == "graded" and page.is_file():
                    moodle = f"Participant_{student}_assignfeedback_file_{name}.html"
                    archive.write(page, moodle)


c.ExportApp.plugin_class = Marks
