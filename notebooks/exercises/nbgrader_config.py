"""What nbgrader needs to know of this course; it reads this file where it is started, in this folder."""

c = get_config()  # noqa: F821, nbgrader defines it

c.CourseDirectory.course_id = "zsp-lite"

# What students find in place of a solution.
c.ClearSolutions.code_stub = {
    "python": "# Your code here, in place of the next line.\n"
    'raise NotImplementedError("not written yet: replace this line by code that does what the docstring says")'
}
c.ClearSolutions.text_stub = "*Write your answer here, in place of this line.*"

# Seconds for one cell, on a slow machine too: the first import of torch takes most of them.
c.Execute.timeout = 120
