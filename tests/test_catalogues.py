"""Catalogues of models: complete, consistent, built as they are listed; training, validation and
evaluation have no concept and no model file in common (`tools/concepts.csv`)."""

import csv
import json

import pytest

from tools.models import LICENCES, attribution, read_catalogue
from tools.training_categories import TRAINING
from tools.validation_categories import VALIDATION
from zsp_lite.course.synthetic.categories import CATEGORIES
from zsp_lite.io.files import REPOSITORY

TOOLS = REPOSITORY / "tools"
ARTISTS, SAMPLES = TOOLS / "artists.json", TOOLS / "samples.json"
TRAINED, CHOSEN_BY = TOOLS / "training.json", TOOLS / "validation.json"
CATALOGUES = {
    path.stem: read_catalogue(path).models for path in (ARTISTS, SAMPLES, TRAINED, CHOSEN_BY)
}
ATTRIBUTION = REPOSITORY / "zsp_lite/weights/ATTRIBUTION.md"

CC = {"CC0 1.0", "CC BY 3.0", "CC BY 3.0 US"}


@pytest.mark.parametrize(
    "path, categories, count, licences",
    [
        (ARTISTS, 8, 59, CC | {"Public Domain Mark 1.0", "GPL-2+"}),
        (SAMPLES, 4, 16, CC),
        (TRAINED, 49, 320, LICENCES.keys() - {"Public Domain Mark 1.0"}),
        (CHOSEN_BY, 10, 28, LICENCES.keys() - {"Public Domain Mark 1.0"}),
    ],
)
def test_every_model_of_a_catalogue_has_a_free_licence_and_names_its_author(
    path, categories, count, licences
):
    catalogue = read_catalogue(path)
    entries = [entry for models in catalogue.models.values() for entry in models.values()]
    assert len(catalogue.models) == categories
    assert len(entries) == count
    assert len({entry.sha256 for entry in entries}) == count  # no file twice
    assert {entry.package for entry in entries} == set(catalogue.packages)
    assert {entry.licence for entry in entries} <= licences
    assert all(entry.author and entry.licence_file for entry in entries)
    links = sum(entry.licence in LICENCES for entry in entries)
    assert attribution(catalogue).count("https://creativecommons.org/") == links


def test_no_file_is_in_two_catalogues_and_the_sample_data_show_those_of_theirs():
    for name in (lambda entry: entry.sha256, lambda entry: entry.member or entry.file):
        files = [
            name(one)
            for models in CATALOGUES.values()
            for entries in models.values()
            for one in entries.values()
        ]
        assert len(set(files)) == len(files)
    records = json.loads((REPOSITORY / "data_samples/rendered_models.json").read_text())
    shown = {
        record["sha256"] for models in records["sequences"].values() for record in models.values()
    }
    assert shown == {
        entry.sha256 for models in CATALOGUES["samples"].values() for entry in models.values()
    }


def test_the_weights_name_every_model_that_they_were_trained_on():
    page = ATTRIBUTION.read_text("utf-8")
    text = " ".join(page.split())
    for name, work in [one for models in CATALOGUES["training"].values() for one in models.items()]:
        assert f"**{work.author}**: " in text
        assert " ".join((work.title or name.replace("_", " ")).split()) in text
        assert f"### {work.licence} <{LICENCES[work.licence]}>" in text
    assert f"]({ATTRIBUTION.name})" in (ATTRIBUTION.parent / "MODEL_CARD.md").read_text(
        encoding="utf-8"
    )


with (TOOLS / "concepts.csv").open(newline="") as _file:
    ROWS = list(csv.DictReader(_file))
SIDE_OF = {row["name"]: row["side"] for row in ROWS}


def test_no_name_is_listed_twice_and_no_concept_is_on_two_sides():
    assert len(SIDE_OF) == len(ROWS)
    assert all(row["name"] and row["concept"] for row in ROWS)
    assert set(SIDE_OF.values()) == {"training", "validation", "evaluation"}
    side_of_concept = {row["concept"]: row["side"] for row in ROWS}
    assert [row for row in ROWS if row["side"] != side_of_concept[row["concept"]]] == []


def test_every_category_is_listed_on_its_side():
    samples = [
        path.parent.name for path in (REPOSITORY / "data_samples").glob("*/frame_annotations.jgz")
    ]
    reserved = (
        "armchair bench bicycle bus car chair motorcycle scooter sofa stool toilet truck van "
        "washbasin aircraft"
    )
    named = {
        "training": [*TRAINING, *CATALOGUES["training"]],
        "validation": [*VALIDATION, *CATALOGUES["validation"]],
        "evaluation": [
            *CATEGORIES,
            *samples,
            *CATALOGUES["artists"],
            *CATALOGUES["samples"],
            *reserved.split(),
        ],
    }
    for side, names in named.items():
        assert {name: SIDE_OF.get(name) for name in names} == dict.fromkeys(names, side)


def test_no_model_for_training_has_the_name_of_an_evaluation_category():
    reserved = {name for name, side in SIDE_OF.items() if side == "evaluation"}
    models = [
        model
        for side in ("training", "validation")
        for names in CATALOGUES[side].values()
        for model in names
    ]
    # Two fittings of a bathroom are no toilet.
    assert {one for one in models if reserved & {*one.split("_")}} == {
        "toilet_brush",
        "toilet_paper_dispenser",
    }
