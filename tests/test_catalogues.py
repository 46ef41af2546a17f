"""Catalogues of models: complete, consistent, built as they are listed; training, validation and evaluation have no
concept and no model file in common (`tools/concepts.csv`)."""

import csv
import hashlib
import json
import zipfile

import numpy as np
import pytest
from model_files import write_quad
from PIL import Image

from tools import same_shape
from tools.models import LICENCES, Catalogue, Entry, attribution, build, read_catalogue
from tools.same_shape import CATALOGUE, copy_same_shape
from tools.training_categories import TRAINING
from tools.validation_categories import VALIDATION
from zsp_lite.backbones.load import WEIGHTS
from zsp_lite.errors import InputError
from zsp_lite.samples import REPOSITORY
from zsp_lite.synthetic.categories import CATEGORIES
from zsp_lite.synthetic.meshes import list_models, read_mesh

TOOLS = REPOSITORY / "tools"
ARTISTS, SAMPLES = TOOLS / "artists.json", TOOLS / "samples.json"
TRAINED, CHOSEN_BY = TOOLS / "training.json", TOOLS / "validation.json"
CATALOGUES = {path.stem: read_catalogue(path).models for path in (ARTISTS, SAMPLES, TRAINED, CHOSEN_BY)}
ATTRIBUTION = WEIGHTS / "ATTRIBUTION.md"

# A world with one group, moved by 10 along x, of a square turned by a quarter about y; one polyline, one wrong count.
AC3D = """AC3Db
MATERIAL "red paint" rgb 1 0 0  amb 1 1 1  emis 0 0 0  spec 0.5 0.5 0.5  shi 10  trans 0.25
OBJECT world
kids 2
OBJECT group
name "gear"
loc 10 0 0
kids 1
OBJECT poly
name "square"
data 9
a comment
rot 0 0 -1 0 1 0 1 0 0
texture "maps\\paint.rgb"
texrep 2 1
numvert 4
-1 -1 0
1 -1 0

1 1 0
-1 1 0
numsurf 2
SURF 0x20
mat 0
refs 4
0 0 0
1 1 0
2 1 1
3 0 1
SURF 0x22
mat 0
refs 2
0 0 0
1 1 0
kids 0
"""


@pytest.fixture
def aircraft(tmp_path):
    path = tmp_path / "packages" / "sky" / "plane.ac"
    (path.parent / "liveries").mkdir(parents=True)
    path.write_text(AC3D)
    Image.fromarray(np.full((8, 8, 3), 200, np.uint8)).save(path.parent / "liveries" / "paint.rgb", format="SGI")
    return path


CC = {"CC0 1.0", "CC BY 3.0", "CC BY 3.0 US"}


@pytest.mark.parametrize(
    ("path", "categories", "count", "licences"),
    [
        (ARTISTS, 8, 59, CC | {"Public Domain Mark 1.0", "GPL-2+"}),
        (SAMPLES, 4, 16, CC),
        (TRAINED, 49, 320, LICENCES.keys() - {"Public Domain Mark 1.0"}),
        (CHOSEN_BY, 10, 28, LICENCES.keys() - {"Public Domain Mark 1.0"}),
    ],
)
def test_every_model_of_a_catalogue_has_a_free_licence_and_names_its_author(path, categories, count, licences):
    catalogue = read_catalogue(path)
    entries = [entry for models in catalogue.models.values() for entry in models.values()]
    assert len(catalogue.models) == categories and len(entries) == count
    assert len({entry.sha256 for entry in entries}) == count  # no file twice
    assert {entry.package for entry in entries} == set(catalogue.packages)
    assert {entry.licence for entry in entries} <= licences
    assert all(entry.author and entry.licence_file for entry in entries)
    links = sum(entry.licence in LICENCES for entry in entries)
    assert attribution(catalogue).count("https://creativecommons.org/") == links


def test_no_file_is_in_two_catalogues_and_the_sample_data_show_those_of_theirs():
    for name in (lambda entry: entry.sha256, lambda entry: entry.member or entry.file):
        files = [name(one) for models in CATALOGUES.values() for entries in models.values() for one in entries.values()]
        assert len(set(files)) == len(files)
    records = json.loads((REPOSITORY / "data_samples" / "rendered_models.json").read_text())
    shown = {record["sha256"] for models in records["sequences"].values() for record in models.values()}
    assert shown == {entry.sha256 for models in CATALOGUES["samples"].values() for entry in models.values()}


def test_models_of_one_shape_are_of_the_catalogue_of_their_side_and_copied_under_their_class(tmp_path, monkeypatch):
    listed = json.loads(CATALOGUE.read_text())
    assert listed.keys() == {"training", "validation"}
    for side in listed:
        known = {f"{category}/{name}" for category, entries in CATALOGUES[side].items() for name in entries}
        names = [name for some in listed[side].values() for name in some]
        assert len(set(names)) == len(names) and set(names) <= known
    (tmp_path / "list.json").write_text('{"training": {"stool": ["chair_kind/oak"]}}')
    monkeypatch.setattr(same_shape, "CATALOGUE", tmp_path / "list.json")
    models = tmp_path / "models"
    for name in ("oak", "elm"):
        (models / "chair_kind" / name).mkdir(parents=True)
        (models / "chair_kind" / name / f"{name}.obj").write_text("v 0 0 0")
    (models / "models.json").write_text('{"chair_kind/oak": {"front": "+x"}, "chair_kind/elm": {}}')
    copy_same_shape("training", models, tmp_path / "out")
    (model,) = list_models(tmp_path / "out")
    assert (model.category, model.name, model.info.front) == ("stool", "oak", "+x")


