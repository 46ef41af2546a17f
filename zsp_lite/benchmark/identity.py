"""What a run remembers of its rows, extractors and labels: names, settings and hashes of weights."""

import dataclasses
import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from zsp_lite.backbones.backbone import Backbone


def described(value: Any) -> str:
    """Describe a setting or a function as text.

    Functions, classes and objects are described by "module:name"; for a dataclass, its public fields follow. A change
    of their code does not change the text.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return str(value)
    if isinstance(value, list | tuple):
        return f"({', '.join(map(described, value))})"
    named = value if hasattr(value, "__qualname__") else type(value)
    name = f"{named.__module__}:{named.__qualname__}"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = [field.name for field in dataclasses.fields(value) if not field.name.startswith("_")]
        return f"{name}({', '.join(f'{field}={described(getattr(value, field))}' for field in fields)})"
    return name


def fingerprint(extractor: Any) -> str:
    """Return the name of an extractor, and a hash of its weights and settings where it has any.

    The name of a user-defined extractor is its attribute `name`, by default "module:name". Weights are those of its
    `state_dict`.
    """
    if extractor is None:
        return "None"
    name = getattr(extractor, "name", None) or described(extractor)
    weights = extractor.model.state_dict() if isinstance(extractor, Backbone) else _weights(extractor)
    settings = ""
    if isinstance(extractor, Backbone):
        settings = repr(
            (extractor.layer, extractor.facet, extractor.saliency_heads, extractor.image_size, extractor.mean,
             extractor.std)
        )  # fmt: skip
    return f"{name} {_hash(weights, settings)}" if weights else name


def array_digest(array: np.ndarray, text: str = "") -> str:
    """Return a hash of an array of numbers and a text."""
    return hashlib.sha256(np.ascontiguousarray(array, np.float64).tobytes() + text.encode()).hexdigest()[:16]


def _weights(extractor: Any) -> Mapping[str, torch.Tensor]:
    state_dict = getattr(extractor, "state_dict", None)
    return state_dict() if callable(state_dict) else {}


def _hash(weights: Mapping[str, torch.Tensor], settings: str) -> str:
    digest = hashlib.sha256(settings.encode())
    for key, weight in sorted(weights.items()):
        tensor = weight.detach().cpu().contiguous().reshape(-1)
        digest.update(key.encode() + tensor.view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:16]
