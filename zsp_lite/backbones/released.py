"""Names of backbones and their files: the backbone in the package, and the released DINO models of
Caron et al. (2021), which are downloaded."""

import os
from dataclasses import dataclass
from pathlib import Path

from zsp_lite.backbones.huggingface import model_folder
from zsp_lite.backbones.load import DEFAULT, PREFIX, TINY
from zsp_lite.errors import InputError, check_choice
from zsp_lite.io.download import fetch, has_size_and_hash
from zsp_lite.io.files import cache_folder

# Address of the released files, unless the environment variable ZSP_LITE_DINO_URL gives another
# one.
DINO_URL = "https://dl.fbaipublicfiles.com/dino/"
# Limit of the size of a released file: a ViT-B, the largest, has 86 million weights of 4 bytes.
MOST_BYTES = 400_000_000


@dataclass(frozen=True)
class PretrainedWeights:
    """A released checkpoint."""

    file: str  # path below the DINO URL
    # First digits of the file's MD5 digest in hexadecimal; only these were published.
    md5_prefix: str
    size: int | None = None  # bytes, None where it is not known

    @property
    def url(self) -> str:
        """Address of the file."""
        return os.environ.get("ZSP_LITE_DINO_URL", DINO_URL).rstrip("/") + "/" + self.file

    @property
    def path(self) -> Path:
        """Path of the downloaded file."""
        return cache_folder() / Path(self.file).name


PRETRAINED = {
    "dino_vits8": PretrainedWeights(
        "dino_deitsmall8_pretrain/dino_deitsmall8_pretrain.pth", "230cd5", 86_728_949
    ),
    "dino_vits16": PretrainedWeights(
        "dino_deitsmall16_pretrain/dino_deitsmall16_pretrain.pth", "cf0f22"
    ),
    "dino_vitb8": PretrainedWeights("dino_vitbase8_pretrain/dino_vitbase8_pretrain.pth", "556550"),
    "dino_vitb16": PretrainedWeights(
        "dino_vitbase16_pretrain/dino_vitbase16_pretrain.pth", "552daf"
    ),
}


def available_backbones() -> dict[str, Path | None]:
    """Return the names of all backbones with their file, or None if it is not downloaded."""
    paths = {DEFAULT: TINY} | {name: weights.path for name, weights in PRETRAINED.items()}
    return {name: path if path.is_file() else None for name, path in paths.items()}


def how_to_obtain(name: str) -> str:
    """Say how to get the file of a backbone for which `available_backbones` has None."""
    if name == DEFAULT:
        return "missing: reinstall zsp-lite"
    return f"not downloaded: zsp-lite weights fetch {name}"


def download(name: str) -> Path:
    """Return the file of a named backbone, or the folder of "hf:NAME"; download it if missing.

    InputError if the file is not the released one.
    """
    if name.startswith(PREFIX):
        return model_folder(name)
    if name == DEFAULT:
        return TINY
    check_choice("backbone", name, available_backbones())
    weights = PRETRAINED[name]
    try:
        path = fetch(weights.url, weights.path, weights.size, weights.md5_prefix, most=MOST_BYTES)
    except InputError as error:
        raise InputError(
            f"{name}: {error}; download that file on another machine and copy it to "
            f"{weights.path}, or use {DEFAULT}"
        ) from error
    # `fetch` checks what it downloads, but not a file that exists already.
    if not has_size_and_hash(path, weights.size, weights.md5_prefix):
        raise InputError(
            f"{name}: {path} is not the released file, expected "
            f"{weights.size or 'any number of'} bytes with MD5 "
            f"{weights.md5_prefix}...; remove it, then run zsp-lite weights fetch {name}"
        )
    return path
