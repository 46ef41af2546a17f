"""What is installed, what is at hand, where data is looked for, and the command that mends what is missing."""

import importlib.metadata
import importlib.util
import os
import platform
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from packaging.requirements import InvalidRequirement, Requirement
from packaging.specifiers import SpecifierSet

from zsp_lite.data.samples import DATA_VARIABLE, REPOSITORY, data_folders
from zsp_lite.errors import InputError

OK, NOTE, BAD = "ok", "note", "bad"
# What works without: extra to the modules that it stands for and what they give.
EXTRAS = {
    "transformers": (
        ("transformers", "huggingface_hub"),
        "backbones hf:NAME, vision transformers in Hugging Face's format (DINOv2, DINOv3, CLIP, ...)",
    ),
    "cluster": (("dask", "distributed"), "the benchmark on a Dask cluster (--executor dask://HOST:PORT)"),
}


@dataclass(frozen=True)
class Check:
    """One thing looked at. `state` is "ok", "note" (works without) or "bad" (an essential is missing);
    `fix` is the command or step that mends it, empty where there is nothing to mend.
    """

    name: str
    state: str
    found: str
    fix: str = ""


def run_checks(data: Path | None = None) -> list[Check]:
    """All checks, in the order in which one would mend them. `data`: a CO3D folder besides the usual ones."""
    return [_python(), *_packages(), *_torch(), _open3d(), *_backbones(), *_extras(), *_data(data), _jupyter()]


def ok(checks: list[Check]) -> bool:
    """Whether every essential is there."""
    return all(check.state != BAD for check in checks)


def compare(requirement: Requirement, installed: str | None, pinned: str | None) -> Check:
    """The state of one package: its installed version against the range it must be in and the version tested with."""
    name, mend = requirement.name, f"{_pip()} install '{requirement.name}{requirement.specifier}'"
    if installed is None:
        return Check(name, BAD, f"not installed, expected {requirement.specifier or 'any version'}", mend)
    if not requirement.specifier.contains(installed, prereleases=True):
        return Check(name, BAD, f"{installed}, expected {requirement.specifier}", mend)
    # A local label (torch's "+cpu") is another build of the same version.
    if pinned is not None and installed.split("+")[0] != pinned:
        return Check(name, NOTE, f"{installed}, tested with {pinned}", f"{_pip()} install '{name}=={pinned}'")
    return Check(name, OK, installed)


def read_pins(text: str) -> dict[str, str]:
    """Package name (lower case) to version, from a requirements file of exact pins; other lines are passed over."""
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


def _pip() -> str:
    """pip of the interpreter that runs, which need not be the one that `pip` on the path belongs to."""
    return f"{sys.executable} -m pip"


def _python() -> Check:
    found = f"{platform.python_version()} on {platform.system()} {platform.machine()} ({sys.executable})"
    if sys.version_info < (3, 11):  # noqa: UP036 - the doctor may be asked where nothing else runs
        return Check("Python", BAD, found, "make clean && make demo PYTHON=/path/to/python3.11")
    return Check("Python", OK, found)


def _packages() -> Iterator[Check]:
    try:
        requirements = importlib.metadata.requires("zsp-lite") or []
    except importlib.metadata.PackageNotFoundError:
        yield Check(
            "zsp-lite",
            BAD,
            "runs from its folder, is not installed",
            f"{_pip()} install --no-deps -e {REPOSITORY}",
        )
        return
    yield Check("zsp-lite", OK, importlib.metadata.version("zsp-lite"))
    environment = REPOSITORY / "environment.txt"
    pins = read_pins(environment.read_text()) if environment.is_file() else {}
    for requirement in map(Requirement, requirements):
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        yield compare(requirement, _version(requirement.name), pins.get(requirement.name.lower()))


def _torch() -> Iterator[Check]:
    try:
        import torch
    except (ImportError, OSError) as error:
        yield Check(
            "torch runs",
            BAD,
            f"cannot be imported: {_one_line(error)}",
            f"{_pip()} install --force-reinstall torch",
        )
        return
    cuda = f", CUDA on {torch.cuda.get_device_name(0)}" if torch.cuda.is_available() else ", no CUDA (not needed)"
    yield Check("torch runs", OK, f"{torch.get_num_threads()} threads of {os.cpu_count()} CPUs{cuda}")


def _open3d() -> Check:
    from zsp_lite.io.open3d import load_open3d

    try:
        version = load_open3d().__version__
    except (ImportError, OSError) as error:
        wheel = "open3d-cpu libusb-package" if sys.platform.startswith("linux") else "open3d"
        fix = f"{_pip()} install {wheel}"
        return Check("open3d loads", BAD, f"cannot be loaded: {_one_line(error)}", fix)
    return Check("open3d loads", OK, version)


