"""`data download`: small archives in CO3D's layout from a server on loopback, and everything that
can go wrong."""

import hashlib
import io
import json
import shutil
import stat
import zipfile
from pathlib import Path

import numpy as np
import pytest
from co3d_folders import contents, write_category, write_identities
from loopback import Server

from zsp_lite.data import archives
from zsp_lite.data.archives import list_archives
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.labels import read_labels
from zsp_lite.data.writing import write_published_pairs
from zsp_lite.io.locks import writing

SEQUENCES = ("100_1_1", "200_2_2")  # with labels
UNLABELLED = "300_3_3"
CHUNKS = ["/toaster_000.zip", "/toaster_001.zip"]


def zipped(folder: Path, *names: str) -> bytes:
    """A zip archive of the files and folders whose paths in `folder` begin with one of the
    names."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for path in sorted(folder.rglob("*")):
            if (name := path.relative_to(folder).as_posix()).startswith(names):
                archive.write(path, name)
    return data.getvalue()


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A labelled data folder of toasters with one evaluation pair, and a file that makes a long
    archive."""
    folder = tmp_path_factory.mktemp("source")
    write_category(folder, "toaster", (*SEQUENCES, UNLABELLED))
    (folder / "toaster" / UNLABELLED / "long").write_bytes(np.random.default_rng(0).bytes(1 << 20))
    write_identities(folder, "toaster", SEQUENCES)
    pair = Pair("toaster", SEQUENCES[0], 1, SEQUENCES[1], (2,))
    write_published_pairs(folder / "determ_eval/1samples_1tgt/toaster.pt", [pair], Co3D(folder))
    return folder


@pytest.fixture
def server(source, tmp_path, monkeypatch):
    """A mirror: two chunks of toasters, and an archive of v1."""
    first, second, third = (f"toaster/{name}" for name in (*SEQUENCES, UNLABELLED))
    files = {
        CHUNKS[0]: zipped(source, "toaster/frame_", "toaster/sequence_", first),
        CHUNKS[1]: zipped(source, second, third),
        "/toaster.zip": zipped(source, "toaster"),
    }
    server = Server(files)
    server.catalogue = tmp_path / "catalogue.json"
    monkeypatch.setattr(archives, "CATALOGUE", server.catalogue)
    monkeypatch.setenv("ZSP_LITE_CO3D_URL", server.url + "/")
    monkeypatch.setenv("ZSP_LITE_CO3D_V1_URL", server.url)
    monkeypatch.setenv("no_proxy", "*")  # the server is on this machine
    write_catalogue(server)
    yield server
    server.close()


def write_catalogue(server) -> None:
    """Write the catalogue with the digests of the server's archives."""
    *chunks, v1 = [hashlib.sha256(one).hexdigest() for one in server.files.values()]
    data_sets = {"co3d": chunks, "co3d-v1": [v1]}
    catalogue = {name: {"full": {"toaster": digests}} for name, digests in data_sets.items()}
    server.catalogue.write_text(json.dumps(catalogue))


@pytest.fixture
def download(run):
    """Downloads toasters by a command with an exit code; returns what it printed."""

    def command(root, *options, dataset="co3d", code=0) -> str:
        more = " ".join(options)
        return run(f"data download {dataset} --category toaster --root {root} {more} --yes", code)

    return command


def test_a_category_is_downloaded_verified_unpacked_and_checked(server, source, tmp_path, download):
    root = tmp_path / "co3d"
    text = download(root)
    assert all(
        part in text for part in ("toaster_001.zip", "0.00 GB", "CC BY-NC 4.0", "No problems")
    )
    assert contents(root / "toaster") == contents(source / "toaster")
    assert [*contents(root / ".download")] == ["unpacked.json"]  # the archives are removed
    requests = len(server.ranges)
    text = download(root)
    assert len(server.ranges) == requests
    assert "everything is unpacked already" in text