def test_the_builder_copies_converts_and_checks(aircraft, tmp_path):
    packages, texture = tmp_path / "packages", np.full((4, 4, 3), 90, np.uint8)
    quad = write_quad(tmp_path / "quad.obj", texture)
    (packages / "home").mkdir()
    with zipfile.ZipFile(packages / "home" / "set.sh3f", "w") as archive:
        for path in (quad, quad.with_suffix(".mtl"), quad.with_suffix(".png")):
            archive.write(path, f"set/sign/{path.name}")
    checksum = lambda path: hashlib.sha256(path.read_bytes()).hexdigest()  # noqa: E731
    sign = Entry("home", "set.sh3f", checksum(quad), "CC0 1.0", "Ann", "LICENSE.TXT", member="set/sign/quad.obj")
    plane = Entry("sky", "plane.ac", checksum(aircraft), "GPL-2+", "Bob", "copyright", textures="liveries", front="-x")
    catalogue = Catalogue({"home": "1.0", "sky": "2.0"}, {"sign": {"stop": sign}, "aircraft": {"plane": plane}})
    out = tmp_path / "models"
    build(packages, out, catalogue)
    page = (out / "ATTRIBUTION.md").read_text()
    assert "| sign/stop | | Ann | [CC0 1.0](" in page
    assert "| aircraft/plane | | Bob | GPL-2+ | plane.ac | converted" in page
    build(packages, out, catalogue)  # again into the same folder
    aircraft_model, sign_model = list_models(out)
    assert aircraft_model.info.front == "-x" and aircraft_model.info.changes == "converted from AC3D, -x taken as front"
    assert sign_model.info.source == "home 1.0: set/sign/quad.obj" and sign_model.info.author == "Ann"
    mesh = read_mesh(aircraft_model.path)
    assert len(sign_model.read().faces) == len(mesh.faces) == 2  # a line is no surface
    assert mesh.vertices.min(0) == pytest.approx([10, -1, -1]) and mesh.vertices.max(0) == pytest.approx([10, 1, 1])
    assert mesh.uv.max((0, 1)).tolist() == [2, 1]  # the texture repeats twice
    (material,) = mesh.materials
    assert material.colour == pytest.approx([1, 0, 0, 0.75], abs=0.01) and material.texture.shape == (8, 8, 4)
    aircraft.write_text(AC3D + " ")
    with pytest.raises(InputError, match="plane.ac .*checksum"):
        build(packages, out, catalogue)
    aircraft.unlink()
    with pytest.raises(InputError, match="expected the unpacked package sky"):
        build(packages, out, catalogue)


def test_the_weights_name_every_model_that_they_were_trained_on():
    page = ATTRIBUTION.read_text(encoding="utf-8")
    text = " ".join(page.split())
    for name, work in [one for models in CATALOGUES["training"].values() for one in models.items()]:
        assert f"**{work.author}**: " in text and " ".join((work.title or name.replace("_", " ")).split()) in text
        assert f"### {work.licence} <{LICENCES[work.licence]}>" in text
    assert f"]({ATTRIBUTION.name})" in (ATTRIBUTION.parent / "MODEL_CARD.md").read_text(encoding="utf-8")


with (TOOLS / "concepts.csv").open(newline="") as _file:
    ROWS = list(csv.DictReader(_file))
SIDE_OF = {row["name"]: row["side"] for row in ROWS}


def test_no_name_is_listed_twice_and_no_concept_is_on_two_sides():
    assert len(SIDE_OF) == len(ROWS) and all(row["name"] and row["concept"] for row in ROWS)
    assert set(SIDE_OF.values()) == {"training", "validation", "evaluation"}
    side_of_concept = {row["concept"]: row["side"] for row in ROWS}
    assert [row for row in ROWS if row["side"] != side_of_concept[row["concept"]]] == []


def test_every_category_is_listed_on_its_side():
    samples = [path.parent.name for path in (REPOSITORY / "data_samples").glob("*/frame_annotations.jgz")]
    reserved = "armchair bench bicycle bus car chair motorcycle scooter sofa stool toilet truck van washbasin aircraft"
    named = {
        "training": [*TRAINING, *CATALOGUES["training"]],
        "validation": [*VALIDATION, *CATALOGUES["validation"]],
        "evaluation": [*CATEGORIES, *samples, *CATALOGUES["artists"], *CATALOGUES["samples"], *reserved.split()],
    }
    for side, names in named.items():
        assert {name: SIDE_OF.get(name) for name in names} == dict.fromkeys(names, side)


def test_no_model_for_training_has_the_name_of_an_evaluation_category():
    reserved = {name for name, side in SIDE_OF.items() if side == "evaluation"}
    models = [model for side in ("training", "validation") for names in CATALOGUES[side].values() for model in names]
    # Two fittings of a bathroom are no toilet.
    assert {one for one in models if reserved & {*one.split("_")}} == {"toilet_brush", "toilet_paper_dispenser"}
