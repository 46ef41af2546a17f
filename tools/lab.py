"""What a copy of the notebooks hides (`make lab`, the site, Colab): outputs that answer a
prediction."""

import re
import sys
from pathlib import Path

import nbformat
from nbformat import NotebookNode


def answering_cells(notebook: NotebookNode) -> list[NotebookNode]:
    """Return the code cells between a question "Predict, then ..." and the next text, without
    quizzes."""
    found = []
    asked = False
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            asked = bool(re.search(r"\*\*[^*]*predict, then", cell.source, re.IGNORECASE))
        elif asked and "self_check(" not in cell.source:
            found.append(cell)
    return found


def clear_answers(notebook: NotebookNode) -> None:
    """Remove the outputs of these cells."""
    for cell in answering_cells(notebook):
        cell.outputs = []
        cell.execution_count = None


if __name__ == "__main__":
    for path in Path(sys.argv[1]).glob("*.ipynb"):
        notebook = nbformat.read(path, as_version=4)
        clear_answers(notebook)
        nbformat.write(notebook, path)
