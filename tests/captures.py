"""Captures on disk, written from rendered views, for the tests of whatever reads captures."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from zsp_lite import Camera, Frame
from zsp_lite.course.synthetic.export import make_object
from zsp_lite.course.synthetic.sequences import render_sequence
from zsp_lite.data.writing import write_image, write_mask

# From pixel centres at half integers to OpenCV's at integers.
HALF_PIXEL = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
METRES = 0.13  # per unit of the rendered world: the object is about 30 cm wide


def hairdryer_views() -> list[Frame]:
    """Eight views around a hairdryer, in metres."""
    shape = make_object("hairdryer", 0, 4)  # index and seed
    exact, _ = render_sequence(shape, np.random.default_rng(2), 8, 96)  # 96 pixels high
    frames = []
    for view in exact:
        camera = replace(view.camera, t=view.camera.t * METRES)
        depth = (view.depth * METRES).astype(np.float32)
        frames.append(
            Frame(view.rgb, depth, view.mask.astype(np.float32), camera, f"{len(frames):04d}")
        )
    return frames


def to_world(frame: Frame) -> np.ndarray:
    """The pose of a frame's camera, camera-to-world (4, 4)."""
    return np.linalg.inv(frame.camera.matrix)


def write_depth16(path: Path, depth: np.ndarray) -> None:
    """Write a depth map in metres as millimetres in 16 bits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.rint(1000 * depth).astype(np.uint16))


def write_nerfstudio(folder: Path, frames: list[Frame]) -> None:
    """Write a capture of nerfstudio."""
    camera = frames[0].camera
    (fx, fy), (cx, cy), (h, w) = camera.focal_length, camera.principal_point, camera.size
    listed = []
    for frame in frames:
        write_image(folder / f"images/{frame.name}.jpg", frame.rgb, 95)
        write_depth16(folder / f"depths/{frame.name}.png", frame.depth)
        write_mask(folder / f"masks/{frame.name}.png", frame.mask)
        pose = to_world(frame) @ np.diag([1.0, -1, -1, 1])  # OpenGL: +y up, looking along -z
        listed.append(
            {
                "file_path": f"images/{frame.name}.jpg",
                "depth_file_path": f"depths/{frame.name}.png",
                "mask_path": f"masks/{frame.name}.png",
                "transform_matrix": pose.tolist(),
            }
        )
    content = dict(camera_model="OPENCV", fl_x=fx, fl_y=fy, cx=cx, cy=cy, w=w, h=h, frames=listed)
    (folder / "transforms.json").write_text(json.dumps(content))


def write_lists(folder: Path, frames: list[Frame], masks: bool = False) -> Path:
    """Write a capture as lists of images, depth maps and poses; returns its folder."""
    names, depths, poses = [], [], []
    for frame in frames:
        names.append(f"pictures/{frame.name}.jpg")
        depths.append(f"z/{frame.name}.npy")
        poses.append(" ".join(f"{value:.9f}" for value in to_world(frame)[:3].ravel()))
        write_image(folder / names[-1], frame.rgb, 95)
        (folder / "z").mkdir(exist_ok=True)
        np.save(folder / depths[-1], np.rint(frame.depth * 1000).astype(np.uint16))
        if masks:
            write_mask(folder / f"masks/{frame.name}.png", frame.mask)
    for name, rows in (("rgb.txt", names), ("depth.txt", depths), ("poses.txt", poses)):
        (folder / name).write_text("\n".join(rows) + "\n")
    np.savetxt(folder / "intrinsics.txt", frames[0].camera.K)
    return folder


def edited(*changes, encoding="utf-8", name="transforms.json"):
    """Return a function that changes transforms.json in a folder and returns the folder.

    A file of another `name` is changed instead; if there is none, transforms.json becomes it.
    """

    def apply(folder):
        source = folder / (name if (folder / name).is_file() else "transforms.json")
        content = json.loads(source.read_text())
        for change in changes:
            change(content)
        source.unlink()
        (folder / name).write_text(json.dumps(content), encoding=encoding)
        return folder

    return apply


def straight_places(camera: Camera, distortion: list[float], undistort=cv2.undistortPoints):
    """The place (x, y) of each pixel, and its place without the distortion by OpenCV; centres are
    integers."""
    rows, columns = np.indices(camera.size, np.float64)
    places = np.stack([columns, rows], axis=-1)
    K = camera.K - HALF_PIXEL
    straight = undistort(places.reshape(-1, 1, 2), K, np.array(distortion), R=np.eye(3), P=K)
    return places, straight.reshape(places.shape)
