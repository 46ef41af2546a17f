"""Rank hand-ins of a challenge: each runs in a process of its own, which sees no labels."""

import os
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
from jaxtyping import Float
from jinja2 import Environment, StrictUndefined
from tqdm import tqdm

from zsp_lite.benchmark.statistics import figures_of, object_draws, paired_difference
from zsp_lite.course.challenge.answer import COLUMNS, read_questions
from zsp_lite.course.challenge.make import QUESTIONS_FILE, copy_without_labels
from zsp_lite.data.co3d import Pair
from zsp_lite.data.exchange import StoredPose, read_stored_poses
from zsp_lite.data.pairs import true_poses
from zsp_lite.errors import InputError
from zsp_lite.io.download import cache_folder
from zsp_lite.io.files import write_atomic
from zsp_lite.metrics import rotation_error

_SIGNIFICANT = 0.05  # a difference with a smaller p value is not left to chance
_LONGEST_NOTE = 200  # characters
_LAST_PRINTED = 10_000  # bytes that are read of what a hand-in printed
_PAGE = Path(__file__).with_name("ranking.html")
# Variables of the environment that a hand-in gets; the folder that it finds weights in is added.
_PASSED = ("PATH", "PYTHONPATH", "SYSTEMROOT", "LANG", "TMPDIR")


@dataclass(frozen=True)
class Standing:
    """A line of the ranking."""

    place: int  # shared by teams whose difference to the first of them may be chance
    team: str
    acc30: float  # percent
    low: float  # ends of the 95 % interval, by bootstrap over objects
    high: float
    answered: int  # pairs with a pose
    pairs: int
    note: str  # why pairs have none; "" if all have


@dataclass(frozen=True)
class Ranking:
    """What a ranking page shows."""

    standings: list[Standing]
    categories: list[str]
    alone: bool  # hand-ins found neither labels nor each other; False where the system cannot


@dataclass(frozen=True)
class Limits:
    """Limits of a hand-in."""

    minutes: float
    pair_seconds: int
    memory: float  # gigabytes


def rank(
    handins: str | Path,
    keep: str | Path,
    out: str | Path,
    workers: int = 2,
    minutes: float = 10,
    pair_seconds: int = 20,
    memory: float = 4,
) -> Ranking:
    """Run and rank the hand-ins of a folder, and write OUT/ranking.csv and OUT/ranking.html.

    On Linux a hand-in finds neither labels nor other hand-ins nor a network, where users may make
    namespaces.

    Args:
        handins: Folder with a file TEAM.py or TEAM.csv of each team.
        keep: Folder that `make_challenge` wrote.
        out: Folder to write.
        workers: Hand-ins that run at the same time.
        minutes: Time limit of a hand-in.
        pair_seconds: Time limit of a hand-in for a pair.
        memory: Limit of its memory in gigabytes, on Linux.

    Raises:
        InputError: `keep` holds no challenge, or `handins` no hand-in, or two of one team; or one
            of both folders holds this program.
    """
    handins = Path(handins)
    keep = Path(keep)
    out = Path(out)
    pairs = read_questions(keep / QUESTIONS_FILE)
    # Not the hidden files that macOS adds to archives.
    files = sorted(path for path in handins.glob("[!.]*") if path.suffix in (".py", ".csv"))
    teams = {path.stem: path for path in files}
    if not files or len(teams) < len(files):
        raise InputError(
            f"{handins} has {len(files)} hand-ins of {len(teams)} teams, expected one of each, "
            "TEAM.py or TEAM.csv"
        )
    poses = out / "poses"
    poses.mkdir(parents=True, exist_ok=True)
    hidden = _folders_to_hide(keep, handins, poses)
    limits = Limits(minutes, pair_seconds, memory)
    with TemporaryDirectory(prefix="challenge-") as runs:
        probe = Path(runs, "probe")
        probe.mkdir()
        alone = _works([*_hiding(hidden, probe), "true"])

        def run(team: str) -> str:
            source, target = teams[team], poses / f"{team}.csv"
            if source.suffix == ".csv":
                shutil.copyfile(source, target)
                return ""
            # Each has a copy of the data, as it may write there.
            folder = Path(runs, "team", team)
            copy_without_labels(keep / "data", folder / "data")
            shutil.copy(keep / QUESTIONS_FILE, folder)
            before = _hiding(hidden, folder) if alone else []
            return _run_alone(before, source, folder, target, limits)

        with ThreadPoolExecutor(workers) as pool:
            done = tqdm(pool.map(run, teams), "hand-ins", len(teams), disable=None)
            notes = dict(zip(teams, done, strict=True))

    standings = _standings(keep / "data", pairs, poses, notes)
    ranking = Ranking(standings, sorted({pair.category for pair in pairs}), alone)
    _write(ranking, out)
    return ranking


def _folders_to_hide(*folders: Path) -> list[Path]:
    """Return the folders that lie in no other one; InputError if one holds this program."""
    folders = {folder.resolve() for folder in folders}
    for program in (Path(sys.prefix), Path(__file__).resolve()):
        for folder in folders.intersection(program.parents):
            raise InputError(
                f"folder {folder} holds this program, expected one for the challenge alone"
            )
    return [folder for folder in folders if not folders.intersection(folder.parents)]


