"""Copy the models whose poses can be compared: those of one shape, with the same side in front
(`same_shape.json`).

    python -m tools.same_shape training outputs/training_models outputs/training_shapes
    python -m tools.same_shape validation outputs/validation_models outputs/validation_shapes

The catalogues `training.json` and `validation.json` group models by what they are. A ceiling fan
and a table fan, or a desk and a lectern, have no pose in common that a picture could show. The
models of this list were chosen from pictures of all models.
"""

import json
import shutil
import sys
from pathlib import Path

import msgspec

from zsp_lite.course.synthetic.meshes import MODELS_FILE, read_infos
from zsp_lite.io.files import write_atomic

CATALOGUE = Path(__file__).with_suffix(".json")


def copy_same_shape(side: str, models: Path, out: Path) -> None:
    """Copy the models of a side, "training" or "validation", from the folder `models` to `out`."""
    infos = read_infos(models)
    copied = {}
    for category, listed in json.loads(CATALOGUE.read_text())[side].items():
        for name in listed:
            copy = f"{category}/{Path(name).name}"
            shutil.copytree(models / name, out / copy, dirs_exist_ok=True)
            copied[copy] = infos[name]
    write_atomic(out / MODELS_FILE, msgspec.json.format(msgspec.json.encode(copied), indent=1))


if __name__ == "__main__":
    if len(sys.argv) != 4 or sys.argv[1] not in ("training", "validation"):
        sys.exit(__doc__)
    copy_same_shape(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
