"""Render altered copies of models: deformed and recoloured, each in a room of its own.

    python -m tools.variants outputs/training_models outputs/variants
    python -m tools.variants outputs/validation_models outputs/validation_variants 16

Two altered copies of one model are two instances of a category, so that every model is a category to learn from. The
models that `same_shape.json` lists for training share a shape with others; they form the categories named there, with
one copy each. The last argument is the number of views, by default 8. The folder is in CO3D's layout, with pose labels.
An interrupted run is continued.
"""

import json
import sys
from pathlib import Path

import numpy as np

from tools.same_shape import CATALOGUE
from zsp_lite.errors import InputError
from zsp_lite.synthetic.models import Model, list_models
from zsp_lite.synthetic.recording import read_poses, record_sequence, stable_hash, write_labels, write_sequence
from zsp_lite.training.instances import altered_copy

COPIES, FRAMES, IMAGE_SIZE, SEED = 2, 8, 256, 7


def render_variants(models: Path, out: Path, frames: int = FRAMES, image_size: int = IMAGE_SIZE) -> None:
    """Render altered copies of the models of a folder to a data folder.

    Raises:
        InputError: There are no models, or one cannot be read.
    """
    for category, found in _categories(models).items():
        for model in found:
            for copy in range(COPIES if len(found) == 1 else 1):
                name = f"{model.name}_{copy}"
                if name not in read_poses(out, category):
                    key = stable_hash(SEED, category, name)
                    mesh = altered_copy(model.read(), np.random.default_rng([key, 5]))
                    write_sequence(out, category, mesh, record_sequence(mesh, name, key, frames, image_size))
        write_labels(out, category, sorted(read_poses(out, category)))


def _categories(folder: Path) -> dict[str, list[Model]]:
    shapes = json.loads(CATALOGUE.read_text())["training"]
    shape = {model: name for name, listed in shapes.items() for model in listed}
    categories: dict[str, list[Model]] = {}
    for model in list_models(folder):
        category = shape.get(f"{model.category}/{model.name}", f"{model.category}-{model.name}")
        categories.setdefault(category, []).append(model)
    return categories


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4) or not all(one.isdecimal() for one in sys.argv[3:]):
        sys.exit(__doc__)
    try:
        render_variants(Path(sys.argv[1]), Path(sys.argv[2]), *map(int, sys.argv[3:]))
    except InputError as error:
        sys.exit(str(error))
