"""Provenance of a run: version and git revision of the library, versions of its dependencies, machine."""

import functools
import hashlib
import os
import platform
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from zsp_lite import __version__

_PACKAGE = Path(__file__).parents[1]
_DEPENDENCIES = ("torch", "numpy", "opencv-python-headless", "scikit-learn", "scipy", "open3d-cpu", "open3d")


def library_version() -> dict[str, str | None]:
    """Return {"version": of zsp_lite, "revision": see `git_revision`}."""
    return {"version": __version__, "revision": git_revision()}


def environment() -> dict[str, Any]:
    """Describe this call: time, command, versions of the library and its dependencies, git revision and machine."""
    program = Path(sys.argv[0]).name
    versions = {"python": platform.python_version(), "zsp-lite": __version__}
    for package in _DEPENDENCIES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return {
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": ["zsp-lite" if program == "__main__.py" else program, *sys.argv[1:]],
        "versions": versions,
        "git": {"commit": _git("rev-parse", "HEAD"), "revision": git_revision()},
        "machine": {"system": platform.platform(), "processor": platform.machine(), "cores": os.cpu_count()},
    }


@functools.cache
def git_revision() -> str | None:
    """Return the git tree of the library's folder, None outside a checkout.

    Commits that change only other folders, such as the documentation, leave it as it is. Where files of the library
    differ from the last commit, "-modified-" and a hash of its Python files follow.
    """
    tree = _git("rev-parse", "HEAD:./")
    if tree is None or not _git("status", "--porcelain", "--", "."):
        return tree
    digest = hashlib.sha256()
    for path in sorted(_PACKAGE.rglob("*.py")):
        digest.update(f"{path.relative_to(_PACKAGE).as_posix()}\n".encode() + path.read_bytes())
    return f"{tree}-modified-{digest.hexdigest()[:8]}"


def _git(*arguments: str) -> str | None:
    """Output of a git command in the library's folder, None outside a checkout."""

    def run(*words: str) -> str:
        command = ["git", "-C", str(_PACKAGE), *words]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        # An installed copy may lie inside the repository of another project, whose revision says nothing.
        return run(*arguments) if run("ls-files", "__init__.py") else None
    except (OSError, subprocess.SubprocessError):
        return None