def _run_alone(
    before: Sequence[str], source: Path, folder: Path, target: Path, limits: Limits
) -> str:
    """Run a hand-in in a folder that has the data; return the last line that it printed, or why it
    ended."""
    alone = Path(shutil.copy(source, folder))
    found = folder / "poses.csv"
    numbers = [str(limits.pair_seconds), str(int(limits.memory * 1e9))]
    words = [alone.name, "data", QUESTIONS_FILE, found.name, *numbers]
    # Without the folder in the search path, where `torch.py` of a team `torch` would be found.
    command = [sys.executable, "-P", "-m", "zsp_lite.course.challenge.answer", *words]
    environment = {name: os.environ[name] for name in _PASSED if name in os.environ}
    environment |= {"HOME": ".", "USERPROFILE": ".", "OMP_NUM_THREADS": "1"}
    environment["ZSP_LITE_CACHE"] = str(cache_folder())
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
        try:
            code = process.wait(timeout=60 * limits.minutes)
            problem = f"ended abruptly, exit status {code}" if code else ""
        except subprocess.TimeoutExpired:
            problem = f"ended after {limits.minutes:g} minutes"
        finally:
            _end(process)
        printed.seek(max(0, printed.seek(0, os.SEEK_END) - _LAST_PRINTED))
        text = printed.read().decode(errors="replace")
    if found.is_file() and not found.is_symlink():  # a link may lead to another team's poses
        shutil.copyfile(found, target)
    else:
        target.write_text(",".join(COLUMNS) + "\n")
    # Where it is hidden, its folder has the name of the one above.
    for path in (folder, folder.parent):
        text = text.replace(f"{path}{os.sep}", "")
    last = text.strip().splitlines()[-1:]
    return "; ".join([*filter(None, [problem]), *last])[:_LONGEST_NOTE]


def _hiding(folders: Sequence[Path], own: Path) -> list[str]:
    """Return the words before a command that hide folders, what lies beside its own folder, and the
    network from it.

    `own` takes the place of the folder of all runs.
    """
    runs = shlex.quote(str(own.parent))
    steps = [f"mount -t tmpfs none {shlex.quote(str(folder))}" for folder in folders]
    steps += [f"mount --bind {shlex.quote(str(own))} {runs}", f"cd {runs}"]
    # In a second namespace of users the command has no right to unmount what the first mounted.
    steps.append('exec unshare --map-root-user --mount "$@"')
    # A namespace of processes ends all of them with the first.
    first = ["unshare", "--map-root-user", "--mount", "--net", "--pid", "--fork", "--kill-child"]
    return [*first, "--mount-proc", "sh", "-c", " && ".join(steps), "sh"]


def _works(command: Sequence[str]) -> bool:
    """Return whether this system runs a command without an error."""
    with suppress(FileNotFoundError):
        return subprocess.run(command, capture_output=True).returncode == 0
    return False


def _end(process: subprocess.Popen) -> None:
    """End a process and all of its group."""
    with suppress(ProcessLookupError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
    process.wait()


def _standings(
    data: Path, pairs: Sequence[Pair], poses: Path, notes: Mapping[str, str]
) -> list[Standing]:
    """Sort the teams by Acc30, and join those whose difference may be chance."""
    objects = [
        [f"{pair.category}/{name}" for name in (pair.reference_sequence, pair.target_sequence)]
        for pair in pairs
    ]
    drawn = object_draws(objects, [pair.category for pair in pairs])
    errors = {}
    answered = {}
    problems = {}
    for team, note in notes.items():
        try:
            stored, _ = read_stored_poses(poses / f"{team}.csv")
        except InputError as error:
            stored = {}
            note = note or str(error)
        # In the order of the pairs; an answer for a frame that was not asked for is none.
        answers = {
            pair: stored[pair.key]
            for pair in pairs
            if pair.key in stored and stored[pair.key].target_frame in pair.target_frames
        }
        errors[team] = _errors(data, pairs, answers)
        answered[team] = len(answers)
        problems[team] = note if len(answers) < len(pairs) else ""
    figures = {team: figures_of(error, drawn) for team, error in errors.items()}

    standings = []
    first = ""  # of the teams that share a place
    for position, team in enumerate(sorted(figures, key=lambda team: -figures[team]["acc30"]), 1):
        if first:
            gain = paired_difference(errors[team], errors[first], weights=drawn)
        if not first or gain["accuracy_gain_p"] < _SIGNIFICANT:
            first = team
            place = position
        low, high = figures[team]["acc30_ci"]
        standings.append(
            Standing(
                place,
                team,
                figures[team]["acc30"],
                low,
                high,
                answered[team],
                len(pairs),
                problems[team],
            )
        )
    return standings


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
    table = pd.DataFrame([asdict(standing) for standing in ranking.standings])
    write_atomic(out / "ranking.csv", table.to_csv(index=False, lineterminator="\n").encode())
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    page = environment.from_string(_PAGE.read_text("utf-8"))
    write_atomic(out / "ranking.html", page.render(asdict(ranking)).encode())
