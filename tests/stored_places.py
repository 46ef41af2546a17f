"""The places that the page docs/find_on_all.md shows, as docs/playground/found/ stores them."""

import json
import zlib
from base64 import b64decode

import numpy as np

from zsp_lite.io.files import REPOSITORY

FOLDER = REPOSITORY / "docs/playground/found"


def stored_objects(category: str) -> list[dict]:
    """Read the objects of a category (see `docs.playground.found.category_data`).

    Their "pixels" are (points, pictures, 2), "places" and "confidences" (objects, marks).
    """
    text = (FOLDER / f"{category}.js").read_text()
    objects = json.loads(text.partition(" = ")[2].rstrip(";\n"))
    for one in objects:
        for name, kind, shape in (
            ("pixels", "u1", (-1, len(one["pictures"]), 2)),
            ("places", "<u2", (len(objects), -1)),
            ("confidences", "u1", (len(objects), -1)),
        ):
            one[name] = unpacked(one[name], kind).reshape(shape)
    return objects


def unpacked(text: str, kind: str) -> np.ndarray:
    """The numbers of a `packed` array."""
    return np.frombuffer(zlib.decompress(b64decode(text)), kind)
