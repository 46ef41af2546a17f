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


class FeatureCache:
    """A folder of feature maps in full precision, named by the library's source, the extractor and the crop's pixels.

    A user-defined extractor without weights is known by its name: use another folder when its code changes. Extractors
    that see more than the pixels, by `describe`, are not cached.
    """

    def __init__(self, folder: str | Path, extractors: Mapping[str, Any]):
        self.folder = make_folder(folder, "cache folder")
        # RootSIFT is computed faster than read.
        cached = {name: one for name, one in extractors.items() if name != "rootsift" and not hasattr(one, "describe")}
        self._fingerprints = {name: fingerprint(one) for name, one in cached.items()}

    def path(self, features: str, frame: Frame) -> Path:
        """Return the file of a frame's features."""
        name = digest(library_version()["source"], self._fingerprints[features], frame.rgb)
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

    def write(self, features: str, frame: Frame, found: FeatureMap) -> None:
        """Store features."""
        if features in self._fingerprints:
            tensors = {part: getattr(found, part).cpu().contiguous() for part in _PARTS}
            write_atomic(self.path(features, frame), save(tensors))
