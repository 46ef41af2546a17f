"""Backbones that have a name: the embedded one, and the DINO models released by Caron et al. (2021).

The SHA-256 of the package's own weights are in weights/SHA256SUMS. Of the released models only the first digits of an
MD5 digest were published, which can be forged: the sizes of the network are compared with the release's, and the
SHA-256 of the file with that of its first use (see `download.pinned`).
"""

import os
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import torch

from zsp_lite.backbones.huggingface import PREFIX, model_folder
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.errors import InputError
from zsp_lite.io.download import cache_folder, fetch, has_size_and_hash, pinned
from zsp_lite.io.files import read_bytes, sha256

DINO_URL = "https://dl.fbaipublicfiles.com/dino/"  # the environment variable ZSP_LITE_DINO_URL overrides it
WEIGHTS = Path(__file__).parents[1] / "weights"
DEFAULT = "zsp-tiny"
TINY = WEIGHTS / "zsp-tiny.safetensors"
EMBEDDED = {DEFAULT: TINY}  # networks that this project trained
SUMS = "SHA256SUMS"  # written by: cd zsp_lite/weights && sha256sum *.safetensors > SHA256SUMS
_GROWTH = 1.1  # of a file compared with its weights in float32: names, and the parts of training


@dataclass(frozen=True)
class PretrainedWeights:
    """A released checkpoint.

    Attributes:
        file: Path below the DINO URL.
        md5_prefix: First digits of the file's MD5 hash.
        size: File size in bytes, if known.
        geometry: Image size in pixels, patch size in pixels, channels and number of blocks.
    """

    file: str
    md5_prefix: str
    size: int | None = None
    geometry: tuple[int, int, int, int] = (224, 8, 384, 12)

    @property
    def url(self) -> str:
        """Address of the file."""
        return os.environ.get("ZSP_LITE_DINO_URL", DINO_URL).rstrip("/") + "/" + self.file

    @property
    def path(self) -> Path:
        """Path of the downloaded file."""
        return cache_folder() / Path(self.file).name

    @property
    def most_bytes(self) -> int:
        """Largest plausible size of the file."""
        with torch.device("meta"):
            model = VisionTransformer(*self.geometry, num_heads=1)
        return int(_GROWTH * sum(4 * weight.numel() for weight in model.parameters()))


_BASE8, _BASE16 = (224, 8, 768, 12), (224, 16, 768, 12)
PRETRAINED = {
    "dino_vits8": PretrainedWeights("dino_deitsmall8_pretrain/dino_deitsmall8_pretrain.pth", "230cd5", 86_728_949),
    "dino_vits16": PretrainedWeights(
        "dino_deitsmall16_pretrain/dino_deitsmall16_pretrain.pth", "cf0f22", geometry=(224, 16, 384, 12)
    ),
    "dino_vitb8": PretrainedWeights("dino_vitbase8_pretrain/dino_vitbase8_pretrain.pth", "556550", geometry=_BASE8),
    "dino_vitb16": PretrainedWeights("dino_vitbase16_pretrain/dino_vitbase16_pretrain.pth", "552daf", geometry=_BASE16),
}


def available_backbones() -> dict[str, Path | None]:
    """Return the names of all backbones with their file, or None if it is not downloaded."""
    paths = EMBEDDED | {name: weights.path for name, weights in PRETRAINED.items()}
    return {name: path if path.is_file() else None for name, path in paths.items()}


def obtained_by(name: str) -> str:
    """Return what is to be done for a backbone whose file `available_backbones` does not have."""
    if name in EMBEDDED:
        return "missing: reinstall zsp-lite"
    return f"not downloaded: zsp-lite weights fetch {name}"


def download(name: str) -> Path:
    """Download a backbone if it is not available yet.

    Args:
        name: One of `available_backbones`, or "hf:NAME".

    Returns:
        The checkpoint file; the model's folder for "hf:NAME".

    Raises:
        InputError: If the name is unknown or the download fails; the message says what to do.
    """
    if name.startswith(PREFIX):
        return model_folder(name)
    if name in EMBEDDED:
        if not EMBEDDED[name].is_file():
            raise InputError(f"{name}: {EMBEDDED[name]} is missing; reinstall zsp-lite")
        return EMBEDDED[name]
    if name not in PRETRAINED:
        raise InputError(f"backbone {name!r}: not one of {', '.join(available_backbones())}")
    weights = PRETRAINED[name]
    try:
        return fetch(weights.url, weights.path, weights.size, weights.md5_prefix, most=weights.most_bytes)
    except InputError as error:
        raise InputError(
            f"{name}: {error}; download that file on another machine and copy it to {weights.path}, or use {DEFAULT}"
        ) from error


def using(name: str, path: Path) -> AbstractContextManager:
    """Check the digest of a backbone's file. The block loads it; a released file is known from then on.

    Raises:
        InputError: The file of the package is not that of SHA256SUMS, or a released one is not that of its first use.
    """
    if path in EMBEDDED.values():
        check_shipped(path)
    return pinned(path) if name in PRETRAINED else nullcontext()


def check_shipped(path: Path) -> None:
    """Raise InputError if a file of weights in the package is not the one that SHA256SUMS beside it lists."""
    lines = read_bytes(WEIGHTS / SUMS, "digests").decode().splitlines()
    digests = {name: digest for digest, name in (line.split(maxsplit=1) for line in lines)}
    expected, found = digests.get(path.relative_to(WEIGHTS).as_posix(), "none"), sha256(path, "weights")
    if found != expected:
        raise InputError(f"{path} is damaged: its SHA-256 is {found}, expected {expected} as in {SUMS}; reinstall it")


def check_geometry(name: str, model: VisionTransformer) -> None:
    """Raise InputError if a network that was loaded under a released name has other sizes than the release."""
    if name in PRETRAINED:
        found = model.image_size, model.patch_size, model.embed_dim, model.depth
        if found != PRETRAINED[name].geometry:
            raise InputError(
                f"{name}: {PRETRAINED[name].path} is not the released network: image size, patch size, channels and "
                f"blocks are {found}, expected {PRETRAINED[name].geometry}"
            )


def verify_download(name: str) -> None:
    """Raise InputError if a backbone that is downloaded by name is not there or differs from the released file."""
    weights = PRETRAINED.get(name)
    if weights is not None and not weights.path.is_file():
        raise InputError(f"{name} is not downloaded; run zsp-lite weights fetch {name}")
    if weights is not None and not has_size_and_hash(weights.path, weights.size, weights.md5_prefix):
        raise InputError(
            f"{name}: {weights.path} is not the released file, expected {weights.size or 'any number of'} bytes with "
            f"MD5 {weights.md5_prefix}...; remove it, then run zsp-lite weights fetch {name}"
        )
