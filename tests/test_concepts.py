"""Training, validation and evaluation have no concept and no model file in common (`tools/concepts.csv`)."""

import csv
import json

from tools.training_categories import TRAINING
from tools.validation_categories import VALIDATION
from zsp_lite.samples import REPOSITORY
from zsp_lite.synthetic.categories import CATEGORIES

TOOLS = REPOSITORY / "tools"
with (TOOLS / "concepts.csv").open(newline="") as _file:
    ROWS = list(csv.DictReader(_file))
SIDE_OF = {row["name"]: row["side"] for row in ROWS}
CONCEPT_OF = {row["name"]: row["concept"] for row in ROWS}
# Catalogues of model files: name to {category: {model: entry}}.
CATALOGUES = {
    path.stem: content["models"]
    for path in sorted(TOOLS.glob("*.json"))
    if "models" in (content := json.loads(path.read_text()))
}


def sides_of_concepts(rows: list[dict[str, str]]) -> dict[str, set[str]]:
    sides: dict[str, set[str]] = {}
    for row in rows:
        sides.setdefault(row["concept"], set()).add(row["side"])
    return sides


def test_no_name_is_listed_twice_and_every_side_is_known():
    assert len(SIDE_OF) == len(ROWS)
    assert set(SIDE_OF.values()) == {"training", "validation", "evaluation"}
    assert all(row["name"] and row["concept"] for row in ROWS)


def test_no_concept_is_on_two_sides():
    assert {concept: sides for concept, sides in sides_of_concepts(ROWS).items() if len(sides) > 1} == {}
    planted = {"name": "kart", "side": "training", "concept": CONCEPT_OF["car"]}
    assert sides_of_concepts([*ROWS, planted])["motor vehicle"] == {"training", "evaluation"}


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
    fittings = {"toilet_brush", "toilet_paper_dispenser"}  # of a bathroom; no toilet
    models = [model for side in ("training", "validation") for names in CATALOGUES[side].values() for model in names]
    found = {model for model in models if reserved & {*model.split("_")}}
    assert found == fittings


def test_no_model_of_the_sample_data_is_in_the_catalogue_of_artists():
    records = json.loads((REPOSITORY / "data_samples" / "rendered_models.json").read_text())
    shown = {record["sha256"] for models in records["sequences"].values() for record in models.values()}
    listed = {
        name: {entry["sha256"] for models in CATALOGUES[name].values() for entry in models.values()}
        for name in ("samples", "artists")
    }
    assert shown == listed["samples"] and not shown & listed["artists"]


def test_near_concepts_exist_on_another_side():
    sides = sides_of_concepts(ROWS)
    for row in ROWS:
        for near in filter(None, row["near"].split("; ")):
            assert sides[near] - {row["side"]}, row
        assert bool(row["near"]) <= bool(row["remark"]), row
