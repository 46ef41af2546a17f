"""The class challenge: what is given away, what a hand-in can see, and who wins."""

import gzip
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from zsp_lite.course.challenge.answer import read_questions
from zsp_lite.course.challenge.make import copy_for_pairs, make_challenge
from zsp_lite.course.challenge.rank import rank
from zsp_lite.data.evaluation import true_poses
from zsp_lite.errors import InputError
from zsp_lite.io.files import REPOSITORY, read_json

SECRET = "an owl counts seventeen boats"
PAIRS = 6

STARTER = "starter.py"
LOOPS = "def method(similarity, foreground1, foreground2):\n    while True:\n        pass\n"
CRASHES = "import os\nos._exit(3)\n"
FAILS = "def backbone(images):\n    raise ValueError('no network')\n"
SHUTS = "import os\nopen('poses.csv', 'w')\nos.chmod('.', 0)\nraise SystemExit\n"
# Writes what an honest hand-in may write, and answers by the library.
HONEST = """
import multiprocessing
import tempfile
from pathlib import Path

Path("mine.txt").write_text("mine")
with tempfile.NamedTemporaryFile("w") as file:
    file.write("mine")
multiprocessing.Lock()
backbone = "zsp-tiny"
"""
# Looks for files of others and a network, and writes beside these files.
CHEATS = """
import socket
from pathlib import Path

found = [path for path in {paths!r} + [{left!r}] if Path(path).exists()]
for path in {paths!r}:
    try:
        Path(path).with_name("cheated").write_text("")
    except OSError:
        pass
try:
    socket.create_connection(("127.0.0.1", {port}), timeout=5)
    found.append("a network")
except OSError:
    pass
Path("poses.csv").symlink_to({paths!r}[0])
print("found", *(found or ["nothing"]))
raise SystemExit
"""
# Opens a pipe whose other end tells when the process has ended.
WAITS = "import os, time\nos.mkfifo('pipe')\nopen('pipe', 'w').write(str(time.sleep(60)))\n"


@pytest.fixture(scope="module")
def challenge(tmp_path_factory):
    """A challenge of two objects."""
    folder = tmp_path_factory.mktemp("challenge") / "made"
    make_challenge(SECRET, ["toytruck"], folder, sequences=2, frames=6, pairs=PAIRS)
    return folder


@pytest.fixture
def handins(tmp_path):
    """An empty folder of hand-ins."""
    folder = tmp_path / "handins"
    folder.mkdir()
    return folder


def write_answers(challenge, path, turn=np.eye(3)):
    """Write the true poses, each followed by a turn."""
    kept = challenge / "keep/data"
    pairs = read_questions(challenge / "keep/pairs.csv")
    truths = true_poses(kept, pairs, np.zeros(len(pairs), int))[:, :3, :3]
    poses = {
        "pair": [pair.key for pair in pairs],
        "target_frame": [pair.target_frames[0] for pair in pairs],
        "rotation": [" ".join(map(str, (truth @ turn).ravel())) for truth in truths],
    }
    pd.DataFrame(poses).to_csv(path, index=False)


def test_what_is_given_leads_neither_to_the_secret_nor_to_labels(challenge):
    seed = read_json(challenge / "keep/data/synthetic.json", dict[str, int], "settings")["seed"]
    given = [path for path in (challenge / "give").rglob("*") if path.is_file()]
    assert {path.suffix for path in given} == {".jgz", ".jpg", ".png", ".csv", ".md", ".py"}
    kept = {path.name for path in (challenge / "keep").rglob("*.json")}
    assert kept >= {"synthetic.json", "object_poses.json"}
    for path in given:
        assert path.stat().st_mtime == 946_684_800  # for all files, the beginning of 2000
        content = path.read_bytes()
        if path.suffix == ".jgz":
            assert content[4:8] == bytes(4)  # the time in gzip's header
            content = gzip.decompress(content)
        assert SECRET.encode() not in content
        assert str(seed).encode() not in content
        assert b"Exif" not in content
        assert b"tEXt" not in content
    # The objects are numbered: names like CO3D's would give 26 bits of each object's key.
    assert {name for path in given for name in path.parts if name.startswith("1")} == {"100", "101"}


def test_only_the_frames_of_pairs_are_copied(challenge, tmp_path):
    pair = read_questions(challenge / "keep/pairs.csv")[0]
    copy_for_pairs(challenge / "keep/data", [pair], tmp_path)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    # Two annotations; image, depth and two masks of a reference and five target views.
    assert len(files) == 2 + 6 * 4


def test_another_secret_gives_other_objects(challenge, tmp_path, caplog):
    make_challenge(SECRET + ".", ["toytruck"], tmp_path / "other", sequences=2, frames=5, pairs=1)
    images = [
        sorted(folder.glob("give/data/toytruck/100/images/*.jpg"))[0].read_bytes()
        for folder in (challenge, tmp_path / "other")
    ]
    assert images[0] != images[1]
    assert "1 pairs tell few teams apart" in caplog.text


