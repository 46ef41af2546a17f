"""The doctor finds what is missing and names the command that fixes it."""

import subprocess
import sys

import pytest
from packaging.requirements import Requirement

from zsp_lite.cli import doctor
from zsp_lite.cli.doctor import BAD, NOTE, OK, Check
from zsp_lite.data import samples


@pytest.mark.parametrize(
    ("installed", "pinned", "state"),
    [
        ("2.13.0", "2.13.0", OK),
        ("2.13.0+cpu", "2.13.0", OK),  # another build of the pinned version
        ("2.14.0", "2.13.0", NOTE),
        ("2.14.0", None, OK),
        ("1.9.0", "2.13.0", BAD),
        (None, "2.13.0", BAD),
    ],
)
def test_a_version_is_compared_with_the_permitted_range_and_the_pin(installed, pinned, state):
    check = doctor.check_version(Requirement("torch>=2.4"), installed, pinned)
    assert check.state == state
    assert bool(check.fix) == (state != OK)


def test_pins_are_read_for_this_platform_only():
    text = """
# comment
torch==2.13.0
NumPy==2.0 ; python_version >= '3.11'
open3d==1.0 ; python_version < '3'
loose>=1
"""
    assert doctor.read_pins(text) == {"torch": "2.13.0", "numpy": "2.0"}


def test_the_tested_environment_pins_every_dependency_within_its_range():
    import tomllib

    pins = doctor.read_pins((samples.REPOSITORY / "environment.txt").read_text())
    project = tomllib.loads((samples.REPOSITORY / "pyproject.toml").read_text())["project"]
    optional = [
        one
        for extra in ("notebooks", "test", "cluster", "course", "browser", "meshes", "site")
        for one in project["optional-dependencies"][extra]
    ]
    for requirement in map(Requirement, project["dependencies"] + optional):
        own_extra = requirement.name == "zsp-lite"
        if not own_extra and (requirement.marker is None or requirement.marker.evaluate()):
            assert pins[requirement.name.lower()] in requirement.specifier, requirement


def test_one_missing_requirement_fails():
    installed, optional, missing = (Check("a", state, "") for state in (OK, NOTE, BAD))
    assert doctor.ok([installed, optional]) and not doctor.ok([installed, missing])


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


REQUIREMENTS = [
    Requirement(text)
    for text in (
        "torch>=2.4",
        "libusb-package; sys_platform == 'linux'",
        "transformers>=4.56; extra == 'transformers'",
        "huggingface-hub>=0.34; extra == 'transformers'",
        "dask>=2024.1; extra == 'cluster'",
        "distributed>=2024.1; extra == 'cluster'",
    )
]


def test_an_extra_is_listed_with_its_purpose_and_the_command_that_installs_all_of_it(monkeypatch):
    versions = {"transformers": "5.0", "huggingface-hub": "1.0", "dask": "2025.1", "distributed": None}
    monkeypatch.setattr(doctor, "_requirements", lambda: REQUIREMENTS)
    monkeypatch.setattr(doctor, "_version", versions.__getitem__)
    found = {check.name: check for check in doctor._extras()}
    assert list(found) == ["extra transformers", "extra cluster"]  # others are not known to this installation
    installed, missing = found.values()
    assert installed.state == OK and "transformers 5.0" in installed.found and "hf:NAME" in installed.found
    assert missing.state == NOTE and "distributed not installed" in missing.found and "Dask" in missing.found
    assert missing.fix.endswith("install 'zsp-lite[cluster]'")


def test_an_outdated_extra_is_reported(monkeypatch):
    monkeypatch.setattr(doctor, "_requirements", lambda: REQUIREMENTS)
    monkeypatch.setattr(doctor, "_version", lambda package: "4.0")
    old = next(doctor._extras())
    assert old.state == NOTE and "transformers 4.0, expected >=4.56" in old.found and old.fix


def test_without_jupyter_the_whole_extra_for_the_notebooks_is_named(monkeypatch):
    present = doctor._version
    monkeypatch.setattr(doctor, "_version", lambda package: None if package == "anywidget" else present(package))
    check = next(check for check in doctor._extras() if check.name == "extra notebooks")
    assert check.state == NOTE and "anywidget not installed" in check.found and "Jupyter" in check.found
    assert check.fix.endswith("install 'zsp-lite[notebooks]'")


def test_the_doctor_knows_every_extra_but_those_of_developers():
    import tomllib

    project = tomllib.loads((samples.REPOSITORY / "pyproject.toml").read_text())["project"]
    assert set(doctor.EXTRAS) == set(project["optional-dependencies"]) - {"test", "dev", "site", "fuzz"}


def test_open3d_prints_nothing_in_a_notebook():
    """Open3D detects IPython's shell by the name of its class, and would start a web server."""
    notebook = "import builtins; builtins.get_ipython = type('ZMQInteractiveShell', (), {})\n"
    code = notebook + "from zsp_lite.io.open3d import load_open3d; load_open3d()"
    finished = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert finished.stdout == ""
