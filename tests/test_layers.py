"""The structure of the code: no module imports from a layer above its own, and no room is larger
than its limit."""

import json
import re
from collections import defaultdict

from tools import size
from tools.rooms import ROOMS, flows, imported_names, imports, modules
from zsp_lite.io.files import REPOSITORY

# From the bottom to the top. A module imports from lower layers and from its own subpackage only,
# and so does a part of the course. Imports inside functions, which delay the loading of large
# libraries, follow the same rule.
LAYERS = [
    "choices errors",
    "io",
    "alignment features metrics minimal",
    "data",
    "matching",
    "matchers views",
    "best_view estimates points",
    "pipeline backbones",
    "verified importers baselines",
    "scans",
    "viz",
    "benchmark",
    "objects",
    "course.samples",
    "course course.synthetic course.labelling course.motorcycle course.true_matches",
    "course.demo course.hypotheses course.make_samples course.pictures course.scan_pictures",
    "course.challenge course.photograph course.training",
    "course.widgets",
    "course.lessons",
    "cli",
    "__main__",
]
# Packages that the course alone imports.
OF_THE_COURSE = {"anywidget", "ipywidgets", "IPython", "jupyterquiz", "skimage"}
LAYER_OF = {name: level for level, names in enumerate(LAYERS) for name in names.split()}
MODULES = modules()
IMPORTS = [*imports()]

# What a lesson up to 06 never asks for, found by its name when it is used, so that lessons do not
# stand on it.
BY_NAME = {
    "backbones.huggingface",
    "backbones.released",
    "data.arrays",
    "data.clouds",
    "data.evaluation",
    "matchers",
    "verified",
}


def layer_name(module: str) -> str:
    """The name that a module or something in it has in `LAYERS`."""
    return next(
        name
        for name in (".".join(module.split(".")[:2]), module.partition(".")[0])
        if name in LAYER_OF
    )


def test_every_module_has_a_layer():
    assert {*map(layer_name, MODULES)} == set(LAYER_OF)


def test_no_module_imports_from_a_higher_layer_or_from_another_name_in_its_own_layer():
    for module, imported, line in IMPORTS:
        package, _, name = imported.partition(".")
        if package == "zsp_lite" and name != "__version__":
            own, other = layer_name(module), layer_name(name)
            allowed = other == own or LAYER_OF[other] < LAYER_OF[own]
            assert allowed, (
                f"zsp_lite.{module}, line {line}, imports {imported}: {other} is not below {own}"
            )


def test_only_the_commands_import_the_course_and_only_it_imports_its_packages():
    for module, imported, line in IMPORTS:
        room = module.partition(".")[0]
        where = f"zsp_lite.{module}, line {line}, imports {imported}"
        assert room == "course" or imported.partition(".")[0] not in OF_THE_COURSE, where
        assert room in ("course", "cli") or not imported.startswith("zsp_lite.course"), where


def test_nothing_flows_back_between_the_rooms_of_the_drawing():
    assert all(list(ROOMS).index(giver) < list(ROOMS).index(taker) for giver, taker in flows())


def home(name: str) -> set[str]:
    """The module of the library that has an imported name, and the packages above it."""
    parts = name.split(".")
    above = {".".join(parts[1:end]) for end in range(2, len(parts) + 1)}
    return above & MODULES.keys() if parts[0] == "zsp_lite" else set()


def test_lessons_00_to_06_stand_on_at_most_6300_lines():
    below = defaultdict(set)
    for module, name, _ in IMPORTS:
        below[module] |= home(name)
    todo = set()
    for path in REPOSITORY.glob("notebooks/0[0-6]*.ipynb"):
        cells = json.loads(path.read_text("utf-8"))["cells"]
        lines = [line for cell in cells if cell["cell_type"] == "code" for line in cell["source"]]
        # Without commands of IPython.
        code = "".join(line.rstrip("\n") + "\n" for line in lines if line[0] not in "%!")
        for name, _ in imported_names(code):
            todo |= home(name)
    found = {}
    while todo:
        module = todo.pop()
        text = MODULES[module].read_text("utf-8")
        found[module] = text.count("\n")
        todo |= below[module] - found.keys()
        by_name = re.findall(r'resolve_name\("zsp_lite\.([\w.]+)', text)
        assert {*by_name} <= BY_NAME
    largest = sorted(found.items(), key=lambda one: -one[1])[:10]
    # Far fewer lines would mean that imports are overlooked.
    assert 5000 < sum(found.values()) <= 6300, f"{sum(found.values())} lines; largest: {largest}"
    assert not BY_NAME & found.keys()


def test_every_room_is_within_its_limit_and_every_file_of_the_library_in_one_room():
    code = {}
    for name, unit, count, limit in size.rooms():
        assert 0 < count <= limit, f"{name}: {count} {unit}, at most {limit}"
        if name.startswith("zsp_lite"):
            code[name] = count
    assert code.pop("zsp_lite in all") == sum(code.values())
