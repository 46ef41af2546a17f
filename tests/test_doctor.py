"""The doctor finds what is missing and names the command that fixes it."""

import subprocess
import sys
import tomllib

from packaging.requirements import InvalidRequirement, Requirement

from zsp_lite.cli import doctor
from zsp_lite.cli.doctor import BAD, NOTE, OK
from zsp_lite.data import samples


def test_the_tested_environment_pins_every_dependency_within_its_range():
    pins = {}
    for line in (samples.REPOSITORY / "environment.txt").read_text().splitlines():
        try:
            requirement = Requirement(line)
        except InvalidRequirement:  # a comment or an empty line
            continue
        if requirement.marker is None or requirement.marker.evaluate():
            (pins[requirement.name.lower()],) = [one.version for one in requirement.specifier if one.operator == "=="]
    project = tomllib.loads((samples.REPOSITORY / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    optional = [one for extra in sorted(set(extras) - {"dev", "fuzz", "transformers"}) for one in extras[extra]]
    for requirement in map(Requirement, project["dependencies"] + optional):
        own_extra = requirement.name == "zsp-lite"
        if not own_extra and (requirement.marker is None or requirement.marker.evaluate()):
            assert pins[requirement.name.lower()] in requirement.specifier, requirement


def test_data_folders_are_the_option_then_the_variable_then_the_samples(monkeypatch, tmp_path):
    monkeypatch.setenv(samples.DATA_VARIABLE, "/from/variable")
    names = [name for name, _ in samples.data_folders(tmp_path)]
    assert names == ["--data", samples.DATA_VARIABLE, "data_samples"]
    monkeypatch.delenv(samples.DATA_VARIABLE)
    assert [name for name, _ in samples.data_folders()] == ["data_samples"]


def test_the_categories_of_a_data_folder_are_listed(ellipsoids):
    found = {check.name: check for check in doctor.run_checks(ellipsoids.root)}
    assert found["data: --data"].state == OK and "ellipsoid" in found["data: --data"].found


def test_a_missing_data_folder_fails_if_the_user_has_set_it(tmp_path, monkeypatch):
    monkeypatch.setenv(samples.DATA_VARIABLE, str(tmp_path / "nowhere"))
    found = {check.name: check for check in doctor.run_checks()}
    assert found[f"data: {samples.DATA_VARIABLE}"].state == BAD
    assert all(check.fix for check in found.values() if check.state != OK)


def test_missing_embedded_weights_fail_and_a_cache_that_cannot_be_written_is_noted(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("mine")
    monkeypatch.setenv("ZSP_LITE_CACHE", str(tmp_path / "file"))
    monkeypatch.setattr(
        "zsp_lite.backbones.pretrained.available_backbones", lambda: {"zsp-tiny": None, "dino_vits8": None}
    )
    found = {check.name: check for check in doctor.run_checks()}
    assert found["weights zsp-tiny"].state == BAD and "reinstall" in found["weights zsp-tiny"].fix
    assert found["weights dino_vits8"].state == NOTE and "fetch dino_vits8" in found["weights dino_vits8"].fix
    assert found["cache"].state == NOTE and "ZSP_LITE_CACHE" in found["cache"].fix


def test_open3d_prints_nothing_in_a_notebook():
    """Open3D detects IPython's shell by the name of its class, and would start a web server."""
    notebook = "import builtins; builtins.get_ipython = type('ZMQInteractiveShell', (), {})\n"
    code = notebook + "from zsp_lite.io.open3d import load_open3d; load_open3d()"
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert finished.stdout == ""
