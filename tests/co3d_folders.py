"""Small random sequences and cameras for the tests of reading and writing."""

import gzip
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
from hypothesis import strategies as st
from numpy.random import default_rng
from scipy.spatial.transform import Rotation

from zsp_lite import Camera, Frame
from zsp_lite.data.labels import PoseLabel
from zsp_lite.data.writing import SequenceData, write_co3d, write_label

seeds = st.integers(0, 2**32 - 1)


def random_camera(seed: int = 0, size: tuple[int, int] | None = None) -> Camera:
    """A random camera with unequal focal lengths."""
    rng = default_rng(seed)
    size = size or tuple(int(side) for side in rng.integers(8, 2000, 2))
    rotation = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    focal = rng.uniform(0.5, 3, 2) * max(size)
    return Camera(
        rotation, rng.normal(size=3) * 3, focal, rng.uniform(0.2, 0.8, 2) * size[::-1], size
    )


def sequence_data(
    name: str, frames: int = 4, seed: int = 0, quality: float = 1.0, **options
) -> SequenceData:
    """A sequence of views of 24 x 32 pixels: a smooth picture, a disc as mask, random depth with a
    hole; `quality` is that of the point cloud."""
    rng = default_rng([seed, *name.encode()])
    height, width = 24, 32
    y, x = np.mgrid[:height, :width]
    made = []
    for number in range(frames):
        camera = random_camera(int(rng.integers(2**31)), (height, width))
        rgb = np.stack([8 * x % 256, 10 * y % 256, np.full_like(x, 40 * number)], axis=-1).astype(
            np.uint8
        )
        depth = rng.uniform(1, 4, (height, width)).astype(np.float32)
        depth[5:12, 3 : 9 + number] = 0
        mask = ((y - 12) ** 2 + (x - 16) ** 2 < 64).astype(np.float32)
        made.append(Frame(rgb, depth, mask, camera))
    points = rng.normal(size=(50, 3))
    colours = rng.integers(0, 256, (50, 3)).astype(np.uint8)
    times = [0.2 * number for number in range(frames)]
    # No normals; views of quality 2 are good enough for `Co3D.select`.
    return SequenceData(name, made, times, points, colours, None, 2.0, quality, **options)


def write_category(root: Path, category: str, names: Iterable[str], **options) -> None:
    """Write small random sequences."""
    write_co3d(root, category, [sequence_data(name, **options) for name in names])


def write_identities(root: Path, category: str, names: Sequence[str]) -> None:
    """Write labels by which all sequences are in the world of the first one."""
    for name in names:
        write_label(root, category, PoseLabel(np.eye(4), name, names[0]))


def contents(folder: Path) -> dict[str, bytes]:
    """The files of a folder by their paths in it."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def edit_json(path: Path, change: Callable) -> None:
    """Rewrite a gzipped JSON file with its content changed: by what `change` returns, or in place
    where it returns None."""
    content = json.loads(gzip.decompress(path.read_bytes()))
    changed = change(content)
    content = content if changed is None else changed
    path.write_bytes(gzip.compress(json.dumps(content, default=np.ndarray.tolist).encode()))


def convert_to_v2(folder: Path) -> None:
    """Rewrite the cameras of a category in the format of CO3D v2, with the fields that only
    v2 has."""

    def convert(frames):
        for frame in frames:
            camera = Camera.from_pytorch3d(
                **frame["viewpoint"],
                intrinsics_format="ndc_norm_image_bounds",
                size=tuple(frame["image"]["size"]),
            )
            frame["viewpoint"] = camera.to_pytorch3d("ndc_isotropic")
            frame["meta"] = {"frame_splits": ["train"], "eval_batch_maps": []}

    edit_json(folder / "frame_annotations.jgz", convert)
