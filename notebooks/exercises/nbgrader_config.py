"""Configuration of this course; nbgrader reads it when started in this folder."""

import re
from html import escape

from nbconvert.exporters import HTMLExporter

c = get_config()  # noqa: F821, nbgrader defines it

c.CourseDirectory.course_id = "zsp-lite"

# What students find in place of a solution.
c.ClearSolutions.code_stub = {
    "python": "# Your code here, in place of the next line.\n"
    'raise NotImplementedError("not written yet: replace this line by your code")'
}
c.ClearSolutions.text_stub = "*Write your answer here, in place of this line.*"

# Names of handed-in files, for `nbgrader zip_collect`. Moodle:
# NAME_STUDENT_assignsubmission_file_EXERCISE.ipynb, or with "/" before EXERCISE.
# Canvas: NAME_STUDENT_NUMBER_EXERCISE.ipynb.
c.FileNameCollectorPlugin.named_regexp = (
    r".*/[^/]+?_(?:LATE_)?(?P<student_id>\d+)_(?:assignsubmission_file_?/?|\d+_)"
    r"(?P<file_id>[^/]+?)(?:-\d+)?\.ipynb"
)

# Seconds for one cell. The first import of torch takes most of them on a slow machine.
c.Execute.timeout = 120


class FeedbackPage(HTMLExporter):
    """nbgrader's feedback page, with the names of the tasks in its list of scores."""

    def from_notebook_node(self, nb, resources=None, **keywords):
        page, resources = super().from_notebook_node(nb, resources, **keywords)
        names, name = {}, ""
        for cell in nb.cells:
            if heading := re.match(r"## (Task .*?) \(\d+ points", cell.source):
                name = heading[1]
            names[cell.metadata.get("nbgrader", {}).get("grade_id")] = name

        def with_name(link):
            name = escape(names.get(link["cell"], ""))
            if (
                not name
            ):  # a student's own link, or a task whose heading has another form
                return link[0]
            return link["start"] + (f"{name}: comment" if link["comment"] else name)

        link = r'(?P<start><a href="#(?P<comment>comment-)?(?P<cell>\w+)">)'
        text = "(?:Test cell|Written response|Comment)(?=</a>)"
        return re.sub(link + text, with_name, page), resources


c.GenerateFeedback.exporter_class = FeedbackPage
