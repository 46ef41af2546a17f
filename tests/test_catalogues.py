"""The catalogues of models are complete and consistent; training, validation and evaluation have no
concept (`tools/concepts.csv`) and no model file in common."""

import csv
import json
import re

import pytest

from tools.models import LICENCES, Catalogue, Entry, attribution, read_catalogue
from zsp_lite.course.synthetic.categories import CATEGORIES
from zsp_lite.io.files import REPOSITORY

TOOLS = REPOSITORY / "tools"
CATALOGUES = {
    name: read_catalogue(TOOLS / f"{name}.json")
    for name in ("artists", "samples", "training", "validation")
}
WEIGHTS = REPOSITORY / "zsp_lite/weights"

# Licences of the models that the network sees, and such of Creative Commons.
FREE = LICENCES.keys() - {"Public Domain Mark 1.0"}
CC = {"CC0 1.0", "CC BY 3.0", "CC BY 3.0 US"}


def works(catalogue: Catalogue) -> list[Entry]:
    """All works of a catalogue."""
    return [work for models in catalogue.models.values() for work in models.values()]


# A model that is added or lost by mistake changes the numbers of categories and models.
@pytest.mark.parametrize(
    "name, categories, count, licences",
    [
        ("artists", 8, 59, CC | {"Public Domain Mark 1.0", "GPL-2+"}),
        ("samples", 4, 16, CC),
        ("training", 49, 320, FREE),
        ("validation", 10, 28, FREE),
    ],
)
def test_every_model_of_a_catalogue_has_a_free_licence_and_names_its_author(
    name, categories, count, licences
):
    catalogue = CATALOGUES[name]
    listed = works(catalogue)
    assert len(catalogue.models) == categories
    assert len(listed) == count
    assert {work.package for work in listed} == set(catalogue.packages)
    assert {work.licence for work in listed} <= licences
    assert all(work.author and work.licence_file for work in listed)
    links = sum(work.licence in LICENCES for work in listed)
    assert attribution(catalogue).count("https://creativecommons.org/") == links


def test_no_file_is_listed_twice():
    listed = [work for catalogue in CATALOGUES.values() for work in works(catalogue)]
    assert len({work.sha256 for work in listed}) == len(listed)
    assert len({work.member or work.file for work in listed}) == len(listed)


def test_the_sample_data_show_the_models_of_their_catalogue():
    records = json.loads((REPOSITORY / "data_samples/rendered_models.json").read_text())
    shown = {
        record["sha256"] for models in records["sequences"].values() for record in models.values()
    }
    assert shown == {work.sha256 for work in works(CATALOGUES["samples"])}


def test_the_weights_name_every_model_that_they_were_trained_on():
    text = " ".join((WEIGHTS / "ATTRIBUTION.md").read_text("utf-8").split())
    for models in CATALOGUES["training"].models.values():
        for name, work in models.items():
            assert f"**{work.author}**: " in text
            assert " ".join((work.title or name.replace("_", " ")).split()) in text
            assert f"### {work.licence} <{LICENCES[work.licence]}>" in text
    assert "](ATTRIBUTION.md)" in (WEIGHTS / "MODEL_CARD.md").read_text("utf-8")


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
    # The procedural categories that the weights were trained on.
    card = (WEIGHTS / "MODEL_CARD.md").read_text("utf-8")
    (trained,) = re.findall(r"19 training categories: ([\w\s,]+)\.", card)
    trained = re.split(r",\s+|\s+and\s+", trained)
    assert len(trained) == 19
    samples = [
        path.parent.name for path in (REPOSITORY / "data_samples").glob("*/frame_annotations.jgz")
    ]
    # Names that a model for evaluation may have, whether there is one or not.
    reserved = (
        "armchair bench bicycle bus car chair motorcycle scooter sofa stool toilet truck van "
        "washbasin aircraft"
    )
    names_of = {
        "training": [*trained, *CATALOGUES["training"].models],
        "validation": CATALOGUES["validation"].models,
        "evaluation": [
            *CATEGORIES,
            *samples,
            *CATALOGUES["artists"].models,
            *CATALOGUES["samples"].models,
            *reserved.split(),
        ],
    }
    for side, names in names_of.items():
        assert {name: SIDE_OF.get(name) for name in names} == dict.fromkeys(names, side)


def test_no_model_for_training_has_the_name_of_an_evaluation_category():
    reserved = {name for name, side in SIDE_OF.items() if side == "evaluation"}
    models = [
        model
        for side in ("training", "validation")
        for names in CATALOGUES[side].models.values()
        for model in names
    ]
    # A brush and a dispenser are no toilets.
    assert {model for model in models if reserved & {*model.split("_")}} == {
        "toilet_brush",
        "toilet_paper_dispenser",
    }
