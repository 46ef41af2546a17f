"""Print the size of every room of the project, with its limit.

    python -m tools.size

`tests/size_limits.csv` names the rooms, the patterns of their files and the limits; a test holds
them. Code is counted in tokens without comments and docstrings, so that neither an explanation nor
a line break costs anything; text in words of Markdown files and of the text cells of notebooks.
"""

import ast
import csv
import functools
import io
import itertools
import json
import re
import tokenize
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from pygments.lexers import get_lexer_for_filename
from pygments.token import Comment, Text

ROOT = Path(__file__).parents[1]
LIMITS = ROOT / "tests" / "size_limits.csv"
_LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


class Room(NamedTuple):
    """Size of the files of one room."""

    name: str
    unit: str
    size: int
    limit: int


def rooms() -> Iterator[Room]:
    """Measure all rooms. A file that several patterns of a room match counts once."""
    with LIMITS.open() as table:
        for row in csv.DictReader(table):
            files = {file for pattern in row["files"].split() for file in ROOT.glob(pattern)}
            count = _words if row["unit"] == "words" else _tokens
            yield Room(row["room"], row["unit"], sum(map(count, files)), int(row["limit"]))


@functools.cache  # most files are in several rooms
def _tokens(file: Path) -> int:
    """Count the tokens of a file of code."""
    text = file.read_text("utf-8")
    return python_tokens(text) if file.suffix == ".py" else other_tokens(text, file.name)


def python_tokens(text: str) -> int:
    """Count the tokens of a Python program that are neither comments, docstrings nor layout."""
    documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    nodes = [node for node in ast.walk(ast.parse(text)) if isinstance(node, documented)]
    docstrings = {node.body[0].lineno for node in nodes if ast.get_docstring(node) is not None}
    tokens = [
        token
        for token in _whole_strings(tokenize.generate_tokens(io.StringIO(text).readline))
        if token.type not in _LAYOUT
        and not (token.type == tokenize.STRING and token.start[0] in docstrings)
    ]
    # The formatter alone decides on a comma before a closing bracket and where a string is broken:
    # neither counts.
    by_formatter = 0
    for first, second in itertools.pairwise(tokens):
        last_comma = first.string == "," and second.string in {")", "]", "}"}
        broken_string = first.type == second.type == tokenize.STRING
        by_formatter += last_comma or broken_string
    return len(tokens) - by_formatter


def _whole_strings(tokens: Iterable[tokenize.TokenInfo]) -> Iterator[tokenize.TokenInfo]:
    """Make one token of each f-string, as before Python 3.12, which splits them."""
    depth = 0
    for token in tokens:
        kind = tokenize.tok_name[token.type]
        depth += kind.endswith("STRING_START")
        if depth == 0:
            yield token
        elif kind.endswith("STRING_END"):
            depth -= 1
            if depth == 0:
                yield token._replace(type=tokenize.STRING)


def other_tokens(text: str, name: str) -> int:
    """Count the tokens of JavaScript, CSS or HTML that are neither comments nor white space."""
    tokens = get_lexer_for_filename(name).get_tokens(text)
    return sum(kind not in Comment and kind not in Text for kind, _ in tokens)


def _words(file: Path) -> int:
    """Count the words of a page, or of the text cells of a notebook without their code."""
    text = file.read_text("utf-8")
    if file.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        pages = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown"]
        text = re.sub("```.*?```", "", "\n".join(pages), flags=re.DOTALL)
    return len(text.split())


if __name__ == "__main__":
    print(f"{'room':28s}{'size':>8s}{'limit':>8s}")
    for room in rooms():
        print(f"{room.name:28s}{room.size:8,d}{room.limit:8,d} {room.unit}")
