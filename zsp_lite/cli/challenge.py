"""The commands `challenge make` and `challenge rank`."""

import signal
import sys

import click

from zsp_lite.cli.common import COUNT, NAMES, PATH, examples
from zsp_lite.errors import InputError

# Signals that end a process. Windows has no SIGHUP.
_ENDING = {signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)}


@click.group(
    no_args_is_help=False,
    epilog=examples(
        "challenge make --categories car,chair --out challenge",
        "challenge rank handins --keep challenge/keep --out ranking",
    ),
)
def challenge() -> None:
    """Set a class a new problem, and rank what it hands in."""


@challenge.command(epilog=examples("challenge make --categories car,chair --out challenge"))
@click.option(
    "--secret", help="At least 8 characters, gives all random draws; asked for if left out."
)
@click.option("--categories", type=NAMES, required=True, help="Of `zsp-lite synth --category`.")
@click.option("--sequences", type=click.IntRange(2, 900), default=6, help="Objects of each.")
@click.option("--frames", type=click.IntRange(5, 1000), default=24, help="Frames of each object.")
@click.option("--pairs", type=COUNT, default=200, help="Pairs in all.")
@click.option("--out", type=PATH, required=True, help="New folder; gets give/ and keep/.")
def make(secret, categories, sequences, frames, pairs, out) -> None:
    """Render objects for a class. OUT/give is for students, OUT/keep for yourself."""
    from zsp_lite.course.challenge.make import make_challenge

    if secret is None:  # among the words of a command, it stays in the shell's history
        if not sys.stdin.isatty():
            raise InputError("no --secret, and no terminal to ask for it")
        secret = click.prompt("Secret sentence", hide_input=True, confirmation_prompt=True)
    make_challenge(secret, categories, out, sequences, frames, pairs)
    print(f"Written: {out / 'give'} for students, {out / 'keep'} with the labels")


@challenge.command(epilog=examples("challenge rank handins --keep challenge/keep --out ranking"))
@click.argument("handins", type=PATH)
@click.option("--keep", type=PATH, required=True, help="Folder keep/ of the challenge.")
@click.option("--out", type=PATH, required=True, help="Folder of the ranking.")
@click.option("--workers", type=COUNT, default=2, help="Hand-ins that run at the same time.")
@click.option("--minutes", type=COUNT, default=10, help="Time limit of a hand-in.")
@click.option("--pair-seconds", type=COUNT, default=20, help="Time limit of it for a pair.")
@click.option("--memory", type=COUNT, default=4, help="Limit of its memory in GB (Linux).")
@click.option("--unprotected", is_flag=True, help="Also where they can read and write your files.")
def rank(handins, keep, out, workers, minutes, pair_seconds, memory, unprotected) -> None:
    """Rank the teams that handed in by Acc30.

    TEAM.py of the folder HANDINS is run, TEAM.csv is read. Each file runs alone, without labels,
    your home folder or a network, and writes to a folder of its own. Where this is not possible (it
    needs Linux), --unprotected runs them all the same. OUT gets ranking.html for the projector, and
    ranking.csv.
    """
    from zsp_lite.cli.terminal import print_rows
    from zsp_lite.course.challenge import rank as ranking

    for number in _ENDING:
        if signal.getsignal(number) != signal.SIG_IGN:  # as under nohup
            signal.signal(number, _interrupt)
    found = ranking.rank(handins, keep, out, workers, minutes, pair_seconds, memory, unprotected)
    columns = ("team", "place", "Acc30 (%)", "95 % interval", "answered")
    rows = []
    for place, one in found.places:
        rows.append(
            (
                one.team,
                str(place),
                f"{one.acc30:.1f}",
                f"{one.low:.1f} to {one.high:.1f}",
                f"{one.answered} of {found.pairs}",
            )
        )
    print_rows("Ranking", columns, rows)
    for _, one in found.places:
        if one.note:
            print(f"{one.team}: {one.note}")
    if not found.alone:
        print("Hand-ins could read labels, each other and your files")
    print(f"Written: {out / 'ranking.html'}, ranking.csv")


def _interrupt(*_) -> None:
    """Interrupt the command, and ignore further signals while it cleans up."""
    for number in _ENDING:
        signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt
