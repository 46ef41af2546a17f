"""Feature maps on disk, shared between runs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save

from zsp_lite.benchmark.identity import digest, fingerprint, library_version
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.features import FeatureMap
from zsp_lite.io.files import make_folder, write_atomic

_PARTS = ("keys", "saliency", "global_feature")
_UNCACHED = ("rootsift",)  # computed faster than read


class FeatureCache:
    """A folder of feature maps in full precision: results with it equal those without it.

    A file's name is a hash of the library's source, of the extractor's fingerprint and of its input: the crop's
    pixels, and for extractors with `describe` also the depth, the mask and the camera. Only results of the type
    FeatureMap are kept. The fingerprint of a user-defined extractor without weights is its name: use another folder
    when its code changes.
    """

    def __init__(self, folder: str | Path, extractors: Mapping[str, Any]):
        self.folder, self.extractors = make_folder(folder, "cache folder"), extractors
        self._fingerprints = {name: fingerprint(one) for name, one in extractors.items() if name not in _UNCACHED}

    def path(self, features: str, frame: Frame) -> Path:
        """Return the file of a frame's features."""
        seen = [frame.rgb]
        if hasattr(self.extractors[features], "describe"):
            camera = frame.camera
            seen += [frame.depth, frame.mask, camera.R, camera.t, camera.focal_length, camera.principal_point]
        parts = ("none" if part is None else part for part in seen)
        name = digest(library_version()["source"], self._fingerprints[features], *parts)
        return self.folder / name[:2] / f"{name}.safetensors"

    def read(self, features: str, frame: Frame) -> FeatureMap | None:
        """Return the stored features, None if there are none or their file is damaged."""
        if features not in self._fingerprints:
            return None
        try:
            tensors = load(self.path(features, frame).read_bytes())
            return FeatureMap(*(tensors[part] for part in _PARTS))
        except (OSError, SafetensorError, KeyError, InputError):
            return None

    def write(self, features: str, frame: Frame, found: Any) -> None:
        """Store features of the type FeatureMap."""
        if features in self._fingerprints and isinstance(found, FeatureMap):
            tensors = {part: getattr(found, part).cpu().contiguous() for part in _PARTS}
            write_atomic(self.path(features, frame), save(tensors))
