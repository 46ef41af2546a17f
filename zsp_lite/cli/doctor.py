"""Checks of the installation: Python, PyTorch, weights, cache, data. Each problem has the command that fixes it."""

import os
import platform
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from zsp_lite.data.samples import DATA_VARIABLE, data_folders
from zsp_lite.errors import InputError

OK, NOTE, BAD = "ok", "note", "bad"


@dataclass(frozen=True)
class Check:
    """Result of one check: its name, "ok", "note" (optional) or "bad", what was found, and how to fix it."""

    name: str
    state: str
    found: str
    fix: str = ""


def run_checks(data: Path | None = None) -> Iterator[Check]:
    """Run all checks, in the order in which problems should be fixed; `data` is a CO3D folder to check as well."""
    python = f"{platform.python_version()} on {platform.system()} {platform.machine()} ({sys.executable})"
    if sys.version_info < (3, 11):  # noqa: UP036 - the package may be on the path of an older interpreter
        yield Check("Python", BAD, python, "make clean && make demo PYTHON=/path/to/python3.11")
        return
    yield Check("Python", OK, python)
    try:
        import torch

        from zsp_lite.data.co3d import Co3D
    except (ImportError, OSError) as error:
        yield Check("packages", BAD, f"cannot be imported: {error}", f"{sys.executable} -m pip install zsp-lite")
        return
    cuda = f"CUDA on {torch.cuda.get_device_name(0)}" if torch.cuda.is_available() else "no CUDA (not required)"
    yield Check("torch", OK, f"{torch.__version__}, {torch.get_num_threads()} threads, {cuda}")
    yield from _weights()
    yield _cache()
    for name, folder in data_folders(data):
        yield _data(name, folder, Co3D)
    if data is None and not os.environ.get(DATA_VARIABLE):
        yield Check(f"data: {DATA_VARIABLE}", NOTE, "not set", "set it to a CO3D folder, for your own data")


def _weights() -> Iterator[Check]:
    from zsp_lite.backbones.pretrained import EMBEDDED, available_backbones, obtained_by

    for name, path in available_backbones().items():
        if path is None:
            yield Check(f"weights {name}", BAD if name in EMBEDDED else NOTE, "no file", obtained_by(name))
        else:
            yield Check(f"weights {name}", OK, f"{path} ({path.stat().st_size / 1e6:.1f} MB)")


def _cache() -> Check:
    from zsp_lite.io.download import cache_folder

    folder = cache_folder()
    existing = next((one for one in (folder, *folder.parents) if one.exists()), folder)
    if existing.is_dir() and os.access(existing, os.W_OK):
        return Check("cache", OK, str(folder))
    return Check("cache", NOTE, f"{folder} cannot be written", "set ZSP_LITE_CACHE to a folder, for downloads")


def _data(name: str, folder: Path, dataset: type) -> Check:
    sample = name == "data_samples"
    try:
        categories = dataset(folder).categories()
        problem = f"{folder}: no category (a folder with frame_annotations.jgz)"
    except InputError as error:
        categories, problem = [], str(error)
    if categories:
        listed = ", ".join(categories[:6]) + (", ..." if len(categories) > 6 else "")
        return Check(f"data: {name}", OK, f"{folder}: {len(categories)} categories ({listed})")
    fix = "zsp-lite demo (makes them once)" if sample else f"give {name} a CO3D folder"
    return Check(f"data: {name}", NOTE if sample else BAD, problem, fix)
