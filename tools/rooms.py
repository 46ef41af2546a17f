"""The rooms of the library, and what flows between them: the names that one room imports from
another.

    python -m tools.rooms

draws them in `docs/rooms.svg`.
"""

import ast
import re
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from textwrap import wrap

import zsp_lite

PACKAGE = Path(zsp_lite.__file__).parent
DRAWING = Path(__file__).parents[1] / "docs" / "rooms.svg"
# From the bottom to the top: the modules and subpackages of each room.
ROOMS = {
    "files": "choices errors io",
    "geometry": "alignment features metrics minimal",
    "data": "data",
    "stages": "best_view estimates matchers matching pipeline points views",
    "backbones": "backbones",
    "verified": "scans verified",
    "importers": "importers",
    "viz": "viz",
    "benchmark": "baselines benchmark",
    "objects": "objects",
    "course": "course",
    "cli": "__main__ cli",
}
ROOM_OF = {module: room for room, modules in ROOMS.items() for module in modules.split()}


def modules() -> dict[str, Path]:
    """Return the file of every module by its dotted name without "zsp_lite.".

    The package's own `__init__` is left out.
    """
    paths = {
        path: path.relative_to(PACKAGE).with_suffix("").parts
        for path in sorted(PACKAGE.rglob("*.py"))
    }
    return {
        ".".join(parts).removesuffix(".__init__"): path
        for path, parts in paths.items()
        if parts != ("__init__",)
    }


def imported_names(code: str) -> Iterator[tuple[str, int]]:
    """Find every import of a program, also inside functions, and every `zsp_lite.NAME`.

    Yields the imported name such as "package.module.name", and the line.
    """
    homes = zsp_lite._HOME_OF  # where the public names of the package are defined
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"line {node.lineno}: relative import, expected the full name"
            for alias in node.names:
                home = homes.get(alias.name) if node.module == "zsp_lite" else None
                yield f"{home or node.module}.{alias.name}", node.lineno
        elif isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "zsp_lite":
            yield f"{homes.get(node.attr, 'zsp_lite')}.{node.attr}", node.lineno


def imports() -> Iterator[tuple[str, str, int]]:
    """Find the imports of all modules: the module, the imported name and the line."""
    for module, path in modules().items():
        for name, line in imported_names(path.read_text(encoding="utf-8")):
            yield module, name, line


def flows() -> dict[tuple[str, str], Counter[str]]:
    """Count the imported names by the rooms (giver, taker) between which they flow."""
    counts = defaultdict(Counter)
    for module, imported, _ in imports():
        package, _, name = imported.partition(".")
        taker = ROOM_OF[module.partition(".")[0]]
        giver = ROOM_OF.get(name.partition(".")[0], taker)
        if package == "zsp_lite" and giver != taker:
            counts[giver, taker][name.rpartition(".")[2]] += 1
    return counts


def _type_lines(names: Counter[str]) -> list[str]:
    """Write the two types imported most, broken between their words into at most three lines."""
    types = [name for name in names if name[0].isupper() and not name.isupper()]
    lines = []
    for name in sorted(types, key=lambda name: (-names[name], name))[:2]:
        words = re.sub("(?<=[a-z0-9])(?=[A-Z])", " ", name)
        # A line of a box has room for 13 letters.
        broken = [line.replace(" ", "") for line in wrap(words, 13)]
        if len(lines + broken) <= 3:
            lines += broken
    return lines


def _box(x: int, y: int, lines: list[str], kind: str) -> str:
    """Draw a box of 72 by 40 pixels around (x, y), with lines of text 12 pixels apart in it."""
    drawn = f'<rect class="{kind}" x="{x - 36}" y="{y - 20}" width="72" height="40" rx="4"/>\n'
    for i, line in enumerate(lines):
        below = 4 + 12 * i - 6 * (len(lines) - 1)
        drawn += f'<text class="{kind}" x="{x}" y="{y + below}">{line}</text>\n'
    return drawn


def draw() -> str:
    """Draw the rooms on a diagonal, with a line from each to those that import from it."""
    # From box to box 78 pixels to the right and 50 down. Arrows end one pixel above a box.
    place = {room: (56 + 78 * i, 34 + 50 * i) for i, room in enumerate(ROOMS)}
    width, height = (end + 56 for end in place[list(ROOMS)[-1]])
    lines = boxes = ""
    for (giver, taker), names in sorted(flows().items()):
        left, y = place[giver]
        x, bottom = place[taker]
        lines += f'<path d="M{left} {y}H{x}V{bottom - 21}m-5-7l5 7 5-7"/>\n'
        types = _type_lines(names)
        boxes += _box(x, y, types, "types") if types else f'<circle cx="{x}" cy="{y}" r="4"/>\n'
    for room, (x, y) in place.items():
        boxes += _box(x, y, [room], "room")
    legend = [
        "A room gives what is at its right, and takes what is above it.",
        "Shown are the types that are imported most; a dot: functions or constants only.",
        "Nothing flows back: the half below the rooms is empty.",
        "",
        *(f"{room}: {names.replace(' ', ', ')}" for room, names in ROOMS.items() if room != names),
    ]
    for i, line in enumerate(reversed(legend)):
        boxes += f'<text x="20" y="{height - 24 - 20 * i}">{line}</text>\n'
    return f"""\
<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}"
  viewBox="0 0 {width} {height}" font-family="sans-serif" font-size="13" role="img">
<title>The rooms of zsp_lite, and the types that flow from each to those after it</title>
<style>
  path {{ fill: none; stroke: #8C8C8C }}
  rect {{ fill: white; stroke: #B8B8B0 }}
  circle {{ fill: #595959 }}
  .types {{ font-size: 10px; text-anchor: middle }}
  rect.room {{ fill: #CCE8F8; stroke: #0072B2 }}
  text.room {{ font-size: 11px; font-weight: bold; text-anchor: middle }}
</style>
<rect width="100%" height="100%"/>
{lines}{boxes}</svg>
"""


if __name__ == "__main__":
    DRAWING.write_text(draw(), encoding="utf-8")
