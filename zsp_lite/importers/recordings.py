"""Recordings of colours and registered depth without poses, which Open3D finds.

RGB-D odometry joins each frame to one before it, and a pose graph with loop closures distributes
the drift (Choi, Zhou and Koltun 2015).
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from zsp_lite.data.arrays import undistort
from zsp_lite.data.cameras import Values
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError, real_array
from zsp_lite.importers import files
from zsp_lite.importers.capture import (
    HALF_PIXEL,
    PRIMESENSE,
    CaptureFrame,
    Makers,
    make_frame,
    refuse,
)
from zsp_lite.io.files import read_json
from zsp_lite.metrics import rotation_angle
from zsp_lite.points import world_points

RECORDED = "[rc]*[br]"  # pattern of the images' folder, rgb or color
_MOST = 600  # of more frames, every second one is tracked, or every third, ...
_LONGEST_SIDE = 320  # pixels of the images that are tracked
_BACK = 3  # a frame is joined to one of so many before it
_FARTHEST = 4.0  # greater depth is not used, relative to the mean depth of the first frame
# Frames are joined if their details, finer than the first number in pixels, have at least this
# correlation. On renderings, it is above 0.66 for right motions between neighbours.
_DETAIL = 8
_ALIKE = 0.6
# So many loops are closed, between frames that are turned by at most this angle in degrees, at
# least this part of the recording apart.
_LOOPS = 60
_ANGLE = 15
_APART = 1 / 6


def read_recording(
    folder: Path, intrinsics: Values | None = None, attributes: Mapping[str, Any] = {}
) -> Makers:
    """Read the pairs in rgb/ or color/ and depth/, and find their poses.

    `attributes` are of `CaptureFrame`. Frames that cannot be joined to the others are left out.
    """
    images = _numbered(folder, RECORDED)
    depths = _numbered(folder, "depth")
    image = min(images.values())  # any of them tells
    if intrinsics is not None:
        camera = {"intrinsics": intrinsics}
    elif any(folder.glob("*intrinsic.json")):
        camera = open3d_camera(folder)
    # Redwood's images are named FRAME-TIME.
    elif re.fullmatch(r"\d+-\d+", image.stem) and files.picture_size(image) == (480, 640):
        camera = PRIMESENSE
    else:
        raise InputError(
            f"{folder} has no intrinsics, expected --intrinsics FX,FY,CX,CY in pixels, or Open3D's "
            "intrinsic.json"
        )
    # The numbers are of frames or times: an image and its depth have the same, or nearly. They
    # differ by at most 3/4 of the mean distance between images.
    numbers = np.array([*depths])
    farthest = 0.75 * np.ptp([*images]) / len(images)
    makers = []
    for number, image in images.items():
        nearest = numbers[np.abs(numbers - number).argmin()]
        if abs(nearest - number) > farthest:
            yield partial(refuse, f"{image}: no depth of its number in {folder}/depth")
        else:
            makers.append(
                partial(
                    make_frame,
                    folder,
                    image,
                    depths[nearest],
                    where=str(image),
                    **camera,
                    **attributes,
                )
            )
    step = max(1, -(-len(makers) // _MOST))  # rounded up
    yield from _track(makers[::step], f"{folder.name}, 1 of {step} frames")


def _numbered(folder: Path, name: str) -> dict[float, Path]:
    """Return the pictures of a folder by the numbers at the end of their names, in this order."""
    numbered = {}
    for path in sorted(folder.glob(f"{name}/*")):
        number = re.search(r"\d+(\.\d+)?$", path.stem)
        if number and path.suffix.lower() in files.PICTURES:
            other = numbered.setdefault(float(number[0]), path)
            if other != path:
                raise InputError(f"{other} and {path} have one number, expected one picture of it")
    if not numbered:
        raise InputError(f"{folder}: no picture with a number in rgb/ or depth/, expected 0001.png")
    return dict(sorted(numbered.items()))


def open3d_camera(folder: Path) -> dict[str, Any]:
    """Read the intrinsics, stored in column-major order, and the distortion of Open3D's
    recorders."""
    path = max(folder.glob("*intrinsic.json"))  # Open3D's examples write camera_intrinsic.json
    camera = read_json(path, dict[str, Any], "capture")
    matrix = real_array(f"{path}: intrinsic_matrix", camera.get("intrinsic_matrix"), (9,))
    return {
        "intrinsics": matrix.reshape(3, 3).T + HALF_PIXEL,
        # RealSense's coefficients, which its SDK applies like OpenCV's k1, k2, p1, p2, k3.
        "distortion": camera.get("coeffs", ()),
    }


def _track(makers: list[Callable[..., CaptureFrame]], name: str) -> Makers:
    """Find the poses of the frames, which the makers lack, of a recording with a name."""
    import open3d as o3d

    registration = o3d.pipelines.registration
    still = np.eye(4)
    unit = 0.0  # mean depth of the first frame, the unit of all lengths until the end

    @lru_cache(_BACK + 1)
    def read(position: int) -> tuple[Frame, Any, np.ndarray]:
        """Read a small copy of a frame as it is stored, and of its details for comparison."""
        nonlocal unit
        frame = makers[position](still)
        rgb, _ = files.read_picture(frame.image)
        scale = min(1, _LONGEST_SIDE / max(rgb.shape))
        rgb = cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        camera = frame.camera.resize(rgb.shape[:2])
        depth = files.read_depth_file(frame.depth) * frame.depth_unit
        if not depth.any():
            raise InputError(f"{frame.depth} has no known depth")
        unit = unit or float(depth[depth > 0].mean())
        depth = cv2.resize(depth / unit, camera.size[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
        small = undistort(Frame(rgb, depth, None, camera), frame.distortion)
        images = map(o3d.geometry.Image, (small.rgb, small.depth))
        pair = o3d.geometry.RGBDImage.create_from_color_and_depth(
            *images, depth_scale=1.0, depth_trunc=_FARTHEST
        )
        grey = small.rgb.mean(axis=2)
        return small, pair, grey - cv2.GaussianBlur(grey, (0, 0), _DETAIL)

    edges = []

    def join(first: int, second: int, guess: np.ndarray) -> np.ndarray | None:
        """Find the motion between two cameras, None if their details do not agree by it."""
        frame, pair, details = read(first)
        other, other_pair, other_details = read(second)
        width_height = other.camera.size[::-1]
        odometry = o3d.pipelines.odometry
        # By colours alone: if depth counts, smooth surfaces slow the convergence.
        _, motion, information = odometry.compute_rgbd_odometry(
            pair,
            other_pair,
            o3d.camera.PinholeCameraIntrinsic(*width_height, other.camera.K - HALF_PIXEL),
            guess,
            odometry.RGBDOdometryJacobianFromColorTerm(),
        )
        if np.isnan(motion).any():  # of images without details, as is their correlation
            return None
        moved = replace(other.camera, R=motion[:3, :3], t=motion[:3, 3])
        known = frame.depth > 0
        with np.errstate(invalid="ignore"):
            pixels, _ = moved.project(world_points(frame, known))
            columns, rows = pixels.astype(int).clip(0, np.subtract(width_height, 1)).T
            alike = np.corrcoef(details[known], other_details[rows, columns])[0, 1]
        if not alike > _ALIKE:
            return None
        edges.append((first, second, motion, information, second - first > _BACK))
        return motion

    # A part of the recording has the poses, camera to world, of frames that are joined.
    parts = []
    seen = []
    guess = still
    for position in tqdm(range(len(makers)), f"tracking {name}", disable=None):
        try:
            read(position)
        except InputError as error:
            yield partial(refuse, str(error))
            continue
        for before, part in seen[: -_BACK - 1 : -1]:  # the latest first
            motion = join(before, position, guess)
            if motion is not None:
                guess = motion
                part[position] = part[before] @ np.linalg.inv(motion)
                break
        else:
            part = {position: still}
            parts.append(part)
        seen.append((position, part))
    if not parts:
        return
    longest = max(parts, key=len)
    for part in parts:
        if part is not longest:
            image = makers[min(part)].args[1]  # as `read_recording` gives it to `make_frame`
            problem = (
                f"the recording breaks: from {image} on, {len(part)} of {len(makers)} do not join "
                "the others (fast motion, plain surfaces, wrong intrinsics, depth of another time)"
            )
            yield from [partial(refuse, problem)] * len(part)

    # Close loops, and distribute the drift.
    order = np.array([*longest])
    poses = np.array([*longest.values()])
    turns = poses[:, :3, :3]
    alike = rotation_angle(turns[:, None], turns) < _ANGLE
    loops = np.argwhere(alike & (order - order[:, None] > _BACK + _APART * len(makers)))
    loops = loops[:: len(loops) // _LOOPS + 1]
    for early, late in order[loops].tolist():
        join(early, late, np.linalg.inv(longest[late]) @ longest[early])
    graph = registration.PoseGraph()
    graph.nodes.extend(map(registration.PoseGraphNode, poses))
    for first, second, *edge in edges:
        if first in longest:
            ends = np.searchsorted(order, (first, second))
            graph.edges.append(registration.PoseGraphEdge(*ends, *edge))
    registration.global_optimization(
        graph,
        registration.GlobalOptimizationLevenbergMarquardt(),
        registration.GlobalOptimizationConvergenceCriteria(),
        registration.GlobalOptimizationOption(reference_node=0),
    )
    # Open3D has removed loops that contradict the rest.
    closed = sum(edge.uncertain for edge in graph.edges)
    doubt = makers[0].keywords.get("doubt", "")
    if closed < len(loops) / 4:
        drift = f"the poses may drift: {closed} of {len(loops)} loops close"
        doubt = f"{doubt}; {drift}" if doubt else drift
    for position, node in zip(order, graph.nodes):
        # The translation, the last column, back in the units of the depth.
        yield partial(makers[position], node.pose[:3] * [1, 1, 1, unit], doubt=doubt)
