"""Checks of the installation: packages, backbones, data. Each failed check names the command that fixes it."""

import importlib.metadata
import os
import platform
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from packaging.requirements import InvalidRequirement, Requirement

from zsp_lite.data.samples import DATA_VARIABLE, REPOSITORY, data_folders
from zsp_lite.errors import InputError

OK, NOTE, BAD = "ok", "note", "bad"
# Optional extras that users need, and for what.
EXTRAS = {
    "notebooks": "the notebooks, in Jupyter",
    "transformers": "backbones hf:NAME, vision transformers in Hugging Face's format (DINOv2, DINOv3, CLIP, ...)",
    "meshes": "your own 3D models in COLLADA files (zsp-lite synth --models)",
    "cluster": "the benchmark on a Dask cluster (--executor dask://HOST:PORT)",
    "course": "handing out and grading the exercises, and the self-checks of the notebooks",
    "browser": "the notebooks in a real browser (make browser)",
}
_PIP = f"{sys.executable} -m pip"  # `pip` on the path may belong to another interpreter


@dataclass(frozen=True)
class Check:
    """Result of one check.

    Attributes:
        name: What was checked.
        state: "ok", "note" (optional, or not the tested version) or "bad" (required, but missing or broken).
        found: The installed version, the path, or the problem.
        fix: Command or instruction that fixes the problem; empty if there is none.
    """

    name: str
    state: str
    found: str
    fix: str = ""


def run_checks(data: Path | None = None) -> list[Check]:
    """Run all checks, in the order in which problems should be fixed.

    Args:
        data: CO3D folder to check in addition to the default ones.
    """
    return [_python(), *_packages(), _torch(), _open3d(), *_backbones(), *_extras(), *_data(data)]


def ok(checks: list[Check]) -> bool:
    """Return whether everything required works."""
    return all(check.state != BAD for check in checks)


def check_version(requirement: Requirement, installed: str | None, pinned: str | None) -> Check:
    """Check the version of one package.

    Args:
        requirement: Name and permitted versions.
        installed: Installed version; None if the package is missing.
        pinned: Version of the tested environment, if known.
    """
    name, install = requirement.name, f"{_PIP} install '{requirement.name}{requirement.specifier}'"
    if installed is None:
        return Check(name, BAD, f"not installed, expected {requirement.specifier or 'any version'}", install)
    if not requirement.specifier.contains(installed, prereleases=True):
        return Check(name, BAD, f"{installed}, expected {requirement.specifier}", install)
    # A local label (torch's "+cpu") is another build of the same version.
    if pinned is not None and installed.split("+")[0] != pinned:
        return Check(name, NOTE, f"{installed}, tested with {pinned}", f"{_PIP} install '{name}=={pinned}'")
    return Check(name, OK, installed)


def read_pins(text: str) -> dict[str, str]:
    """Read the exact versions (`==`) for this platform from a requirements file, by package name in lower case."""
    pins = {}
    for line in text.splitlines():
        try:
            requirement = Requirement(line)
        except InvalidRequirement:  # a comment or an empty line
            continue
        exact = [part.version for part in requirement.specifier if part.operator == "=="]
        if exact and (requirement.marker is None or requirement.marker.evaluate()):
            pins[requirement.name.lower()] = exact[0]
    return pins


def _python() -> Check:
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()} ({sys.executable})"
    if sys.version_info < (3, 11):  # noqa: UP036 - the package may be on the path of an older interpreter
        return Check("Python", BAD, found, "make clean && make demo PYTHON=/path/to/python3.11")
    return Check("Python", OK, found)


def _packages() -> Iterator[Check]:
    requirements = _requirements()
    if not requirements:
        yield Check("zsp-lite", BAD, "not installed", f"{_PIP} install --no-deps -e {REPOSITORY}")
        return
    yield Check("zsp-lite", OK, importlib.metadata.version("zsp-lite"))
    environment = REPOSITORY / "environment.txt"
    pins = read_pins(environment.read_text()) if environment.is_file() else {}
    for requirement in requirements:
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            yield check_version(requirement, _version(requirement.name), pins.get(requirement.name.lower()))


