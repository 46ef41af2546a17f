"""A capture of any known format as a sequence of a data folder in CO3D's layout."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from zsp_lite.data.cameras import Box
from zsp_lite.data.co3d import SequenceData, write_co3d
from zsp_lite.errors import InputError
from zsp_lite.importers.capture import Capture
from zsp_lite.importers.fusion import fuse, scale_frame, unit_scale
from zsp_lite.importers.lists import read_lists
from zsp_lite.importers.masks import masks_from_box, masks_from_files
from zsp_lite.importers.nerfstudio import read_nerfstudio
from zsp_lite.importers.open3d_folder import read_open3d
from zsp_lite.importers.tum import read_tum
from zsp_lite.io.files import plain_name

READERS: dict[str, Callable[..., Capture]] = {
    "tum": read_tum,
    "nerfstudio": read_nerfstudio,
    "open3d": read_open3d,
    "lists": read_lists,
}
MAX_FRAMES = 100  # about as many as CO3D's sequences have


@dataclass(frozen=True)
class Imported:
    """What came in.  empty: frames left out, for their masks show no object.  scale: of the capture's lengths."""

    frames: int
    empty: int
    points: int
    scale: float


def import_capture(
    capture: Capture,
    root: str | Path,
    category: str,
    sequence: str,
    box: Box | None = None,
    masks: str | Path | None = None,
    max_frames: int = MAX_FRAMES,
) -> Imported:
    """Write a capture as `root/category/sequence`: masks, a fused cloud, all scaled as CO3D's are.

    box: of the object in the first frame (top, left, height, width), for GrabCut; or masks: a folder of mask files;
    neither: the capture's own masks. Frames whose mask is empty are left out. The same import goes on where
    one was interrupted. Raises InputError, before anything is written, on what cannot be read, masked or
    fused, and where the folder has a sequence of that name already: labels may belong to it.
    """
    plain_name(category, "category"), plain_name(sequence, "sequence")
    folder = Path(root) / category / sequence
    unfinished = folder / ".unfinished"
    if folder.exists() and not unfinished.is_file():
        raise InputError(f"{folder} is there already, expected another sequence name")
    capture = capture.thinned(max_frames)
    frames = [shot.load() for shot in capture.shots]
    if box is not None and masks is not None:
        raise InputError("both a box and a folder of masks are given, expected one of them")
    if box is not None:
        frames = masks_from_box(frames, box)
    elif masks is not None:
        frames = masks_from_files(frames, masks)
    elif any(frame.mask is None for frame in frames):
        raise InputError(
            "the capture has no masks of its own, expected a box in its first picture or a folder of masks"
        )
    seen = [index for index, frame in enumerate(frames) if (frame.mask > 0.5).any()]
    if not seen:
        raise InputError(f"the masks of all {len(frames)} frames are empty, expected an object in them")
    empty, frames = len(frames) - len(seen), [frames[index] for index in seen]
    points, colours, normals = fuse(frames)
    scale = unit_scale(points)
    scaled = [replace(scale_frame(frame, scale), name="") for frame in frames]
    times = [capture.shots[index].time - capture.shots[0].time for index in seen]
    data = SequenceData(sequence, scaled, times, points * scale, colours, normals)
    folder.mkdir(parents=True, exist_ok=True)
    unfinished.touch()
    write_co3d(root, category, [data])
    unfinished.unlink()
    return Imported(len(frames), empty, len(points), scale)