def test_the_official_list_has_the_archives_of_every_category():
    full, single = (list_archives("co3d", "toyplane", subset) for subset in (False, True))
    (old,) = list_archives("co3d-v1", "toyplane")
    assert (len(full), len(single)) == (4, 2)  # as published
    assert single[1].name == "toyplane_001_singlesequence.zip"
    assert full[0].url == "https://dl.fbaipublicfiles.com/co3dv2_231130/toyplane_000.zip"
    assert old.url == "https://dl.fbaipublicfiles.com/co3d/toyplane.zip"


def test_the_first_chunk_can_be_used_alone_and_completed_later(
    server, source, tmp_path, download, run
):
    root = tmp_path / "co3d"
    assert "2 of 3 annotated sequences are not downloaded" in download(root, "--chunks", "1")
    dataset = Co3D(root)
    assert dataset.load(dataset.frame("toaster", SEQUENCES[0], 0)).rgb.shape == (24, 32, 3)
    run(f"data check {root}", 1)  # without --partial, missing files are problems
    run(f"data check {root} --partial")
    download(root)
    assert contents(root / "toaster") == contents(source / "toaster")


def test_labelled_sequences_are_read_out_of_the_archive_on_the_server(
    server, source, tmp_path, download, monkeypatch
):
    monkeypatch.setattr(archives, "_PART", 4_096)  # bytes: one part would be the whole archive
    root = tmp_path / "v1"
    options = ("--labels", str(source), "--labelled-only")
    text = download(root, *options, dataset="co3d-v1")
    assert "2 labels, 1 files of pairs" in text
    assert list(read_labels(root, "toaster")) == list(SEQUENCES)
    assert "2 sequences of toaster.zip" in text
    assert "1 of 3 annotated sequences are not downloaded" in text
    expected = {
        name: data for name, data in contents(source / "toaster").items() if UNLABELLED not in name
    }
    assert contents(root / "toaster") == expected
    ends = [one.removeprefix("bytes=").split("-") for one in server.ranges]
    read = sum(int(last) - int(first) for first, last in ends)
    assert read < len(server.files["/toaster.zip"]) / 2
    requests = len(server.ranges)
    text = download(root, *options, dataset="co3d-v1")
    assert len(server.ranges) == requests
    assert "everything is unpacked already" in text
    download(root, dataset="co3d-v1")  # the rest
    assert contents(root / "toaster") == contents(source / "toaster")


def test_sequences_of_an_archive_need_a_server_that_sends_parts(server, source, tmp_path, download):
    options = ("--labels", str(source), "--labelled-only")
    server.knows_ranges = False
    assert "expected range requests" in download(
        tmp_path / "v1", *options, dataset="co3d-v1", code=2
    )
    server.knows_ranges = True
    server.break_after = 1_000  # every response is cut off, and read on
    download(tmp_path / "v1", *options, dataset="co3d-v1")


# No, yes, the end of the input, and no terminal.
@pytest.mark.parametrize("answer, code", [("\n", 1), ("Y\n", 0), ("", 130), (None, 2)])
def test_the_user_is_asked_on_a_terminal_or_has_said_yes(
    server, tmp_path, run, monkeypatch, answer, code
):
    monkeypatch.setattr("sys.stdin", io.StringIO(answer or ""))
    monkeypatch.setattr("sys.stdin.isatty", lambda: answer is not None)
    text = run(f"data download co3d --category toaster --root {tmp_path}/co3d", code)
    assert "toaster_001.zip" in text
    assert ("expected --yes" in text) == (code == 2)
    assert (tmp_path / "co3d").exists() == (server.ranges != []) == (code == 0)