def _torch() -> Check:
    try:
        import torch
    except (ImportError, OSError) as error:
        return _not_importable("torch runs", error, f"{_PIP} install --force-reinstall torch")
    cuda = f"CUDA on {torch.cuda.get_device_name(0)}" if torch.cuda.is_available() else "no CUDA (not required)"
    return Check("torch runs", OK, f"{torch.get_num_threads()} threads of {os.cpu_count()} CPUs, {cuda}")


def _open3d() -> Check:
    from zsp_lite.io.open3d import load_open3d

    try:
        return Check("open3d loads", OK, load_open3d().__version__)
    except (ImportError, OSError) as error:
        wheel = "open3d-cpu libusb-package" if sys.platform.startswith("linux") else "open3d"
        return _not_importable("open3d loads", error, f"{_PIP} install {wheel}")


def _backbones() -> Iterator[Check]:
    try:
        from zsp_lite.backbones.pretrained import EMBEDDED, available_backbones, only_in_repository
    except (ImportError, OSError) as error:
        yield _not_importable("backbones", error, "fix the problems above first")
        return
    for name, path in available_backbones().items():
        if path is not None:
            yield Check(f"backbone {name}", OK, f"{path} ({path.stat().st_size / 1e6:.1f} MB)")
        elif only_in_repository(name):
            yield Check(f"backbone {name}", NOTE, "not part of the package", "it is in the repository")
        elif name in EMBEDDED:
            yield Check(f"backbone {name}", BAD, "its weights are missing in the package", "reinstall zsp-lite")
        else:
            yield Check(f"backbone {name}", NOTE, "not downloaded", f"zsp-lite weights fetch {name}")


def _extras() -> Iterator[Check]:
    """Check the packages of each optional extra. The fix installs the whole extra."""
    requirements = [one for one in _requirements() if one.marker is not None and not one.marker.evaluate({"extra": ""})]
    for extra, purpose in EXTRAS.items():
        problems, installed = [], []
        for requirement in (one for one in requirements if one.marker.evaluate({"extra": extra})):
            version = _version(requirement.name)
            if version is None:
                problems.append(f"{requirement.name} not installed")
            elif not requirement.specifier.contains(version, prereleases=True):
                problems.append(f"{requirement.name} {version}, expected {requirement.specifier}")
            else:
                installed.append(f"{requirement.name} {version}")
        if problems:
            found = f"{'; '.join(problems)} (only for {purpose})"
            yield Check(f"extra {extra}", NOTE, found, f"{_PIP} install 'zsp-lite[{extra}]'")
        elif installed:
            yield Check(f"extra {extra}", OK, f"{', '.join(installed)}: {purpose}")


def _requirements() -> list[Requirement]:
    """Return the requirements of zsp-lite, with those of its extras; empty if it is not installed."""
    try:
        return [Requirement(text) for text in importlib.metadata.requires("zsp-lite") or []]
    except importlib.metadata.PackageNotFoundError:
        return []


def _version(package: str) -> str | None:
    """Return the installed version of a package, or None."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _data(data: Path | None) -> Iterator[Check]:
    try:
        from zsp_lite.data.co3d import Co3D
    except (ImportError, OSError) as error:
        yield _not_importable("data", error, "fix the problems above first")
        return
    for name, folder in data_folders(data):
        sample = name == "data_samples"
        fix = "zsp-lite demo (makes them once)" if sample else f"set {name} to a CO3D folder"
        try:
            categories = Co3D(folder).categories()
            problem = f"{folder}: no category (a folder with frame_annotations.jgz)"
        except InputError as error:
            categories, problem = [], str(error)
        if categories:
            listed = ", ".join(categories[:6]) + (", ..." if len(categories) > 6 else "")
            yield Check(f"data: {name}", OK, f"{folder}: {len(categories)} categories ({listed})")
        else:
            yield Check(f"data: {name}", NOTE if sample else BAD, problem, fix)
    if data is None and not os.environ.get(DATA_VARIABLE):
        fix = f"export {DATA_VARIABLE}=/path/to/co3d (only for your own data)"
        yield Check(f"data: {DATA_VARIABLE}", NOTE, "not set", fix)


def _not_importable(name: str, error: Exception, fix: str) -> Check:
    first_line = (str(error).strip() or type(error).__name__).splitlines()[0]
    return Check(name, BAD, f"cannot be imported: {first_line}", fix)