@pytest.mark.slow
def test_a_ranking_of_hand_ins_that_answer_loop_and_crash(challenge, handins):
    write_answers(challenge, handins / "right.csv")
    write_answers(challenge, handins / "turned.csv", np.diag([-1.0, -1.0, 1.0]))
    (handins / STARTER).write_bytes((challenge / "give" / STARTER).read_bytes())
    (handins / "loops.py").write_text(LOOPS)
    (handins / "crashes.py").write_text(CRASHES)
    (handins / "fails.py").write_text(FAILS)
    (handins / "shuts.py").write_text(SHUTS)
    (handins / "._fails.py").write_bytes(b"of macOS")
    (handins / "folder.py").mkdir()
    out = handins / "out"  # in a folder that is hidden as well
    ranking = rank(handins, challenge / "keep", out, pair_seconds=3, unprotected=True)
    found = {one.team: one for _, one in ranking.places}
    assert ranking.places[0][1].team == "right"
    assert (found["right"].acc30, found["turned"].acc30) == (100, 0)
    assert found["starter"].answered > 0
    assert "takes more than 3 s" in found["loops"].note
    assert "exit status 3" in found["crashes"].note
    assert found["fails"].note.endswith("ValueError: no network")
    assert found["shuts"].answered == 0
    assert "._fails" not in found
    page = (out / "ranking.html").read_text("utf-8")
    assert page.index("right") < page.index("turned")


@pytest.mark.slow
def test_a_hand_in_finds_and_changes_nothing_but_its_folder(
    challenge, handins, tmp_path, monkeypatch
):
    write_answers(challenge, handins / "right.csv")
    (handins / "honest.py").write_text(HONEST)
    monkeypatch.setenv("HOME", str(REPOSITORY))
    with (
        tempfile.TemporaryDirectory(prefix="challenge-") as left,  # by a ranking that was killed
        socket.create_server(("127.0.0.1", 0)) as server,
    ):
        # Files of others, and folders of others in which no file "none" exists.
        paths = [f"{handins}/right.csv", f"{challenge}/keep/pairs.csv", left + "/none", "/dev/tty"]
        paths += [f"{REPOSITORY}/environment.txt", f"{REPOSITORY}/zsp_lite/none"]
        paths += [sys.prefix + "/none", "/dev/shm/none", "/var/tmp/none"]
        port = server.getsockname()[1]
        (handins / "cheats.py").write_text(CHEATS.format(paths=paths, left=left, port=port))
        try:
            ranking = rank(handins, challenge / "keep", tmp_path / "out")
        except InputError as error:
            pytest.skip(str(error))
        assert not [path for path in paths if Path(path).with_name("cheated").exists()]
    answered = {one.team: one.answered for _, one in ranking.places}
    assert answered == {"right": PAIRS, "honest": PAIRS, "cheats": 0}
    assert "found nothing" in (tmp_path / "out/ranking.html").read_text("utf-8")


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="signals of Unix")
# Without a PATH, the programs that make namespaces are not found.
@pytest.mark.parametrize(("name", "path"), [("SIGTERM", os.environ["PATH"]), ("SIGHUP", "")])
def test_a_ranking_that_is_ended_leaves_no_hand_in(challenge, tmp_path, name, path):
    (tmp_path / "team.py").write_text(WAITS)
    runs = tmp_path / "runs"
    runs.mkdir()
    words = f"challenge rank {tmp_path} --keep {challenge}/keep --out {tmp_path}/out --unprotected"
    with subprocess.Popen(
        [sys.executable, "-m", "zsp_lite", *words.split()],
        env=os.environ | {"PATH": path, "TMPDIR": str(runs)},
    ) as process:
        while not (pipes := list(runs.glob("*/team/*/pipe"))):
            assert process.poll() is None
            time.sleep(0.05)
        with pipes[0].open() as pipe:
            process.send_signal(getattr(signal, name))
            assert pipe.read() == ""  # at the end of the hand-in, which writes only after a minute
    assert process.returncode == 130
    assert not list(runs.iterdir())


def test_hand_ins_that_cannot_be_kept_apart_are_refused(challenge, tmp_path, monkeypatch, run):
    monkeypatch.setenv("PATH", "")  # the programs that make namespaces are not found
    (tmp_path / "team.py").write_text(CRASHES)
    words = f"challenge rank {tmp_path} --keep {challenge}/keep --out {tmp_path}/out"
    assert "--unprotected runs them" in run(words, code=2)


def test_teams_whose_difference_is_chance_share_a_place_and_wrong_files_answer_nothing(
    challenge, handins, tmp_path
):
    write_answers(challenge, handins / "first.csv")
    lines = (handins / "first.csv").read_text().splitlines()
    (handins / "one_less.csv").write_text("\n".join(lines[:-1]))
    (handins / "odd.csv").write_text("hello")
    other = [line.replace("toytruck/", "car/") for line in lines]
    (handins / "other.csv").write_text("\n".join(other))
    places = rank(handins, challenge / "keep", tmp_path / "out").places
    found = {one.team: (place, one.answered) for place, one in places}
    assert found == {
        "first": (1, PAIRS),
        "one_less": (1, PAIRS - 1),
        "odd": (3, 0),
        "other": (3, 0),
    }
    notes = {one.team: one.note for _, one in places}
    assert "poses odd.csv: no or two columns" in notes["odd"]
    told = f"{PAIRS} of {PAIRS} poses are of no pair and frame of pairs.csv"
    assert notes["other"] == told


def test_the_folder_that_is_given_has_no_labels_to_rank_by(challenge, tmp_path):
    with pytest.raises(InputError, match="expected the folder keep/"):
        rank(tmp_path, challenge / "give", tmp_path / "out")
