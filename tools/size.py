"""Print the size of every room of the project, with its limit.

    python -m tools.size

`tests/size_limits.csv` names the rooms, the pattern of their files and the limits; a test holds them. Lines are all
lines of files of code; tokens are Python's, without comments and docstrings; definitions are functions and classes;
words are those of Markdown files and of the text cells of notebooks.
"""

import ast
import csv
import io
import json
import tokenize
from dataclasses import dataclass
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIMITS = ROOT / "tests" / "size_limits.csv"
_NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


@dataclass(frozen=True)
class Room:
    """Size of the files of one room; tokens and definitions are 0 for text."""

    name: str
    unit: str
    size: int
    limit: int
    tokens: int
    definitions: int


@cache
def rooms() -> tuple[Room, ...]:
    """Measure all rooms."""
    with LIMITS.open(newline="") as table:
        return tuple(_measure(row) for row in csv.DictReader(table))


def report() -> str:
    """Return the table of all rooms as text."""
    head = f"{'room':28s}{'size':>8s}{'limit':>8s} {'':6s}{'tokens':>9s}{'definitions':>13s}"
    return "\n".join([head, *(
        f"{one.name:28s}{one.size:8,d}{one.limit:8,d} {one.unit:6s}{one.tokens or '':>9}{one.definitions or '':>13}"
        for one in rooms()
    )])  # fmt: skip


def _measure(row: dict[str, str]) -> Room:
    files = sorted({file for pattern in row["files"].split() for file in ROOT.glob(pattern)})
    texts = [file.read_text(encoding="utf-8") for file in files]
    if row["unit"] == "words":
        size = sum(len(_prose(file, text).split()) for file, text in zip(files, texts))
        return Room(row["room"], "words", size, int(row["limit"]), 0, 0)
    code = [text for file, text in zip(files, texts) if file.suffix == ".py"]
    trees = [ast.parse(text) for text in code]
    named = [node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    docstrings = sum(ast.get_docstring(node) is not None for node in [*trees, *named])
    tokens = sum(
        one.type not in _NO_CODE for text in code for one in tokenize.generate_tokens(io.StringIO(text).readline)
    )
    lines = sum(text.count("\n") for text in texts)
    return Room(row["room"], "lines", lines, int(row["limit"]), tokens - docstrings, len(named))


def _prose(file: Path, text: str) -> str:
    if file.suffix != ".ipynb":
        return text
    return "\n".join("".join(one["source"]) for one in json.loads(text)["cells"] if one["cell_type"] == "markdown")


if __name__ == "__main__":
    print(report())
