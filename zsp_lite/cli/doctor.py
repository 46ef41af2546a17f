"""The command `doctor`: checks of the installation, each problem with the command that fixes it."""

import platform
import sys
from collections.abc import Iterator

import click

from zsp_lite.cli.common import examples
from zsp_lite.errors import InputError


@click.command(epilog=examples("doctor"))
def doctor() -> int:
    """Check the installation, and print a fix for every problem."""
    failed = []
    for name, state, found, fix in run_checks():
        print(f"{state:4}  {name:16}  {found}")
        if fix:
            print(f"{'':24}-> {fix}")  # below what was found
        if state == "bad":
            failed.append(name)
    print(
        f"Missing or broken: {', '.join(failed)}."
        if failed
        else "Everything required is installed."
    )
    return 1 if failed else 0


def run_checks() -> Iterator[tuple[str, str, str, str]]:
    """Yield name, state ("ok", "note" if it is optional, "bad"), what was found, and the fix.

    What others need comes first: without the packages, nothing after them is checked.
    """
    yield (
        "Python",
        "ok",
        f"{platform.python_version()} on {platform.system()} ({sys.executable})",
        "",
    )
    try:
        import torch

        from zsp_lite.backbones.released import DEFAULT, available_backbones, how_to_obtain
        from zsp_lite.io.files import cache_folder
        from zsp_lite.io.locks import writing
    except (ImportError, OSError) as error:
        yield (
            "packages",
            "bad",
            f"cannot be imported: {error}",
            f"{sys.executable} -m pip install path/to/zsp-lite",
        )
        return
    cuda = "CUDA" if torch.cuda.is_available() else "no CUDA (not required)"
    yield "torch", "ok", f"{torch.__version__}, {torch.get_num_threads()} threads, {cuda}", ""
    path = available_backbones()[DEFAULT]
    state, fix = ("ok", "") if path else ("bad", how_to_obtain(DEFAULT))
    yield f"weights {DEFAULT}", state, f"{path or 'no file'} (all: zsp-lite weights list)", fix
    folder = cache_folder()
    try:
        with writing(folder):
            yield "cache", "ok", str(folder), ""
    except InputError as error:
        yield "cache", "note", str(error), "set ZSP_LITE_CACHE to a folder, for downloads"
