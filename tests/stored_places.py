"""The places that the page docs/find_on_all.md shows, as docs/playground/found/ stores them."""

import json
import zlib
from base64 import b64decode

import numpy as np

from zsp_lite.io.files import REPOSITORY

FOLDER = REPOSITORY / "docs/playground/found"


def stored_objects(category: str) -> list[dict]:
    """Read the objects of a category."""
    text = (FOLDER / f"{category}.js").read_text()
    return list(map(unpacked_object, json.loads(text.partition(" = ")[2].rstrip(";\n"))))


def unpacked_object(one: dict) -> dict:
    """An object of `docs.playground.found.category_data` with its arrays: "pixels" (points,
    pictures, 2), "places" and "confidences" (objects, marks)."""
    pictures, marks = len(one["pictures"]), one["starts"][-1]
    return one | {
        "pixels": unpacked(one["pixels"], "u1").reshape(-1, pictures, 2),
        "places": unpacked(one["places"], "<u2").reshape(-1, marks),
        "confidences": unpacked(one["confidences"], "u1").reshape(-1, marks),
    }


def unpacked(text: str, kind: str) -> np.ndarray:
    """The numbers of a `packed` array."""
    return np.frombuffer(zlib.decompress(b64decode(text)), kind)