def _backbones() -> Iterator[Check]:
    try:
        from zsp_lite.backbones.pretrained import available_backbones
    except (ImportError, OSError) as error:
        yield Check("backbones", BAD, f"cannot be looked at: {_one_line(error)}", "mend what stands above first")
        return
    for name, path in available_backbones().items():
        if path is not None:
            yield Check(f"backbone {name}", OK, f"{path} ({path.stat().st_size / 1e6:.1f} MB)")
        elif name == "zsp-tiny":
            yield Check(
                f"backbone {name}",
                BAD,
                "its weights are not in the package",
                "reinstall zsp-lite, or zsp-lite train",
            )
        else:
            yield Check(f"backbone {name}", NOTE, "not downloaded", f"zsp-lite weights fetch {name}")


def _extras() -> Iterator[Check]:
    """Whether each optional extra is there, in a version that will do, and what it gives."""
    requirements = _requirements_of_extras()
    for extra, (modules, gives) in EXTRAS.items():
        fix = f"{_pip()} install 'zsp-lite[{extra}]'"
        installed = {module: _version(module) for module in modules}
        missing = [module for module, version in installed.items() if version is None]
        old = [
            f"{module} {version}, expected {requirements[module]}"
            for module, version in installed.items()
            if version and not requirements.get(module, SpecifierSet()).contains(version, prereleases=True)
        ]
        if missing:
            found = f"{', '.join(missing)} not installed (only for {gives})"
            yield Check(f"extra {extra}", NOTE, found, fix)
        elif old:
            yield Check(f"extra {extra}", NOTE, f"{'; '.join(old)} (only for {gives})", fix)
        else:
            there = ", ".join(f"{module} {version}" for module, version in installed.items())
            yield Check(f"extra {extra}", OK, f"{there}: {gives}")


def _version(module: str) -> str | None:
    """The installed version of a module's distribution, None where it is not there."""
    try:
        return importlib.metadata.version(module)
    except importlib.metadata.PackageNotFoundError:
        return None


def _requirements_of_extras() -> dict[str, SpecifierSet]:
    """Module to the versions that this package's extras ask for; empty where the package is not installed."""
    try:
        requirements = map(Requirement, importlib.metadata.requires("zsp-lite") or [])
    except importlib.metadata.PackageNotFoundError:
        return {}
    own = [requirement for requirement in requirements if requirement.marker is not None]
    return {
        requirement.name.replace("-", "_"): requirement.specifier
        for requirement in own
        if any(requirement.marker.evaluate({"extra": extra}) for extra in EXTRAS)
        and not requirement.marker.evaluate({"extra": ""})
    }


def _data(data: Path | None) -> Iterator[Check]:
    try:
        from zsp_lite.data.co3d import Co3D
    except (ImportError, OSError) as error:
        yield Check("data", BAD, f"cannot be looked at: {_one_line(error)}", "mend what stands above first")
        return
    for name, folder in data_folders(data):
        sample = name == "data_samples"
        fix = "zsp-lite synth --preset samples --out data_samples" if sample else f"point {name} at a CO3D folder"
        try:
            categories = Co3D(folder).categories()
        except InputError as error:
            yield Check(f"data: {name}", NOTE if sample else BAD, str(error), fix)
            continue
        if categories:
            listed = ", ".join(categories[:6]) + (", ..." if len(categories) > 6 else "")
            yield Check(f"data: {name}", OK, f"{folder}: {len(categories)} categories ({listed})")
        else:
            found = f"{folder}: no category (a folder with frame_annotations.jgz)"
            yield Check(f"data: {name}", NOTE if sample else BAD, found, fix)
    if data is None and not os.environ.get(DATA_VARIABLE):
        fix = f"export {DATA_VARIABLE}=/path/to/co3d (only to use your own data)"
        yield Check(f"data: {DATA_VARIABLE}", NOTE, "not set", fix)


def _jupyter() -> Check:
    missing = [name for name in ("jupyterlab", "ipywidgets", "nbconvert") if importlib.util.find_spec(name) is None]
    if missing:
        fix = f"{_pip()} install {' '.join(missing)}"
        return Check("Jupyter", NOTE, f"{', '.join(missing)} not installed (only for the notebooks)", fix)
    return Check("Jupyter", OK, f"jupyterlab {importlib.metadata.version('jupyterlab')}")


def _one_line(error: BaseException) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]
