"""Recordings of colours and registered depth without poses, which Open3D finds.

RGB-D odometry joins each frame to one before it, and a pose graph with loop closures distributes
the drift (Choi, Zhou and Koltun 2015).
"""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import lru_cache, partial
from itertools import repeat
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from zsp_lite.data.cameras import Values
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError, real_array
from zsp_lite.importers import files
from zsp_lite.importers.capture import HALF_PIXEL, CaptureFrame, Makers, make_frame, refuse
from zsp_lite.io.files import read_json
from zsp_lite.metrics import rotation_angle
from zsp_lite.points import world_points

RECORDED = "[rc]*[br]"  # pattern of the images' folder, rgb or color
# The camera of "A Large Dataset of Object Scans", whose images are named FRAME-TIME.
_REDWOOD = (525.0, 525.0, 320.0, 240.0)  # pixel centres at half-integers
_MOST = 600  # of more frames, every second one is tracked, or every third, ...
_LONGEST_SIDE = 320  # pixels of the images that are tracked
_BACK = 3  # a frame is joined to one of so many before it
_FARTHEST = 4.0  # greater depth is not used, relative to the mean depth of the first frame
# Frames are joined if their details, finer than the first number in pixels, have at least this
# correlation after the motion. On renderings, it is above 0.66 for right motions between neighbours.
_DETAIL = 8
_ALIKE = 0.6
# Loops are closed between so many frames: from each to that of the most similar rotation, at most
# this angle in degrees away, with at least this part of the recording in between.
_KEY_FRAMES = 40
_ANGLE = 15
_APART = 1 / 6


