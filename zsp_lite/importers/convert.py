"""Conversion of a capture to a sequence of a data folder in CO3D's layout."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from zsp_lite.data.cameras import Box
from zsp_lite.data.co3d import SequenceData, write_co3d
from zsp_lite.data.frames import ON_OBJECT
from zsp_lite.errors import InputError
from zsp_lite.importers.capture import CaptureFrame, evenly_spaced, files_by_stem
from zsp_lite.importers.fusion import fuse, scale_frame
from zsp_lite.importers.lists import read_lists
from zsp_lite.importers.mask_flags import mask_flags
from zsp_lite.importers.masks import masks_from_box
from zsp_lite.importers.nerfstudio import read_nerfstudio
from zsp_lite.io.files import plain_name
from zsp_lite.io.locks import writing
from zsp_lite.points import unit_scale

READERS: dict[str, Callable[..., list[CaptureFrame]]] = {"nerfstudio": read_nerfstudio, "lists": read_lists}
_SIGNS = {"nerfstudio": "transforms.json", "lists": "poses.txt"}  # files by which a format is recognised


def capture_format(folder: str | Path) -> str:
    """Return the name in `READERS` of a capture's format, by the names of its files; InputError if there is none."""
    for name, sign in _SIGNS.items():
        if (Path(folder) / sign).is_file():
            return name
    files = ", ".join(f"{sign} ({name})" for name, sign in _SIGNS.items())
    raise InputError(
        f"folder {folder} is neither CATEGORY/SEQUENCE of a data folder nor a capture, expected one of its files "
        f"{files}; `zsp-lite data import --help` lists what each format holds"
    )


@dataclass(frozen=True)
class ImportResult:
    """Numbers of frames and points of an import."""

    frames: int
    empty: int  # frames that were left out because their masks are empty
    points: int
    scale: float  # factor from the capture's lengths to those of the sequence
    flags: tuple[str, ...]  # what speaks against the masks


def import_capture(
    capture: Sequence[CaptureFrame],
    root: str | Path,
    category: str,
    sequence: str,
    box: Box | None = None,
    masks: str | Path | None = None,
    max_frames: int = 100,
) -> ImportResult:
    """Write a capture as the sequence ROOT/CATEGORY/SEQUENCE, with masks and a fused point cloud.

    Lengths are scaled so that the point cloud has unit standard deviation, averaged over the axes, as in CO3D. Frames
    whose mask is empty are left out. An interrupted import can be repeated.

    Args:
        capture: Frames of one reader in `READERS`.
        root: The data folder, new or existing.
        category: Name of the category.
        sequence: Name of the new sequence.
        box: Bounding box (top, left, height, width) of the object in the first frame, pixels (see `masks_from_box`).
        masks: Folder of mask files, named like the images. Without it and a box, the masks of the capture are used.
        max_frames: Maximum number of frames, evenly spaced; CO3D's sequences have about 100.

    Raises:
        InputError: The capture cannot be read, segmented or fused, the sequence exists, or another process imports into
            the folder. Nothing is written then.
    """
    folder = Path(root) / plain_name(category, "category") / plain_name(sequence, "sequence")
    unfinished = folder / ".unfinished"
    if folder.exists() and not unfinished.is_file():
        raise InputError(f"{folder} exists already, expected another sequence name")
    if box is not None and masks is not None:
        raise InputError("both a box and a folder of masks are given, expected one of them")
    capture = evenly_spaced(capture, max_frames)
    if masks is not None:
        files = files_by_stem(masks)
        if missing := [frame.image.stem for frame in capture if frame.image.stem not in files]:
            raise InputError(f"folder {masks} has no mask {missing[0]}.png, expected one named like each image")
        capture = [replace(frame, mask=files[frame.image.stem]) for frame in capture]
    frames = [frame.load() for frame in capture]
    if box is not None:
        frames = masks_from_box(frames, box)
    if any(frame.mask is None for frame in frames):
        raise InputError(
            "the capture has no masks of its own, expected a box in its first picture (--box TOP,LEFT,HEIGHT,WIDTH) or "
            "a folder of masks (--masks DIR)"
        )
    seen = [index for index, frame in enumerate(frames) if (frame.mask > ON_OBJECT).any()]
    if not seen:
        raise InputError(f"the masks of all {len(frames)} frames are empty, expected an object")
    empty, frames = len(frames) - len(seen), [frames[index] for index in seen]
    flags = mask_flags(frames) if box is not None else ()
    points, colours, normals = fuse(frames)
    scale = unit_scale(points)
    scaled = [replace(scale_frame(frame, scale), name="") for frame in frames]
    data = SequenceData(sequence, scaled, [float(index) for index in seen], points * scale, colours, normals)
    with writing(root):
        folder.mkdir(parents=True, exist_ok=True)
        unfinished.touch()
        write_co3d(root, category, [data])
        unfinished.unlink()
    return ImportResult(len(frames), empty, len(points), scale, flags)
