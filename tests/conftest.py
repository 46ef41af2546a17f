"""Fixtures that several files use. In each file of tests the library's annotations are checked in
the first calls of each function, shapes by jaxtyping and types by beartype."""

import contextlib
import os
import subprocess
import sys
from pathlib import Path

import jaxtyping
import pytest
import typechecking
from hypothesis import settings
from jaxtyping import config, install_import_hook

os.environ.setdefault("MPLBACKEND", "Agg")  # without windows

# No time limit per example, because it depends on the load of the machine.
settings.register_profile("no deadline", deadline=None)
settings.load_profile("no deadline")

# The hook must precede the first import of zsp_lite. `make check` leaves it out, to be quick.
if os.environ.get("ZSP_LITE_CHECK_ANNOTATIONS") != "0":
    install_import_hook("zsp_lite", "typechecking.typechecker")
    jaxtyping.jaxtyped = typechecking.first_calls

from zsp_lite.errors import FatalError, InputError  # noqa: E402

_raises = pytest.raises


@pytest.fixture(scope="module", autouse=True)
def first_calls():
    """Check the first calls of each file."""
    typechecking.calls.clear()


@contextlib.contextmanager
def raises(expected, **options):
    """`pytest.raises`, but inside `raises(InputError)` and `raises(FatalError)` annotations are not
    checked.

    Bad input violates the annotations as well, but the tests are about the error of the library.
    """
    before = config.jaxtyping_disable
    config.update("jaxtyping_disable", before or expected in (InputError, FatalError))
    try:
        with _raises(expected, **options) as caught:
            yield caught
    finally:
        config.update("jaxtyping_disable", before)


pytest.raises = raises

# Fixtures import what they need, so that only the tests that use them load it.


@pytest.fixture
def links(tmp_path_factory):
    """Skips the test where this user may not make symbolic links, as on Windows without its
    developer mode."""
    try:
        (tmp_path_factory.mktemp("links") / "link").symlink_to("nowhere")
    except OSError as error:
        pytest.skip(f"no symbolic links here: {error}")


@pytest.fixture
def run(capsys):
    """A function that runs a command line, checks its exit code, and returns what it printed.

    No word of the line has spaces. What was printed to stderr is included for codes above 1.
    """
    from zsp_lite.cli.main import main

    def run_command(line: str, code: int = 0) -> str:
        assert main(line.split()) == code
        out, error = capsys.readouterr()
        return out + error if code > 1 else out

    return run_command


@pytest.fixture
def closed_figures():
    """Closes the figures of a test at its end."""
    import matplotlib.pyplot as plt

    yield
    plt.close("all")


@pytest.fixture(scope="session")
def ellipsoids(tmp_path_factory):
    """A labelled data set with the category "ellipsoid": two sequences of seven views of one
    object.

    The world of sequence "b" differs from that of "a", the reference of the labels, by a rigid
    transform.
    """
    import numpy as np
    from synthetic_views import look_at, render

    from zsp_lite.alignment import Sim3
    from zsp_lite.data.co3d import Co3D
    from zsp_lite.data.labels import PoseLabel
    from zsp_lite.data.writing import SequenceData, write_co3d, write_label

    root = tmp_path_factory.mktemp("co3d")
    turn = look_at((0.3, -1.0, 0.4)).R  # some rotation
    placements = {"a": Sim3.identity(), "b": Sim3(1.0, turn, np.array([0.1, -0.2, 0.1]))}
    points = np.random.default_rng(0).normal(size=(50, 3))  # not on the object's surface
    colours = np.full((50, 3), 128, np.uint8)
    cameras = [look_at((np.cos(a), np.sin(a), 0.3)) for a in 2 * np.pi / 7 * np.arange(7)]
    sequences = []
    for name, placement in placements.items():
        frames = [render(camera, placement) for camera in cameras]
        cloud = placement.apply(points)
        # Scores above the bounds of `Co3D.select`.
        scores = {"viewpoint_quality": 2.0, "point_cloud_quality": 1.0}
        sequences.append(SequenceData(name, frames, range(7), cloud, colours, **scores))
        write_label(root, "ellipsoid", PoseLabel(placement.matrix, name, "a"))
    write_co3d(root, "ellipsoid", sequences, quality=98)
    return Co3D(root)


@pytest.fixture(scope="session")
def frames():
    """A reference frame and five target frames of the object of `synthetic_views`."""
    from synthetic_views import reference_and_targets

    return reference_and_targets(5)


@pytest.fixture
def loaded(monkeypatch):
    """A list of what commands ask `load_backbone` for; they get a backbone without weights."""
    from synthetic_views import CoordinateBackbone

    asked = []
    monkeypatch.setattr(
        "zsp_lite.backbones.named.load_backbone",
        lambda name: asked.append(name) or CoordinateBackbone(),
    )
    # A name for reports, as every loaded backbone has one.
    monkeypatch.setattr(CoordinateBackbone, "name", "coordinates", raising=False)
    return asked


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """Folder with the built course site.

    A warning of Sphinx, such as an unknown link in a source, is an error.
    """
    folder = tmp_path_factory.mktemp("site")
    options = [*"-q -W --keep-going -c docs/site -d".split(), folder / "doctrees"]
    command = [sys.executable, "-m", "sphinx", *options, ".", folder / "html"]
    result = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True)
    assert result.returncode == 0, f"warnings of Sphinx:\n{result.stderr}"
    return folder / "html"
