"""The package: public names, version, files, the wheel and its use without the repository, where
samples are made."""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest
import yaml
from refusals import refused

import zsp_lite
from zsp_lite.course import make_samples as making
from zsp_lite.course import samples

REPOSITORY = Path(__file__).parents[1]
FILES = ("pyproject.toml", "README.md", "LICENSE", "MANIFEST.in", "CHANGELOG.md", "CITATION.cff")
# Attributes of modules and classes that users and outside checks rely on, besides the package's own
# names.
PROMISED = """
    vit.VisionTransformer features.log_bin matching.similarity matching.cyclical_distances
    alignment.umeyama alignment.ransac metrics.rotation_error co3d.Co3D ZeroShotPose.estimate
""".split()


def test_every_promised_name_is_there_after_an_import_without_torch():
    names = [*PROMISED, *zsp_lite.__all__]
    code = (
        "import operator, sys, zsp_lite; assert 'torch' not in sys.modules and 'cv2' not in "
        "sys.modules"
    )
    code += f"\nfor name in {names}: operator.attrgetter(name)(zsp_lite)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_version_is_the_same_everywhere():
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    (latest, *_) = re.findall(r"^## (\S+)", (REPOSITORY / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert zsp_lite.__version__ == str(citation["version"]) == latest
    assert citation["preferred-citation"]["title"] in (REPOSITORY / "README.md").read_text()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from a copy of the repository."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    for folder in ("zsp_lite", "data_samples/class_labels", "notebooks/results"):
        shutil.copytree(
            REPOSITORY / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__")
        )
    for name in FILES:
        shutil.copy(REPOSITORY / name, source)
    code = f"from setuptools import build_meta as b; b.build_wheel({str(out)!r})"
    subprocess.run([sys.executable, "-c", code], cwd=source, check=True, capture_output=True)
    (path,) = out.glob("zsp_lite-*.whl")
    return path


def test_the_wheel_has_the_package_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        metadata = next(name for name in names if name.endswith(".dist-info/METADATA"))
        fields = Parser().parsestr(archive.read(metadata).decode())
    assert {name.split("/")[0] for name in names} == {"zsp_lite", metadata.split("/")[0]}
    files = [
        path
        for path in (REPOSITORY / "zsp_lite").rglob("*")
        if path.is_file() and path.suffix != ".pyc"
    ]
    assert {path.relative_to(REPOSITORY).as_posix() for path in files} <= set(names)
    assert fields["Name"] == "zsp-lite"
    assert fields["License-Expression"] == "MIT"
    assert wheel.stat().st_size < 14e6  # bytes, of which the network may have 12e6


@pytest.mark.slow
def test_the_wheel_makes_its_samples_in_an_empty_folder(wheel, tmp_path):
    """The demo and README's first example, with nothing of the repository on the path; only the
    demo makes samples."""
    site, empty, cache = (tmp_path / name for name in ("site", "empty", "cache"))
    empty.mkdir()
    install = [sys.executable, *"-m pip install --quiet --no-deps --no-index --no-compile".split()]
    subprocess.run([*install, "--target", str(site), str(wheel)], check=True)
    readme = (REPOSITORY / "README.md").read_text("utf-8")
    (example, *_) = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)
    # The demo with few and small samples, then the example.
    code = (
        f"import zsp_lite; assert zsp_lite.__file__.startswith({str(site)!r})\n"
        "from dataclasses import replace; from zsp_lite.course.synthetic.export import PRESETS\n"
        "PRESETS['demo'] = replace(PRESETS['demo'], categories=('motorcycle',), frames=6, "
        "image_size=96)\n"
        "from zsp_lite.cli.main import main\n"
        "assert main(['demo', '--backbone', 'zsp-tiny']) == 0\n"
        f"{example}\nassert len(targets) == 5\n"
    )
    environment = os.environ | {
        "PYTHONPATH": str(site),
        "ZSP_LITE_CACHE": str(cache),
        "OMP_NUM_THREADS": "1",
    }
    environment.pop("ZSP_LITE_DATA", None)
    run = subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=empty,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    assert run.stderr.count("making synthetic samples") == 1
    assert "Photographed motorcycle" in run.stdout
    assert (empty / "outputs/demo/report.html").is_file()
    assert [path.name for path in cache.iterdir()] == ["samples"]


def test_samples_are_made_in_the_cache_and_completed_after_an_interruption(tmp_path, monkeypatch):
    monkeypatch.setattr(samples, "REPOSITORY", tmp_path / "nowhere")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ZSP_LITE_CACHE", str(tmp_path / "cache"))
    calls = []

    # A renderer that is interrupted the first time. It writes down which files it finds.
    def export(preset, out):
        calls.append((preset, sorted(path.name for path in out.glob("made *"))))
        (out / f"made {len(calls)}").touch()
        if len(calls) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(making, "export_preset", export)
    refused("expected a clone of the repository, or `zsp-lite demo` once", samples.sample_data)
    with pytest.raises(KeyboardInterrupt):
        making.make_sample_data()
    made = tmp_path / "cache/samples"
    assert not made.exists()
    for _ in range(2):  # the second time they are there
        assert making.make_sample_data() == samples.sample_data() == made
        assert sorted(path.name for path in made.iterdir()) == ["made 1", "made 2"]
        assert calls == [("demo", []), ("demo", ["made 1"])]
    (tmp_path / "file").touch()
    monkeypatch.setenv("ZSP_LITE_CACHE", str(tmp_path / "file"))
    refused("set ZSP_LITE_CACHE to a folder that can be written", making.make_sample_data)
