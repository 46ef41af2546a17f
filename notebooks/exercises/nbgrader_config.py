"""Configuration of this course; nbgrader reads it when started in this folder."""

c = get_config()  # noqa: F821, nbgrader defines it

c.CourseDirectory.course_id = "zsp-lite"

# What students find in place of a solution.
c.ClearSolutions.code_stub = {
    "python": "# Your code here, in place of the next line.\n"
    'raise NotImplementedError("not written yet: replace this line by your code")'
}
c.ClearSolutions.text_stub = "*Write your answer here, in place of this line.*"

# Seconds for one cell. The first import of torch takes most of them on a slow machine.
c.Execute.timeout = 120
