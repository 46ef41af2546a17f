"""Feature maps on disk, named by what they are features of: any run with the same backbone and pictures finds them."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save

from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.features import FeatureMap
from zsp_lite.io.files import write_atomic

_PARTS = ("keys", "saliency", "global_feature")


class FeatureCache:
    """A folder of feature maps in full precision, so that a run with it says what one without it would.

    A file's name is a hash of the extractor (as `fingerprints` tells it) and of the crop's pixels: what changes either
    changes the name, and nothing has ever to be cleared but for room. Extractors that
    are not in `fingerprints`, and descriptions that are no FeatureMap, are not kept.
    """

    def __init__(self, folder: str | Path, fingerprints: Mapping[str, str]):
        self.folder, self.fingerprints = Path(folder), fingerprints

    def path(self, features: str, frame: Frame) -> Path:
        digest = hashlib.sha256(self.fingerprints[features].encode())
        digest.update(repr(frame.rgb.shape).encode() + frame.rgb.tobytes())
        name = digest.hexdigest()
        return self.folder / name[:2] / f"{name}.safetensors"

    def read(self, features: str, frame: Frame) -> FeatureMap | None:
        """The kept feature map, None where there is none or its file is damaged."""
        if features not in self.fingerprints:
            return None
        try:
            tensors = load(self.path(features, frame).read_bytes())
            return FeatureMap(*(tensors[part] for part in _PARTS))
        except (OSError, SafetensorError, KeyError, InputError):
            return None

    def write(self, features: str, frame: Frame, found: Any) -> None:
        """Keep a feature map."""
        if features in self.fingerprints and isinstance(found, FeatureMap):
            tensors = {part: getattr(found, part).cpu().contiguous() for part in _PARTS}
            write_atomic(self.path(features, frame), save(tensors))