def test_a_truncated_archive_is_completed_by_the_next_call_of_one_process(
    server, source, tmp_path, download
):
    server.break_after = 1_000
    # Each of three attempts gets 1,000 bytes.
    assert "at 3000 bytes; call again to resume" in download(tmp_path / "co3d", code=2)
    server.break_after = None
    with writing(tmp_path / "co3d/.download"):
        assert "another process is writing to it" in download(tmp_path / "co3d", code=2)
    download(tmp_path / "co3d")
    assert "bytes=3000-" in server.ranges
    assert contents(tmp_path / "co3d/toaster") == contents(source / "toaster")


def test_unpacking_that_was_killed_is_completed(server, source, tmp_path, monkeypatch, download):
    root = tmp_path / "co3d"
    read = zipfile.ZipFile.read
    written = []

    def stop_at_third(archive, member):
        if len(written) == 3:
            raise KeyboardInterrupt
        written.append(member.filename)
        return read(archive, member)

    monkeypatch.setattr(zipfile.ZipFile, "read", stop_at_third)
    download(root, dataset="co3d-v1", code=130)
    # Without annotations, which are unpacked last, there is no category.
    assert len(contents(root / "toaster")) == 3
    assert Co3D(root).categories() == []
    monkeypatch.setattr(zipfile.ZipFile, "read", read)
    download(root, dataset="co3d-v1")
    assert contents(root / "toaster") == contents(source / "toaster")
    assert len(server.ranges) == 1  # the archive that was there is not downloaded again


# The first leads out of the data folder, the second is not of the category and is left out, and the
# last lies inside. The check lists the files that the archive lacks: exit code 1.
@pytest.mark.parametrize(
    "name, code", [("toaster/../../outside", 2), ("../outside", 1), ("toaster//x", 1)]
)
def test_nothing_is_written_outside_the_folder_and_no_link_is_made(
    server, tmp_path, download, name, code
):
    data = io.BytesIO()
    member = zipfile.ZipInfo(name)
    member.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr(member, b"/etc/passwd")
    server.files[CHUNKS[1]] = data.getvalue()
    write_catalogue(server)
    text = download(tmp_path / "co3d", code=code)
    assert ("leads out of the data folder" in text) == (code == 2)
    assert {path.name for path in tmp_path.iterdir()} == {"co3d", "catalogue.json"}
    assert not any(path.is_symlink() for path in tmp_path.rglob("*"))


def test_a_link_in_the_folder_is_not_followed_out_of_it(server, tmp_path, download, links):
    (tmp_path / "co3d").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "co3d/toaster").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    text = download(tmp_path / "co3d", code=2)
    assert "leads out of the data folder" in text
    assert not contents(tmp_path / "elsewhere")


@pytest.mark.parametrize(
    "damage, listed, message",
    [
        (lambda whole: b"not a zip archive", True, "is damaged or encrypted"),
        (lambda whole: whole.replace(b"JFIF", b"XXXX"), True, "is damaged or encrypted"),
        (lambda whole: whole[:-1] + b"x", False, "is another file"),
    ],
)
def test_a_damaged_archive_or_one_with_another_digest_is_not_unpacked(
    server, tmp_path, download, damage, listed, message
):
    server.files[CHUNKS[1]] = damage(server.files[CHUNKS[1]])
    if listed:
        write_catalogue(server)
    assert message in download(tmp_path / "co3d", code=2)
    assert not list((tmp_path / "co3d").rglob("*.jgz"))  # without annotations there is no category


def test_a_disk_that_is_too_small_is_found_before_the_download(
    server, tmp_path, download, monkeypatch
):
    sizes = [len(server.files[name]) for name in CHUNKS]
    needed = sum(sizes) + max(sizes)  # both unpacked, and one archive
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr("shutil.disk_usage", lambda path: usage._replace(free=needed - 1))
    assert "GB free" in download(tmp_path / "co3d", code=2)
    assert server.ranges == []
    assert not (tmp_path / "co3d").exists()
    monkeypatch.setattr("shutil.disk_usage", lambda path: usage._replace(free=needed))
    download(tmp_path / "co3d")