def read_recording(
    folder: Path, intrinsics: Values | None = None, attributes: Mapping[str, Any] = {}
) -> Makers:
    """Read the pairs in rgb/ or color/ and depth/, and find their poses.

    `attributes` are of `CaptureFrame`. Frames that cannot be joined to the others are left out.
    """
    images = _numbered(folder.glob(f"{RECORDED}/*"), folder)
    depths = _numbered(folder.glob("depth/*"), folder)
    if intrinsics is None:
        intrinsics = _known_intrinsics(folder, min(images.values()))
    # The numbers are of frames or times: an image and its depth have the same, or nearly.
    numbers = np.array([*depths])
    makers = []
    for number, image in images.items():
        nearest = numbers[np.abs(numbers - number).argmin()]
        if abs(nearest - number) > 0.75 * np.ptp(numbers) / len(numbers):
            yield partial(refuse, f"{image}: no depth of its number in {folder}/depth")
            continue
        options = {"intrinsics": intrinsics, "where": str(image), **attributes}
        makers.append(partial(make_frame, folder, image, depths[nearest], **options))
    step = -(-len(makers) // _MOST)
    yield from _track(makers[::step], f"{folder.name}, 1 of {step} frames")


def _numbered(paths: Iterable[Path], folder: Path) -> dict[float, Path]:
    """Return pictures by the numbers at the end of their names, in this order."""
    numbered = {}
    for path in paths:
        number = re.search(r"\d+(\.\d+)?$", path.stem)
        if number and path.suffix.lower() in files.PICTURES:
            numbered[float(number[0])] = path
    if not numbered:
        raise InputError(f"{folder}: no picture with a number in rgb/ or depth/, expected 0001.png")
    return dict(sorted(numbered.items()))


def _known_intrinsics(folder: Path, image: Path) -> Values:
    """Return the intrinsics of Open3D's file, or those of Redwood."""
    if (folder / "intrinsic.json").is_file():
        return open3d_matrix(folder)
    if re.fullmatch(r"\d+-\d+", image.stem) and files.picture_size(image) == (480, 640):
        return _REDWOOD
    raise InputError(
        f"{folder} has no intrinsics, expected --intrinsics FX,FY,CX,CY in pixels, or Open3D's "
        "intrinsic.json"
    )


def open3d_matrix(folder: Path) -> Float[np.ndarray, "3 3"]:
    """Read the intrinsics of Open3D's recorders, which are stored in column-major order."""
    path = folder / "intrinsic.json"
    camera = read_json(path, dict[str, Any], "capture")
    matrix = real_array(f"{path}: intrinsic_matrix", camera.get("intrinsic_matrix"), (9,))
    return matrix.reshape(3, 3).T + HALF_PIXEL


def _track(makers: list[Callable[..., CaptureFrame]], name: str) -> Makers:
    """Find the poses of the frames, which the makers lack, of a recording with a name."""
    import open3d as o3d

    registration = o3d.pipelines.registration
    motion = still = np.eye(4)
    unit = 0.0

    @lru_cache(_BACK + 1)
    def read(position: int) -> Frame:
        """Read a small copy of a frame as it is stored, in units of the first one's mean depth."""
        nonlocal unit
        frame = makers[position](still)
        rgb, _ = files.read_picture(frame.image)
        depth = files.read_depth_file(frame.depth) * frame.depth_unit
        unit = unit or depth.sum() / max(1, np.count_nonzero(depth))
        camera = frame.camera
        shrink = max(1, *np.divide(camera.size, _LONGEST_SIDE))
        camera = camera.resize([round(side / shrink) for side in camera.size])
        size = camera.size[::-1]
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        depth = cv2.resize(depth / unit, size, interpolation=cv2.INTER_NEAREST_EXACT)
        return Frame(rgb, depth, None, camera)

    # A part of the recording has the poses, world to camera, of frames that are joined.
    parts = []
    seen = []
    edges = []
    for position in tqdm(range(len(makers)), f"tracking {name}", disable=None):
        try:
            frame = read(position)
        except InputError as error:
            yield partial(refuse, str(error))
            continue
        for before, part in seen[: -_BACK - 1 : -1]:
            found = _motion(read(before), frame, motion)
            if found:
                motion, _ = found
                part[position] = motion @ part[before]
                edges.append((before, position, *found, False))
                break
        else:
            part = {position: still}
            parts.append(part)
        seen.append((position, part))
    longest = max(parts, key=len, default={})
    for part in parts:
        if part is not longest:
            image = makers[min(part)].args[1]
            problem = f"the recording breaks: {len(part)} frames from {image} on do not join"
            yield from repeat(partial(refuse, problem), len(part))

    # Close loops.
    order = [*longest]
    keys = order[:: -(-len(order) // _KEY_FRAMES)]
    loops = 0
    for late in keys:
        angles = {
            rotation_angle(longest[early][:3, :3], longest[late][:3, :3]): early
            for early in keys
            if late - early > _APART * len(makers)
        }
        nearest = min(angles, default=_ANGLE)
        if nearest < _ANGLE:
            loops += 1
            early = angles[nearest]
            found = _motion(read(early), read(late), longest[late] @ np.linalg.inv(longest[early]))
            if found:
                edges.append((early, late, *found, True))

    # Distribute the drift.
    graph = registration.PoseGraph()
    for pose in longest.values():
        graph.nodes.append(registration.PoseGraphNode(np.linalg.inv(pose)))
    for first, second, *edge in edges:
        if first in longest:
            ends = order.index(first), order.index(second)
            graph.edges.append(registration.PoseGraphEdge(*ends, *edge))
    registration.global_optimization(
        graph,
        registration.GlobalOptimizationLevenbergMarquardt(),
        registration.GlobalOptimizationConvergenceCriteria(),
        registration.GlobalOptimizationOption(reference_node=0),
    )
    # Open3D has removed loops that contradict the rest.
    closed = sum(edge.uncertain for edge in graph.edges)
    doubt = f"the poses may drift: {closed} of {loops} loops close" if closed < loops / 2 else ""
    for position, node in zip(order, graph.nodes):
        yield partial(makers[position], node.pose[:3] * [1, 1, 1, unit], doubt=doubt)


def _motion(
    first: Frame, second: Frame, guess: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"]] | None:
    """Find the motion between two cameras and its information, None if the images disagree."""
    import open3d as o3d

    camera = first.camera
    odometry = o3d.pipelines.odometry
    # By colours alone: with depth, it moves too little from frame to frame where depth is smooth.
    _, motion, information = odometry.compute_rgbd_odometry(
        *(
            o3d.geometry.RGBDImage.create_from_color_and_depth(
                o3d.geometry.Image(frame.rgb), o3d.geometry.Image(frame.depth), 1.0, _FARTHEST
            )
            for frame in (first, second)
        ),
        o3d.camera.PinholeCameraIntrinsic(*camera.size[::-1], camera.K - HALF_PIXEL),
        guess,
        odometry.RGBDOdometryJacobianFromColorTerm(),
    )
    known = first.depth > 0
    camera = replace(camera, R=motion[:3, :3], t=motion[:3, 3])
    pixels, _ = camera.project(world_points(first, known))
    columns, rows = pixels.astype(int).clip(0, np.subtract(camera.size[::-1], 1)).T
    values = _details(first)[known], _details(second)[rows, columns]
    return (motion, information) if np.corrcoef(*values)[0, 1] > _ALIKE else None


def _details(frame: Frame) -> Float[np.ndarray, "h w"]:
    """Return the brightness without what is larger than details."""
    grey = frame.rgb.mean(axis=2)
    return grey - cv2.GaussianBlur(grey, (0, 0), _DETAIL)
