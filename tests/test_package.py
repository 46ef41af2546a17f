"""The package's public names, and the examples in its docstrings."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import zsp_lite

# Attributes of modules and classes that users and outside checks rely on, besides the package's own names.
PROMISED = """
    vit.VisionTransformer features.log_bin matching.similarity matching.cyclical_distances alignment.umeyama
    alignment.ransac metrics.rotation_error co3d.Co3D ZeroShotPose.estimate
""".split()


@pytest.mark.slow
def test_every_promised_name_is_an_attribute_after_a_bare_import():
    names = [*PROMISED, *zsp_lite.__all__]
    code = f"import operator, zsp_lite\nfor name in {names}: operator.attrgetter(name)(zsp_lite)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        zsp_lite.nothing  # noqa: B018


def test_the_bare_import_does_not_import_torch():
    code = "import sys, zsp_lite; assert 'torch' not in sys.modules and 'cv2' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_data_file_of_the_package_is_installed():
    """Weights, templates, scripts of widgets, and `py.typed`, by which type checkers read the annotations."""
    package = Path(zsp_lite.__file__).parent
    settings = tomllib.loads((package.parent / "pyproject.toml").read_text(encoding="utf-8"))
    patterns = settings["tool"]["setuptools"]["package-data"]["zsp_lite"]
    installed = {path for pattern in patterns for path in package.glob(pattern) if path.is_file()}
    files = {path for path in package.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")}
    assert package / "py.typed" in files and files == installed
