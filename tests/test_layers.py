"""The direction of imports: no module imports from a layer above its own, and no modules import each other."""

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

import zsp_lite
from zsp_lite import _HOME_OF

PACKAGE = Path(zsp_lite.__file__).parent

# From the bottom to the top. A module imports from lower layers and from its own subpackage only. Imports inside
# functions, which delay the loading of large libraries, follow the same rule.
LAYERS = [
    "choices errors",
    "io",
    "alignment features matchers metrics minimal",
    "data",
    "matching views",
    "best_view points",
    "estimates",
    "pipeline backbones",
    "verified labelling importers synthetic baselines category",
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

parse = cache(ast.parse)


def read_sources() -> dict[str, str]:
    """Read the source of every module of the package but its `__init__`, by dotted name without "zsp_lite."."""
    sources = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")
        if name != "__init__":
            sources[name] = path.read_text(encoding="utf-8")
    return sources


def imports(source: str, modules: set[str], module_level: bool = False) -> Iterator[tuple[str, int]]:
    """Find the modules of the package that a source imports, each with its line.

    `module_level` leaves out imports inside functions, which do not run when the module is imported. Imports for type
    checkers count like all others.
    """
    nodes = [parse(source)]
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"line {node.lineno}: relative import, expected the full name"
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            if not (module_level and isinstance(node, ast.FunctionDef)):
                nodes.extend(ast.iter_child_nodes(node))
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


def upward_imports(sources: dict[str, str]) -> list[str]:
    """List the imports from a higher layer, or from another name of the same layer."""
    found = []
    for module, source in sources.items():
        own = module.partition(".")[0]
        for imported, line in imports(source, set(sources)):
            other = imported.partition(".")[0]
            if other != own and LAYER_OF[other] >= LAYER_OF[own]:
                found.append(f"zsp_lite.{module}, line {line}, imports zsp_lite.{imported}: {other} is not below {own}")
    return found


def circle(sources: dict[str, str]) -> list[str]:
    """Find modules that import each other at module level; the first and the last of the list are equal."""
    graph = {
        module: {name for name, _ in imports(source, set(sources), module_level=True)} - {module}
        for module, source in sources.items()
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def test_every_module_has_a_layer():
    names = {module.partition(".")[0] for module in read_sources()}
    assert names == set(LAYER_OF)


def test_no_module_imports_upwards():
    assert upward_imports(read_sources()) == []


def test_no_modules_import_each_other():
    assert circle(read_sources()) == []


@pytest.mark.parametrize("home", ["zsp_lite.pipeline", "zsp_lite"])
def test_a_planted_upward_import_is_named(home):
    sources = read_sources()
    sources["best_view"] += f"\ndef late():\n    from {home} import ZeroShotPose\n"
    (message,) = upward_imports(sources)
    assert (
        "zsp_lite.best_view, line" in message
        and "imports zsp_lite.pipeline: pipeline is not below best_view" in message
    )


def test_a_planted_circle_is_named():
    sources = read_sources()
    cameras = sources["data.cameras"]
    for planted in ("import zsp_lite.data.frames\n", "if TYPE_CHECKING:\n    from zsp_lite.data.frames import Frame\n"):
        sources["data.cameras"] = cameras + planted
        assert {"data.cameras", "data.frames"} <= set(circle(sources))
    sources["data.cameras"] = "def late():\n    import zsp_lite.data.frames\n"
    assert circle(sources) == []
