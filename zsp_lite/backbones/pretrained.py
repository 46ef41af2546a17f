"""Backbones that have a name: the embedded one, and the DINO models released by Caron et al. (2021)."""

import os
from dataclasses import dataclass
from pathlib import Path

from zsp_lite.backbones.huggingface import PREFIX, model_folder
from zsp_lite.errors import InputError, check_choice
from zsp_lite.io.download import cache_folder, fetch, has_size_and_hash
from zsp_lite.io.files import read_bytes, sha256

DINO_URL = "https://dl.fbaipublicfiles.com/dino/"  # the environment variable ZSP_LITE_DINO_URL overrides it
MOST_BYTES = 400_000_000  # of a released file: a ViT-B, the largest, has 86 million weights of 4 bytes
WEIGHTS = Path(__file__).parents[1] / "weights"
DEFAULT = "zsp-tiny"
TINY = WEIGHTS / "zsp-tiny.safetensors"
SUMS = "SHA256SUMS"  # written by: cd zsp_lite/weights && sha256sum *.safetensors > SHA256SUMS


@dataclass(frozen=True)
class PretrainedWeights:
    """A released checkpoint."""

    file: str  # path below the DINO URL
    md5_prefix: str  # no more digits of a digest were published
    size: int | None = None  # bytes

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
    paths = {DEFAULT: TINY} | {name: weights.path for name, weights in PRETRAINED.items()}
    return {name: path if path.is_file() else None for name, path in paths.items()}


def obtained_by(name: str) -> str:
    """Return what is to be done for a backbone whose file `available_backbones` does not have."""
    return "missing: reinstall zsp-lite" if name == DEFAULT else f"not downloaded: zsp-lite weights fetch {name}"


def download(name: str) -> Path:
    """Return the file of a backbone of this name, or the folder of "hf:NAME", downloaded if it is not there yet."""
    if name.startswith(PREFIX):
        return model_folder(name)
    if name == DEFAULT:
        return TINY
    check_choice("backbone", name, available_backbones())
    weights = PRETRAINED[name]
    try:
        return fetch(weights.url, weights.path, weights.size, weights.md5_prefix, most=MOST_BYTES)
    except InputError as error:
        raise InputError(
            f"{name}: {error}; download that file on another machine and copy it to {weights.path}, or use {DEFAULT}"
        ) from error


def check_authentic(name: str, path: Path) -> None:
    """Raise InputError if the file of a backbone of this name is not the embedded or released one."""
    if name == DEFAULT:
        return check_shipped(path)
    weights = PRETRAINED[name]
    if not has_size_and_hash(path, weights.size, weights.md5_prefix):
        raise InputError(
            f"{name}: {path} is not the released file, expected {weights.size or 'any number of'} bytes with MD5 "
            f"{weights.md5_prefix}...; remove it, then run zsp-lite weights fetch {name}"
        )


def check_shipped(path: Path) -> None:
    """Raise InputError if a file of weights in the package is not the one that SHA256SUMS beside it lists."""
    lines = read_bytes(WEIGHTS / SUMS, "digests").decode().splitlines()
    digests = {name: digest for digest, name in (line.split(maxsplit=1) for line in lines)}
    found, expected = sha256(path, "weights") if path.is_file() else "none", digests.get(path.name, "none")
    if found != expected:
        raise InputError(
            f"{path} is missing or damaged: its SHA-256 is {found}, expected {expected}; reinstall zsp-lite"
        )
