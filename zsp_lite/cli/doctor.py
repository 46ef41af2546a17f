"""Checks of the installation: packages, weights, cache. Each problem has the command that fixes it."""

import os
import platform
import sys
from collections.abc import Iterator
from typing import NamedTuple


class Check(NamedTuple):
    """Result of one check."""

    name: str
    state: str  # "ok", "note" (optional) or "bad"
    found: str
    fix: str = ""


def run_checks() -> Iterator[Check]:
    """Run all checks, in the order in which problems should be fixed."""
    yield Check("Python", "ok", f"{platform.python_version()} on {platform.system()} ({sys.executable})")
    try:
        import torch

        from zsp_lite.backbones.pretrained import DEFAULT, available_backbones, obtained_by
        from zsp_lite.io.download import cache_folder
    except (ImportError, OSError) as error:
        fix = f"{sys.executable} -m pip install path/to/zsp-lite"
        yield Check("packages", "bad", f"cannot be imported: {error}", fix)
        return
    cuda = f"CUDA on {torch.cuda.get_device_name(0)}" if torch.cuda.is_available() else "no CUDA (not required)"
    yield Check("torch", "ok", f"{torch.__version__}, {torch.get_num_threads()} threads, {cuda}")
    for name, path in available_backbones().items():
        if path is None:
            yield Check(f"weights {name}", "bad" if name == DEFAULT else "note", "no file", obtained_by(name))
        else:
            yield Check(f"weights {name}", "ok", f"{path} ({path.stat().st_size / 1e6:.1f} MB)")
    folder = cache_folder()
    existing = next(one for one in (folder, *folder.parents) if one.exists())
    if existing.is_dir() and os.access(existing, os.W_OK):
        yield Check("cache", "ok", str(folder))
    else:
        yield Check("cache", "note", f"{folder} cannot be written", "set ZSP_LITE_CACHE to a folder, for downloads")
