"""The class challenge: what is given away, what a hand-in can see, and who wins."""

import gzip
import socket

import numpy as np
import pandas as pd
import pytest

from zsp_lite.course.challenge.answer import read_questions
from zsp_lite.course.challenge.make import make_challenge
from zsp_lite.course.challenge.rank import rank
from zsp_lite.data.pairs import true_poses
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_json

SECRET = "an owl counts seventeen boats"
PAIRS = 6

STARTER = "starter.py"
LOOPS = "def method(similarity, foreground1, foreground2):\n    while True:\n        pass\n"
CRASHES = "import os\nos._exit(3)\n"
FAILS = "def backbone(images):\n    raise ValueError('no network')\n"
SHUTS = "import os\nopen('poses.csv', 'w')\nos.chmod('.', 0)\nraise SystemExit\n"
# Looks for labels and other hand-ins beside it and in the lecturer's folders, and for a network.
CHEATS = """
import socket
from pathlib import Path

found = []
for folder in (*Path.cwd().parent.glob("challenge-*"), Path({keep!r}), Path({handins!r})):
    for path in folder.rglob("*"):
        if path.name in ("object_poses.json", "crashes.py") or "class_labels" in path.parts:
            found.append(path.name)
try:
    socket.create_connection(("127.0.0.1", {port}), timeout=5)
    found.append("a network")
except OSError:
    pass
Path("poses.csv").symlink_to({handins!r} + "/right.csv")
print("found", *(found or ["nothing"]))
raise SystemExit
"""


@pytest.fixture(scope="module")
def challenge(tmp_path_factory):
    """A challenge of two objects."""
    folder = tmp_path_factory.mktemp("challenge") / "made"
    make_challenge(SECRET, ["toytruck"], folder, sequences=2, frames=6, pairs=PAIRS)
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
    assert {path.suffix for path in given} == {".jgz", ".jpg", ".png", ".ply", ".csv", ".md", ".py"}
    kept = {path.name for path in (challenge / "keep").rglob("*.json")}
    assert kept >= {"synthetic.json", "object_poses.json"}
    for path in given:
        content = path.read_bytes()
        if path.suffix == ".jgz":
            assert content[4:8] == bytes(4)  # the time in gzip's header
            content = gzip.decompress(content)
        assert SECRET.encode() not in content
        assert str(seed).encode() not in content
        assert b"Exif" not in content
        assert b"tEXt" not in content
    # Names like CO3D's would give 26 bits of each object's key.
    assert {name for path in given for name in path.parts if name.startswith("1")} == {"100", "101"}


def test_all_files_that_are_given_have_one_time(challenge):
    times = {path.stat().st_mtime for path in (challenge / "give").rglob("*")}
    assert times == {946_684_800}


def test_another_secret_gives_other_objects(challenge, tmp_path):
    make_challenge(SECRET + ".", ["toytruck"], tmp_path / "other", sequences=2, frames=5, pairs=1)
    images = [
        sorted(folder.glob("give/data/toytruck/100/images/*.jpg"))[0].read_bytes()
        for folder in (challenge, tmp_path / "other")
    ]
    assert images[0] != images[1]


@pytest.mark.slow
def test_a_ranking_of_hand_ins_that_answer_loop_crash_and_cheat(challenge, tmp_path):
    handins = tmp_path / "handins"
    handins.mkdir()
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
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        cheats = CHEATS.format(keep=str(challenge / "keep"), handins=str(handins), port=port)
        (handins / "cheats.py").write_text(cheats)
        ranking = rank(handins, challenge / "keep", out, pair_seconds=3)
    found = {one.team: one for _, one in ranking.places}
    assert ranking.places[0][1].team == "right"
    assert (found["right"].acc30, found["turned"].acc30) == (100, 0)
    assert found["starter"].answered > 0
    assert "takes more than 3 s" in found["loops"].note
    assert "exit status 3" in found["crashes"].note
    assert found["fails"].note.endswith("ValueError: no network")
    assert found["cheats"].answered == 0
    assert found["shuts"].answered == 0
    assert "._fails" not in found
    if ranking.alone:
        assert found["cheats"].note.endswith("found nothing")
    page = (out / "ranking.html").read_text("utf-8")
    assert page.index("right") < page.index("turned")


def test_teams_whose_difference_is_chance_share_a_place(challenge, tmp_path):
    handins = tmp_path / "handins"
    handins.mkdir()
    write_answers(challenge, handins / "first.csv")
    lines = (handins / "first.csv").read_text().splitlines()
    (handins / "one_less.csv").write_text("\n".join(lines[:-1]))
    (handins / "none.csv").write_text(lines[0])
    places = rank(handins, challenge / "keep", tmp_path / "out").places
    assert [(place, one.team) for place, one in places] == [
        (1, "first"),
        (1, "one_less"),
        (3, "none"),
    ]
    assert [one.answered for _, one in places] == [PAIRS, PAIRS - 1, 0]


def test_a_file_that_is_no_table_counts_as_no_answer(challenge, tmp_path):
    handins = tmp_path / "handins"
    handins.mkdir()
    (handins / "odd.csv").write_text("hello")
    ((_, one),) = rank(handins, challenge / "keep", tmp_path / "out").places
    assert one.answered == 0
    assert "poses odd.csv: no or two columns" in one.note


def test_poses_that_were_not_asked_for_are_counted(challenge, tmp_path):
    handins = tmp_path / "handins"
    handins.mkdir()
    write_answers(challenge, handins / "other.csv")
    text = (handins / "other.csv").read_text()
    (handins / "other.csv").write_text(text.replace("toytruck/", "car/"))
    ((_, one),) = rank(handins, challenge / "keep", tmp_path / "out").places
    assert one.note == f"{PAIRS} of {PAIRS} poses are of no pair and frame of pairs.csv"


def test_the_folder_that_is_given_has_no_labels_to_rank_by(challenge, tmp_path):
    with pytest.raises(InputError, match="expected the folder keep/"):
        rank(tmp_path, challenge / "give", tmp_path / "out")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("make --categories car --out x", "no terminal to ask"),
        ("make --secret short --categories car --out x", "expected at least 8"),
        ("make --secret long_enough --categories cow --out x", "category"),
        ("rank nowhere --keep nowhere --out x", "nowhere has no labels"),
    ],
)
def test_bad_input_is_refused(words, message, tmp_path, monkeypatch, run):
    monkeypatch.chdir(tmp_path)
    printed = run(f"challenge {words}", code=2)
    assert message in printed
    assert printed.count("\n") == 1
    assert not (tmp_path / "x").exists()
