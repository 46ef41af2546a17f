"""The command `zsp-lite`: it parses options, calls the library and prints the results.

Each command imports what it needs inside its function, so that `--help` stays quick. Arguments are
of the types of the options.
"""

import io
import logging
import os
import sys
from collections.abc import Sequence

import click

from zsp_lite import __version__
from zsp_lite.cli.align import align
from zsp_lite.cli.benchmark import benchmark, compare, tables
from zsp_lite.cli.challenge import challenge
from zsp_lite.cli.common import examples
from zsp_lite.cli.data import data
from zsp_lite.cli.demo import demo
from zsp_lite.cli.doctor import doctor
from zsp_lite.cli.estimate import estimate
from zsp_lite.cli.synth import synth
from zsp_lite.errors import FatalError, InputError


@click.group(
    no_args_is_help=False,
    context_settings={
        "help_option_names": ["-h", "--help"],
        "max_content_width": 120,
        "show_default": True,
    },
    epilog="`zsp-lite COMMAND --help` explains a command. Bad input: one line on stderr and exit "
    "code 2.",
)
@click.version_option(__version__)
def cli() -> None:
    """Zero-shot category-level object pose estimation: demo, benchmark, data, backbones."""


for command in (demo, estimate, align, benchmark, tables, compare, synth, challenge, data, doctor):
    cli.add_command(command)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command, and return the exit code: 0, 1 (a check failed), 2 (bad input), or 130
    (interrupted)."""
    os.environ["MPLBACKEND"] = "Agg"  # figures are written to files, without a display
    logging.basicConfig(format="%(message)s")
    logging.getLogger("zsp_lite").setLevel(logging.INFO)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # notebooks and tests have others
            stream.reconfigure(errors="backslashreplace")  # names of files need not be valid text
    try:
        with cli.make_context("zsp-lite", list(sys.argv[1:] if argv is None else argv)) as context:
            code = cli.invoke(context) or 0
        sys.stdout.flush()  # BrokenPipeError is raised here, and not at the exit of Python
        return code
    except click.exceptions.Exit as stop:  # --help
        return stop.exit_code
    except click.UsageError as error:
        command = error.ctx.command_path if error.ctx else "zsp-lite"
        message = f"{error.format_message()} (see: {command} --help)"
    except (InputError, FatalError) as error:
        message = str(error)
    except BrokenPipeError:  # the reader of the output, such as `head`, has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:  # a folder without write permission, a full disk
        message = f"{error.filename}: {error.strerror}" if error.filename else str(error)
    except (KeyboardInterrupt, click.Abort):  # Abort: of a question
        print("zsp-lite: interrupted", file=sys.stderr)
        return 130
    print(f"zsp-lite: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


@cli.group(no_args_is_help=False, epilog=examples("weights list", "weights fetch dino_vits8"))
def weights() -> None:
    """List or download the weights of backbones."""


@weights.command("list", epilog=examples("weights list"))
def list_weights() -> None:
    """List every backbone with its file, or where to get it."""
    from zsp_lite.backbones.released import available_backbones, how_to_obtain

    for name, path in available_backbones().items():
        print(f"{name:19} {path or how_to_obtain(name)}")


@weights.command(
    epilog=examples("weights fetch dino_vits8", "weights fetch hf:facebook/dinov2-small")
)
@click.argument("name")
def fetch(name) -> None:
    """Download a backbone: NAME as `weights list` prints it, or hf:NAME."""
    from zsp_lite.backbones.released import download

    print(f"Available: {download(name)}")
