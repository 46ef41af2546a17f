"""Copy the models whose poses can be compared: those of one shape, with the same side in front (`same_shape.json`).

    python tools/same_shape.py training outputs/training_models outputs/training_poses_models
    python tools/same_shape.py validation outputs/validation_models outputs/validation_poses_models

The catalogues `training.json` and `validation.json` group models by what they are. A ceiling fan and a table fan, or a
desk and a lectern, have no pose in common that a picture could show. The models of this list were chosen from pictures
of all models (`zsp-lite models sheet`).
"""

import json
import shutil
import sys
from pathlib import Path

from zsp_lite.synthetic.models import MODELS_FILE


def main(side: str, models: str, out: str) -> None:
    """Copy the models of a side from the folder `models` to `out`."""
    infos, kept = json.loads((Path(models) / MODELS_FILE).read_text()), {}
    for category, names in json.loads(Path(__file__).with_suffix(".json").read_text())[side].items():
        for name in names:
            copy = f"{category}/{Path(name).name}"
            shutil.copytree(Path(models) / name, Path(out) / copy, dirs_exist_ok=True)
            kept[copy] = infos[name]
    (Path(out) / MODELS_FILE).write_text(json.dumps(kept, indent=1))


if __name__ == "__main__":
    main(*sys.argv[1:])
