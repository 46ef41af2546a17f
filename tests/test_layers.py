"""The structure of the code: no module imports from a layer above its own, and no room is above its limit of lines."""

import ast
from collections.abc import Iterator
from pathlib import Path

import zsp_lite
from tools import size
from zsp_lite import _HOME_OF

PACKAGE = Path(zsp_lite.__file__).parent

# From the bottom to the top. A module imports from lower layers and from its own subpackage only. Imports inside
# functions, which delay the loading of large libraries, follow the same rule.
LAYERS = [
    "choices errors threads",
    "io",
    "alignment features matchers metrics minimal",
    "data",
    "matching views",
    "best_view motorcycle points",
    "estimates",
    "pipeline backbones",
    "verified labelling importers synthetic baselines",
    "samples",
    "category demo",
    "viz training",
    "benchmark own_objects",
    "align",
    "widgets",
    "cli",
    "__main__",
]
LAYER_OF = {name: level for level, names in enumerate(LAYERS) for name in names.split()}


def read_sources() -> dict[str, str]:
    """Read the source of every module of the package but its `__init__`, by dotted name without "zsp_lite."."""
    sources = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")
        if name != "__init__":
            sources[name] = path.read_text(encoding="utf-8")
    return sources


def imports(source: str, modules: set[str]) -> Iterator[tuple[str, int]]:
    """Find the modules of the package that a source imports, each with its line."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"line {node.lineno}: relative import, expected the full name"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            package, _, name = name.partition(".")
            if package != "zsp_lite":
                continue
            # Where a public name of the package is defined.
            name = f"{_HOME_OF.get(name, package)}.{name}".removeprefix("zsp_lite.")
            while name and name not in modules:  # a function or a class: the module that holds it
                name = name.rpartition(".")[0]
            if name:
                yield name, node.lineno


def test_every_module_has_a_layer():
    names = {module.partition(".")[0] for module in read_sources()}
    assert names == set(LAYER_OF)


def test_no_module_imports_from_a_higher_layer_or_from_another_name_of_its_own():
    sources = read_sources()
    for module, source in sources.items():
        own = module.partition(".")[0]
        for imported, line in imports(source, set(sources)):
            other = imported.partition(".")[0]
            allowed = other == own or LAYER_OF[other] < LAYER_OF[own]
            assert allowed, f"zsp_lite.{module}, line {line}, imports zsp_lite.{imported}: {other} is not below {own}"


def test_every_room_is_within_its_limit():
    for room in size.rooms():
        assert 0 < room.size <= room.limit, f"{room.name}: {room.size} {room.unit}, at most {room.limit}"


def test_every_file_of_the_library_is_in_one_room():
    code = [room for room in size.rooms() if room.name.startswith("zsp_lite")]
    parts, whole = [room.size for room in code if room.name != "zsp_lite in all"], code[-1]
    assert whole.name == "zsp_lite in all" and sum(parts) == whole.size
