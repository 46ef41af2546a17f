"""The rooms of the library, and what flows between them: the names that one room imports from
another."""

import ast
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import zsp_lite

PACKAGE = Path(zsp_lite.__file__).parent
# From the bottom to the top: the modules and subpackages of each room.
ROOMS = {
    "files": "choices errors io threads",
    "geometry": "alignment features matchers metrics minimal",
    "data": "data",
    "stages": "best_view estimates matching pair_result pipeline points views",
    "backbones": "backbones",
    "baselines": "baselines",
    "verified": "category marks transfer verified",
    "importers": "importers",
    "viz": "viz",
    "benchmark": "benchmark",
    "objects": "align own_objects scans",
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


def imports() -> Iterator[tuple[str, str, int]]:
    """Find every import, also inside functions.

    Yields the importing module, the imported name such as "package.module.name", and the line.
    """
    for module, path in modules().items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                yield from ((module, alias.name, node.lineno) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert not node.level, (
                    f"{path}, line {node.lineno}: relative import, expected the full name"
                )
                # Where the public names of the package are defined.
                homes = zsp_lite._HOME_OF if node.module == "zsp_lite" else {}
                for alias in node.names:
                    yield module, f"{homes.get(alias.name, node.module)}.{alias.name}", node.lineno


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
