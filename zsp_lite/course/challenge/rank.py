"""Rank hand-ins of a challenge: each runs in a process of its own, which sees no labels."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from threading import Event

import numpy as np
import pandas as pd
from jaxtyping import Float
from jinja2 import Environment, StrictUndefined
from tqdm import tqdm

from zsp_lite.benchmark.statistics import object_draws
from zsp_lite.benchmark.summary import figures_of, paired_difference
from zsp_lite.course.challenge.answer import read_questions
from zsp_lite.course.challenge.make import QUESTIONS_FILE, copy_for_pairs
from zsp_lite.course.synthetic.export import SETTINGS_FILE
from zsp_lite.data.co3d import Pair
from zsp_lite.data.evaluation import true_poses
from zsp_lite.data.exchange import StoredPose, read_stored_poses
from zsp_lite.errors import InputError
from zsp_lite.io.files import REPOSITORY, cache_folder, write_atomic
from zsp_lite.metrics import rotation_error

_SIGNIFICANT = 0.05  # a difference with a smaller p value is not left to chance
_LONGEST_NOTE = 200  # characters
_LAST_PRINTED = 10_000  # bytes that are read of what a hand-in printed
_POSES_FILE = "poses.csv"
_PAGE = Path(__file__).with_name("ranking.html")
_APART = Path(__file__).with_name("apart.sh")
# Variables of the environment that a hand-in gets; the folder that it finds weights in is added.
_PASSED = ("PATH", "PYTHONPATH", "SYSTEMROOT", "LANG")


@dataclass(frozen=True)
class Result:
    """Result of a team, a line of ranking.csv but for the errors."""

    team: str
    acc30: float  # percent
    low: float  # ends of the 95 % interval, by bootstrap over objects
    high: float
    answered: int  # pairs with a pose
    note: str  # why pairs have none; "" if all have
    errors: Float[np.ndarray, " n"]  # of each pair, degrees; 180 without an answer


@dataclass(frozen=True)
class Ranking:
    """What a ranking page shows."""

    places: list[tuple[int, Result]]  # teams whose difference may be chance share a place
    pairs: int
    categories: list[str]
    alone: bool  # hand-ins could read neither labels nor each other


def rank(
    handins: str | Path,
    keep: str | Path,
    out: str | Path,
    workers: int = 2,
    minutes: float = 10,
    pair_seconds: int = 20,
    memory: float = 4,
    unprotected: bool = False,
) -> Ranking:
    """Run and rank the hand-ins of a folder, and write OUT/ranking.csv and OUT/ranking.html.

    On Linux, where users may make namespaces, a hand-in finds neither labels nor other hand-ins
    nor the home folder nor a network, and writes to a folder of its own alone.

    Args:
        handins: Folder with a file TEAM.py or TEAM.csv of each team.
        keep: Folder that `make_challenge` wrote.
        out: Folder to write.
        workers: Hand-ins that run at the same time.
        minutes: Time limit of a hand-in.
        pair_seconds: Time limit of a hand-in for a pair.
        memory: Limit of its memory in gigabytes, on Linux.
        unprotected: Run hand-ins also where they can read and write what you can.

    Raises:
        InputError: `keep` holds no challenge, or `handins` no hand-in, or two of one team; or this
            system cannot keep hand-ins apart.
    """
    handins = Path(handins)
    keep = Path(keep)
    out = Path(out)
    data = keep / "data"
    if not (data / SETTINGS_FILE).is_file():
        raise InputError(f"{keep} has no labels, expected the folder keep/ of a challenge")
    pairs = read_questions(keep / QUESTIONS_FILE)
    # Without the hidden files that macOS adds to archives.
    found = sorted(handins.glob("[!.]*.*"))
    files = [path for path in found if path.suffix in (".py", ".csv") and path.is_file()]
    teams = {path.stem: path for path in files}
    if not files or len(teams) < len(files):
        raise InputError(
            f"{handins} has {len(files)} hand-ins of {len(teams)} teams, expected one of each, "
            "TEAM.py or TEAM.csv"
        )
    hidden = ["hide", keep.resolve(), "hide", handins.resolve()]
    limits = [str(pair_seconds), str(int(memory * 1e9))]
    ended = Event()
    with TemporaryDirectory(prefix="challenge-") as runs:
        probe = Path(runs).resolve() / "probe"  # a folder in which this system is tried
        probe.mkdir()
        # Poses run no code.
        apart = {path.suffix for path in files} == {".csv"} or _works(
            [*_apart(probe, hidden), sys.executable, "-c", "import zsp_lite"]
        )
        if not (apart or unprotected):
            raise InputError(
                "hand-ins cannot be kept from labels, your files and a network here, expected "
                "Linux with namespaces for users; --unprotected runs them all the same"
            )

        def answers_of(team: str) -> tuple[dict[str, StoredPose], str]:
            """Return the poses of a team, and why some are missing."""
            source = teams[team]
            if source.suffix == ".csv":
                return _read(source)
            # Each has a copy of the data, as it may write there.
            folder = probe.parent / "team" / team
            copy_for_pairs(data, pairs, folder / "data")
            shutil.copy(keep / QUESTIONS_FILE, folder)
            before = _apart(folder, hidden) if apart else []
            note = _run_alone(before, source, folder, minutes, limits, ended)
            poses, problem = _read(folder / _POSES_FILE)
            return poses, note or problem

        pool = ThreadPoolExecutor(workers)
        try:
            done = tqdm(pool.map(answers_of, teams), "hand-ins", len(teams), disable=None)
            answers = dict(zip(teams, done))
        finally:
            ended.set()
            pool.shutdown(cancel_futures=True)

    ranking = Ranking(
        _places(data, pairs, answers),
        len(pairs),
        sorted({pair.category for pair in pairs}),
        apart,
    )
    _write(ranking, out)
    return ranking


def _read(path: Path) -> tuple[dict[str, StoredPose], str]:
    """Read the poses of a hand-in, and say why it has none."""
    try:
        if path.is_symlink():  # perhaps to another team's poses
            raise InputError(f"{path.name} is a link, expected a file")
        return read_stored_poses(path)[0], ""
    except (InputError, OSError) as error:
        # The path of the folder says nothing to the team.
        return {}, str(error).replace(f"{path.parent}{os.sep}", "")


def _run_alone(
    before: Sequence[str | Path],
    source: Path,
    folder: Path,
    minutes: float,
    limits: Sequence[str],
    ended: Event,
) -> str:
    """Run a hand-in in a folder that has the data, by a command with the words `before` (see
    `_apart`); return why it ended early, and the last line that it printed.

    `limits` are the seconds of a pair and the bytes of memory; the event ends it at once.
    """
    copy = Path(shutil.copy(source, folder))
    words = [copy.name, "data", QUESTIONS_FILE, _POSES_FILE, *limits]
    # Without the folder in the search path, where `torch.py` of a team `torch` would be found.
    command = [sys.executable, "-P", "-m", "zsp_lite.course.challenge.answer", *words]
    environment = {name: os.environ[name] for name in _PASSED if name in os.environ}
    environment |= {"HOME": ".", "USERPROFILE": ".", "OMP_NUM_THREADS": "1"}
    environment["ZSP_LITE_CACHE"] = str(cache_folder().resolve())
    # A file, not a pipe: what a hand-in starts may hold a pipe open, or fill the memory by it.
    with (folder / "printed.txt").open("w+b") as printed:
        process = subprocess.Popen(
            [*before, *command],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=printed,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        end = time.monotonic() + 60 * minutes
        while process.poll() is None and time.monotonic() < end and not ended.wait(0.1):
            pass
        code = process.returncode
        problem = [f"ended abruptly, exit status {code}"] if code else []
        if code is None:
            problem = [f"ended after {minutes:g} minutes"]
        _end(process)
        size = printed.seek(0, os.SEEK_END)
        printed.seek(max(0, size - _LAST_PRINTED))
        text = printed.read().decode(errors="replace")
    # A hand-in that is kept apart sees its folder in place of the one above (see apart.sh).
    for path in (folder, folder.parent):
        text = text.replace(f"{path}{os.sep}", "")
    last = text.strip().splitlines()[-1:]
    return "; ".join(problem + last)[:_LONGEST_NOTE]


def _apart(own: Path, last: Sequence[str | Path]) -> list[str | Path]:
    """Return the words before a command that let it find little but the folder `own`, and write
    there alone.

    See apart.sh: `own` takes the place of the folder above it, and `last` are the last steps.
    """
    # Where one of both holds the other, the outer folder first: it would cover the other one.
    outer, inner = sorted([Path.home().resolve(), Path(gettempdir()).resolve()])
    steps = ["hide", outer, "hide", inner]
    for needed in (sys.prefix, sys.base_prefix, REPOSITORY / "zsp_lite", cache_folder()):
        # A path with links is shown, too: programs are found by it.
        steps += ["show", os.path.realpath(needed), "show", needed]
    return ["sh", _APART, own, *steps, *last, "--"]


def _works(command: Sequence[str | Path]) -> bool:
    """Return whether this system runs a command without an error."""
    with suppress(FileNotFoundError):
        return subprocess.run(command, capture_output=True).returncode == 0
    return False


def _end(process: subprocess.Popen) -> None:
    """End a process, and where the system has groups of processes, all of its group."""
    with suppress(ProcessLookupError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
    process.wait()


def _places(
    data: Path, pairs: Sequence[Pair], answers: Mapping[str, tuple[dict[str, StoredPose], str]]
) -> list[tuple[int, Result]]:
    """Sort the teams by Acc30. A team shares the place of the first one of this place, unless their
    difference is significant."""
    objects = [
        [f"{pair.category}/{name}" for name in (pair.reference_sequence, pair.target_sequence)]
        for pair in pairs
    ]
    drawn = object_draws(objects, [pair.category for pair in pairs])
    results = []
    for team, (stored, note) in answers.items():
        # In the order of the pairs; an answer for a frame that was not asked for is none.
        poses = {
            pair: stored[pair.key]
            for pair in pairs
            if pair.key in stored and stored[pair.key].target_frame in pair.target_frames
        }
        surplus = len(stored) - len(poses)
        if surplus:
            note = f"{surplus} of {len(stored)} poses are of no pair and frame of {QUESTIONS_FILE}"
        if len(poses) == len(pairs):
            note = ""
        errors = _errors(data, pairs, poses)
        figures = figures_of(errors, drawn)
        low, high = figures["acc30_ci"]
        results.append(Result(team, figures["acc30"], low, high, len(poses), note, errors))

    results.sort(key=lambda result: -result.acc30)
    places = []
    place = 1
    first = results[0]  # of those that share a place
    for position, result in enumerate(results, 1):
        gain = paired_difference(result.errors, first.errors, weights=drawn)
        if gain["accuracy_gain_p"] < _SIGNIFICANT:
            place = position
            first = result
        places.append((place, result))
    return places


def _errors(
    data: Path, pairs: Sequence[Pair], answers: Mapping[Pair, StoredPose]
) -> Float[np.ndarray, " n"]:
    """Compute the error of each pair's rotation in degrees; 180 without an answer."""
    errors = np.full(len(pairs), 180.0)
    if answers:
        views = [pair.target_frames.index(pose.target_frame) for pair, pose in answers.items()]
        truths = true_poses(data, list(answers), np.array(views))
        rotations = np.stack([pose.rotation for pose in answers.values()])
        answered = [pair in answers for pair in pairs]
        errors[answered] = rotation_error(rotations, truths[:, :3, :3])
    return errors


def _write(ranking: Ranking, out: Path) -> None:
    """Write a ranking as a table and as a page for the projector."""
    table = pd.DataFrame([{"place": place, **vars(result)} for place, result in ranking.places])
    text = table.drop(columns="errors").to_csv(index=False, lineterminator="\n")
    write_atomic(out / "ranking.csv", text.encode())
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    page = environment.from_string(_PAGE.read_text("utf-8"))
    write_atomic(out / "ranking.html", page.render(vars(ranking)).encode())
