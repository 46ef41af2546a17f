"""What a run remembers of its library, machine, rows and extractors: names, versions and hashes."""

import dataclasses
import functools
import platform
import subprocess
import sys
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy
import torch

from zsp_lite import __version__
from zsp_lite.backbones.backbone import Backbone
from zsp_lite.benchmark.runs import Call, Settings
from zsp_lite.io.files import REPOSITORY, digest


def described(value: Any) -> str:
    """Describe a setting as text: an object by "module:name", whatever its code; a dataclass with
    its public fields."""
    if value is None or isinstance(value, bool | int | float | str | list | tuple):
        return str(value)
    named = value if hasattr(value, "__qualname__") else type(value)
    name = f"{named.__module__}:{named.__qualname__}"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [one.name for one in dataclasses.fields(value) if not one.name.startswith("_")]
        fields = ", ".join(f"{one}={described(getattr(value, one))}" for one in names)
        return f"{name}({fields})"
    return name


def fingerprint(extractor: Any) -> str:
    """Return the name of an extractor (by default "module:name"), and a hash of its `state_dict`
    and settings."""
    name, settings = getattr(extractor, "name", None) or described(extractor), ""
    state_dict = getattr(extractor, "state_dict", None)
    if isinstance(extractor, Backbone):
        state_dict, image = (
            extractor.model.state_dict,
            (extractor.image_size, extractor.mean, extractor.std),
        )
        settings = repr((extractor.layer, extractor.facet, extractor.saliency_heads, *image))
    parts: list[str | bytes] = []
    for key, weight in sorted(state_dict().items()) if callable(state_dict) else ():
        parts += [
            key,
            weight.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes(),
        ]
    return f"{name} {digest(settings, *parts)}" if parts else name


@functools.cache
def library_version() -> dict[str, str | None]:
    """Return the version of zsp_lite, and the commit of its checkout, "-dirty" if files differ;
    None if installed."""
    commit = None
    # An installed copy may lie inside the repository of another project, whose commit says nothing.
    if (REPOSITORY / ".git").exists():
        words = "describe --always --abbrev=40 --dirty --exclude *".split()
        describe = ["git", "-C", str(REPOSITORY), *words]
        with suppress(OSError):  # git is not installed
            commit = subprocess.run(describe, capture_output=True, text=True).stdout.strip() or None
    return {"version": __version__, "commit": commit}


def run_settings(
    data: str | Path,
    backbone: Any,
    targets: int,
    methods: dict[str, str],
    labels: dict[str, str],
    **call: Any,
) -> Settings:
    """Describe a run, and this call of it: time, command, and versions of what computes."""
    words = [Path(sys.argv[0]).name.replace("__main__.py", "zsp-lite"), *sys.argv[1:]]
    versions = {one.__name__: str(one.__version__) for one in (torch, np, scipy, cv2)}
    versions |= {"python": platform.python_version(), "machine": platform.platform()}
    this_call = Call(
        time=datetime.now(UTC).isoformat(timespec="seconds"),
        command=[text.encode(errors="replace").decode() for text in words],
        versions=versions,
        rows=list(methods),
        **call,
    )
    return Settings(
        data=str(data).encode(errors="replace").decode(),
        backbone=fingerprint(backbone),
        targets=targets,
        library=[library_version()],
        labels=labels,
        methods=methods,
        calls=[this_call],
    )
