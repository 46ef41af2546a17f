"""Backbones that have a name: the embedded "zsp-tiny" and the DINO models released by Caron et al. (2021)."""

import os
from dataclasses import dataclass
from pathlib import Path

from zsp_lite.backbones.huggingface import PREFIX, model_folder
from zsp_lite.errors import InputError
from zsp_lite.io.download import cache_folder, fetch, has_size_and_hash

DINO_URL = "https://dl.fbaipublicfiles.com/dino/"  # the environment variable ZSP_LITE_DINO_URL overrides it
TINY = Path(__file__).parents[1] / "weights" / "zsp-tiny.safetensors"


@dataclass(frozen=True)
class PretrainedWeights:
    """A released checkpoint.

    Attributes:
        file: Path below the DINO URL.
        md5_prefix: First digits of the file's MD5 hash.
        size: File size in bytes, if known.
    """

    file: str
    md5_prefix: str
    size: int | None = None

    @property
    def url(self) -> str:
        """Address of the file."""
        return os.environ.get("ZSP_LITE_DINO_URL", DINO_URL).rstrip("/") + "/" + self.file

    @property
    def path(self) -> Path:
        """Path of the downloaded file."""
        return cache_folder() / Path(self.file).name


PRETRAINED = {
    "dino_vits8": PretrainedWeights("dino_deitsmall8_pretrain/dino_deitsmall8_pretrain.pth", "230cd5", 86_728_949),
    "dino_vits16": PretrainedWeights("dino_deitsmall16_pretrain/dino_deitsmall16_pretrain.pth", "cf0f22"),
    "dino_vitb8": PretrainedWeights("dino_vitbase8_pretrain/dino_vitbase8_pretrain.pth", "556550"),
    "dino_vitb16": PretrainedWeights("dino_vitbase16_pretrain/dino_vitbase16_pretrain.pth", "552daf"),
}


def available_backbones() -> dict[str, Path | None]:
    """Return the names of all backbones with their file, or None if it is not downloaded."""
    paths = {"zsp-tiny": TINY} | {name: weights.path for name, weights in PRETRAINED.items()}
    return {name: path if path.is_file() else None for name, path in paths.items()}


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
    if name == "zsp-tiny":
        if not TINY.is_file():
            raise InputError(f"zsp-tiny: {TINY.name} is not in the package; `zsp-lite train` makes it")
        return TINY
    if name not in PRETRAINED:
        raise InputError(f"backbone {name!r}: not one of {', '.join(available_backbones())}")
    weights = PRETRAINED[name]
    try:
        return fetch(weights.url, weights.path, weights.size, weights.md5_prefix)
    except InputError as error:
        raise InputError(
            f"{name}: {error}; download that file on another machine and copy it to {weights.path}, or use zsp-tiny"
        ) from error


def verify_download(name: str) -> None:
    """Raise InputError if a named backbone is not downloaded or differs from the released file."""
    available = available_backbones()
    if name in available and available[name] is None:
        raise InputError(f"{name} is not downloaded; run zsp-lite weights fetch {name}")
    weights = PRETRAINED.get(name)
    if weights is not None and not has_size_and_hash(weights.path, weights.size, weights.md5_prefix):
        raise InputError(
            f"{name}: {weights.path} is not the released file, expected {weights.size or 'any number of'} bytes with "
            f"MD5 {weights.md5_prefix}...; remove it, then run zsp-lite weights fetch {name}"
        )
