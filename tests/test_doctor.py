"""The doctor finds what is missing and names the command that fixes it."""

import subprocess
import sys
import tomllib

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from zsp_lite.io.files import REPOSITORY


def applying(lines):
    """The requirements in lines that apply to this machine."""
    requirements = map(Requirement, lines)
    return [one for one in requirements if one.marker is None or one.marker.evaluate()]


def test_the_tested_environment_pins_every_dependency_within_its_range():
    lines = (REPOSITORY / "environment.txt").read_text().splitlines()
    pins = {
        canonicalize_name(pin.name): str(pin.specifier).removeprefix("==")
        for pin in applying(line for line in lines if line and not line.startswith("#"))
    }
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    optional = [one for extra in sorted(set(extras) - {"dev"}) for one in extras[extra]]
    for requirement in applying(project["dependencies"] + optional):
        if requirement.name != "zsp-lite":  # an extra of another one
            assert pins[canonicalize_name(requirement.name)] in requirement.specifier, requirement


def test_missing_embedded_weights_fail_and_a_cache_that_cannot_be_written_is_noted(
    tmp_path, monkeypatch, run
):
    (tmp_path / "file").write_text("mine")
    monkeypatch.setenv("ZSP_LITE_CACHE", str(tmp_path / "file"))
    monkeypatch.setattr(
        "zsp_lite.backbones.released.available_backbones", lambda: {"zsp-tiny": None}
    )
    python, torch, tiny, _, cache, cure, last = run("doctor", 1).splitlines()
    assert [line.split()[0] for line in (python, torch, tiny, cache)] == ["ok", "ok", "bad", "note"]
    assert "-> set ZSP_LITE_CACHE" in cure
    assert last == "Missing or broken: weights zsp-tiny."


def test_the_doctor_passes_here(run):
    assert "Everything required is installed." in run("doctor")


def test_open3d_can_be_imported_after_the_package_and_prints_nothing_in_a_notebook():
    """Open3D detects IPython's shell by the name of its class, and would start a web server."""
    notebook = "import builtins; builtins.get_ipython = type('ZMQInteractiveShell', (), {})\n"
    code = notebook + "import zsp_lite, open3d"
    finished = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert finished.stdout == ""
