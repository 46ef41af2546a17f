"""What commands and functions take for a backbone: itself, its name, its file, or a config."""

import os
import re
from pathlib import Path

from zsp_lite.backbones.load import PREFIX, BackboneConfig, load_backbone
from zsp_lite.choices import Facet
from zsp_lite.errors import InputError
from zsp_lite.features import FeatureExtractor
from zsp_lite.io.modules import import_object

_IMPORT_PATH = r"[\w.]+:[\w.]+"  # module:name
# A backbone, or what `load_backbone` takes.
BackboneLike = FeatureExtractor | str | Path | BackboneConfig


def as_backbone(backbone: BackboneLike) -> FeatureExtractor:
    """Return a backbone as it is; load one that is given by name, file or config."""
    if isinstance(backbone, str | Path | BackboneConfig):
        return load_backbone(backbone)
    return backbone


def named_backbone(
    name: str, layer: str | None, facet: Facet, image_size: int | None
) -> BackboneLike:
    """Return what `as_backbone` takes for a name with options.

    "module:thing" is imported: a backbone of the user's own.
    """
    config = BackboneConfig(name, layer, facet, image_size)
    has_options = config != BackboneConfig(name)
    if name.startswith(PREFIX) or os.path.isfile(name) or not re.fullmatch(_IMPORT_PATH, name):
        return config if has_options else name
    extractor = import_object(name)
    if isinstance(extractor, type) or not callable(extractor):
        raise InputError(
            f"backbone {name!r} is of type {type(extractor).__name__}, "
            "expected a function of images"
        )
    if has_options:
        raise InputError(
            f"backbone {name!r} is your own, expected no layer, facet or image size beside it"
        )
    return extractor
