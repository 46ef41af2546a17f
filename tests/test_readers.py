"""Scans in the layouts of apps and depth cameras, made of rendered frames: which are read, which
are refused, and which frames are left out."""

import json
import re
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import lzfse
import numpy as np
import pandas as pd
import pytest
from captures import (
    HALF_PIXEL,
    edited,
    hairdryer_views,
    to_world,
    write_depth16,
    write_lists,
    write_nerfstudio,
)
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused
from scipy.spatial.transform import Rotation
from synthetic_views import look_at

from zsp_lite import open_source
from zsp_lite.data.frames import with_images
from zsp_lite.data.writing import write_image, write_mask
from zsp_lite.importers import open_capture, recognise
from zsp_lite.importers.capture import find_masks, trusted
from zsp_lite.importers.sources import spread_views
from zsp_lite.importers.unpacked import Video

# All writers take a folder and frames; they return the path of the scan.
# OpenGL's axes of a camera in OpenCV's: x is the same, y and z are opposite.
OPENGL = np.diag([1.0, -1, -1, 1])
CERTAIN = 2  # the highest level of confidence, of 0 to 2
# Columns of Stray Scanner; the next two are empty.
ODOMETRY = "timestamp frame x y z qx qy qz qw fx fy cx cy".split()
DISTORTION = [-0.3, 0.1, 0.002, -0.001, 0.02]  # k1, k2, p1, p2, k3
OTHER_FOCUS = np.diag([1.1, 1.1, 1])  # times a camera's matrix


@pytest.fixture(scope="module")
def views():
    """Four frames of a rendered hairdryer."""
    return hairdryer_views()[:4]


def write_files(
    folder, frames, images="images/{}.jpg", depths="depth/{}.png", unit=0.001, masks="masks/{}.png"
):
    """Write the images, the masks, and the depth in a unit of metres as 16 bits, of frames by their
    numbers."""
    for k, frame in enumerate(frames):
        number = f"{k:06d}"
        write_image(folder / images.format(number), frame.rgb, quality=95)
        values = np.rint(frame.depth / unit)
        # 0, unknown, where 16 bits do not hold the depth; write_depth16 stores millimetres.
        stored = np.where(values < 65536, values, 0)
        write_depth16(folder / depths.format(number), stored / 1000)
        write_mask(folder / masks.format(number), frame.mask)


def write_confidence(folder, frames):
    """Write maps of the highest confidence."""
    for k, frame in enumerate(frames):
        folder.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / f"{k:06d}.png"), np.full(frame.camera.size, CERTAIN, np.uint8))


def quaternion(pose: np.ndarray) -> list[float]:
    """The rotation of a pose as x, y, z, w."""
    return Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()


def write_video(path, images):
    """Write images as a video of 30 frames per second."""
    height, width = images[0].shape[:2]
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), 30, (width, height))
    for image in images:
        video.write(image[..., ::-1])
    video.release()


def write_stray(folder, frames):
    """The layout of Stray Scanner: poses in a table, 60 per second; K of another focus."""
    write_files(folder, frames)
    write_confidence(folder / "confidence", frames)
    write_video(folder / "rgb.mp4", [frame.rgb for frame in frames])
    np.savetxt(folder / "camera_matrix.csv", OTHER_FOCUS @ frames[0].camera.K, delimiter=", ")
    rows = []
    for k, frame in enumerate(frames):
        pose = to_world(frame)
        camera = (*frame.camera.focal_length, *frame.camera.principal_point)
        rows.append([k / 60, k, *pose[:3, 3], *quaternion(pose), *camera])
    header = ", ".join([*ODOMETRY, "distortion_center_x", "distortion_center_y"])
    form = len(ODOMETRY) * "%.9g, " + ", "  # two empty columns
    np.savetxt(folder / "odometry.csv", rows, form, header=header, comments="")
    return folder


def write_polycam(folder, frames):
    """The layout of Polycam's raw data: a JSON file for each camera."""
    inside = folder / "keyframes"
    write_files(inside, frames, images="corrected_images/{}.jpg", masks="../masks/{}.png")
    write_confidence(inside / "confidence", frames)
    (inside / "corrected_cameras").mkdir()
    for k, frame in enumerate(frames):
        pose = to_world(frame) @ OPENGL
        fx, fy = frame.camera.focal_length
        cx, cy = frame.camera.principal_point
        camera = {f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)}
        camera |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "blur_score": 1.5}
        (inside / f"corrected_cameras/{k:06d}.json").write_text(json.dumps(camera))
    (inside / "cameras").mkdir()
    return folder


def write_record3d(folder, frames):
    """The layout of Record3D: a zip with depth and confidence compressed by LZFSE."""
    height, width = frames[0].camera.size
    poses = [to_world(frame) @ OPENGL for frame in frames]
    metadata = {
        "dw": width,
        "dh": height,
        "K": frames[0].camera.K.T.ravel().tolist(),
        "poses": [[*quaternion(pose), *pose[:3, 3]] for pose in poses],
    }
    (folder / "metadata").write_text(json.dumps(metadata))
    for k, frame in enumerate(frames):
        write_image(folder / f"rgbd/{k}.jpg", frame.rgb, quality=95)
        write_mask(folder / f"masks/{k}.png", frame.mask)
        depth = np.where(frame.depth > 0, frame.depth, np.nan)
        confidence = np.full(depth.shape, CERTAIN, np.uint8)
        for name, values in (("depth", depth), ("conf", confidence)):
            (folder / f"rgbd/{k}.{name}").write_bytes(lzfse.compress(values.tobytes()))
    return Path(shutil.make_archive(folder, "zip", folder)).rename(folder.with_suffix(".r3d"))


def write_tum(folder, frames):
    """The layout of TUM RGB-D: depth and poses have times of their own, a little later than those
    of the images."""
    write_files(folder, frames, unit=1 / 5000)
    numbers = range(len(frames))
    images = [f"{10 + k} images/{k:06d}.jpg" for k in numbers]
    depths = [f"{10.01 + k} depth/{k:06d}.png" for k in numbers]
    (folder / "rgb.txt").write_text("\n".join(["# time file", *images]))
    (folder / "depth.txt").write_text("\n".join(["# time file", *depths]))
    rows = [
        [10.005 + k, *to_world(frame)[:3, 3], *quaternion(to_world(frame))]
        for k, frame in enumerate(frames)
    ]
    np.savetxt(folder / "groundtruth.txt", rows, header="time tx ty tz qx qy qz qw")
    return folder


def write_bop(folder, frames, objects=(5,)):
    """The layout of BOP: poses of objects by their numbers, in millimetres; depth in 0.5 mm.

    The masks are those of the last object.
    """
    masks = "mask_visib/{}_" + f"{len(objects) - 1:06d}.png"
    write_files(folder, frames, "rgb/{}.jpg", unit=0.0005, masks=masks)
    scene = {}
    cameras = {}
    for k, frame in enumerate(frames):
        pose = {
            "cam_R_m2c": frame.camera.R.ravel().tolist(),
            "cam_t_m2c": (1000 * frame.camera.t).tolist(),
        }
        scene[k] = [pose | {"obj_id": number} for number in objects]
        K = frame.camera.K - HALF_PIXEL
        cameras[k] = {"cam_K": K.ravel().tolist(), "depth_scale": 0.5}
    (folder / "scene_gt.json").write_text(json.dumps(scene))
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    return folder


def write_scannet(folder, frames):
    """The layout of ScanNet: a text file for each matrix."""
    write_files(folder, frames, "color/{}.jpg")
    for name in ("pose", "intrinsic"):
        (folder / name).mkdir()
    for k, frame in enumerate(frames):
        np.savetxt(folder / f"pose/{k:06d}.txt", to_world(frame))
    intrinsics = np.eye(4)
    intrinsics[:3, :3] = frames[0].camera.K
    np.savetxt(folder / "intrinsic/intrinsic_color.txt", intrinsics)
    return folder


def write_open3d(folder, frames):
    """The layout of Open3D's reconstruction system: poses in one log."""
    write_files(folder, frames, "color/{}.jpg")
    K = frames[0].camera.K - HALF_PIXEL
    (folder / "intrinsic.json").write_text(json.dumps({"intrinsic_matrix": K.T.ravel().tolist()}))
    with open(folder / "trajectory.log", "w") as log:
        for k, frame in enumerate(frames):
            np.savetxt(log, to_world(frame), header=f"{k} {k} {k + 1}", comments="")
    return folder


def write_zip_of_nerfstudio(folder, frames):
    """The layout of nerfstudio in one folder of a zip, as an app shares it."""
    write_nerfstudio(folder / "my scan", frames)
    return shutil.make_archive(folder, "zip", folder)


WRITERS = {
    "nerfstudio": write_zip_of_nerfstudio,
    "lists": partial(write_lists, masks=True),
    "stray": write_stray,
    "polycam": write_polycam,
    "record3d": write_record3d,
    "tum": write_tum,
    "bop": write_bop,
    "scannet": write_scannet,
    "open3d": write_open3d,
}


def write(layout, folder, frames):
    """Write a scan; returns its path, and the options by which it is read."""
    folder.mkdir()
    path = WRITERS[layout](folder, frames)
    if layout != "tum":
        return path, {}
    # The files of TUM say nothing of the camera.
    camera = frames[0].camera
    return path, {"intrinsics": (*camera.focal_length, *camera.principal_point)}


def check_frames(capture, views, tolerance):
    """Compare the frames of a capture with those it was written from; K with a relative
    tolerance."""
    for read, view in zip(capture.frames, views, strict=True):
        frame = read.load()
        known = view.depth > 0
        assert_allclose(frame.camera.matrix, view.camera.matrix, atol=1e-6)
        assert_allclose(frame.camera.K, view.camera.K, rtol=tolerance)
        assert_allclose(frame.depth[known], view.depth[known], atol=6e-4)  # depth in millimetres
        assert_array_equal(frame.mask > 0.5, view.mask > 0.5)
        # The images are JPEG, or frames of a video.
        assert np.abs(frame.rgb.astype(int) - view.rgb).mean() < 8


@pytest.mark.parametrize("layout", WRITERS)
def test_each_layout_is_recognised_and_gives_the_cameras_the_depth_and_the_masks(
    tmp_path, views, layout
):
    path, options = write(layout, tmp_path / "scan", views)
    capture = open_capture(path, **options)
    assert recognise(path)[0] == layout
    assert not capture.left_out
    assert open_source(path, **options).mask == "given"
    check_frames(capture, views, tolerance=1e-6)


@pytest.mark.parametrize(
    "names, factor",
    [
        (ODOMETRY[:9], OTHER_FOCUS),
        ([*ODOMETRY[:12], "note"], OTHER_FOCUS),
        (["note", *reversed(ODOMETRY)], np.eye(3)),
    ],
)
def test_odometry_is_read_by_the_names_of_its_columns(tmp_path, views, names, factor):
    path = write_stray(tmp_path, views)
    table = pd.read_csv(path / "odometry.csv", skipinitialspace=True).assign(note="good")
    table[names].to_csv(path / "odometry.csv", index=False)
    for frame, view in zip(open_capture(path).frames, views, strict=True):
        assert_allclose(frame.camera.matrix, view.camera.matrix, atol=1e-6)
        assert_allclose(frame.camera.K, factor @ view.camera.K, atol=1e-6)


def test_odometry_without_a_row_or_a_column_is_refused(tmp_path, views):
    path = write_stray(tmp_path, views)
    (path / "odometry.csv").write_text(",".join(ODOMETRY))
    refused("odometry.csv has 1 lines, expected at least 2", open_capture, path)
    (path / "odometry.csv").write_text("timestamp, frame, x, y, z, qx, qy\n0, 0, 0, 0, 0, 0, 0")
    refused("odometry.csv has no column qz, qw, expected frame, x", open_capture, path)


# The times of the four images of the video, in units of 1 / 60 s; the last may be late.
@pytest.mark.parametrize("steps, last", [([0, 1, 4, 5], "000005"), ([0, 1, 2, 3], "000003")])
def test_images_that_a_video_lacks_are_counted_and_found_by_time(
    tmp_path, monkeypatch, steps, last
):
    views = hairdryer_views()[:6]
    path = write_stray(tmp_path, views)
    write_video(path / "rgb.mp4", [view.rgb for view in views[:2] + views[4:]])
    assert_allclose(Video(path / "rgb.mp4").times(), 1000 / 30 * np.arange(4))
    # OpenCV writes no video with a gap.
    monkeypatch.setattr(Video, "times", lambda _: [1000 / 60 * step for step in steps])
    source = open_source(path)
    flags = " ".join(source.flags(source.load([0])))
    assert "the video has 2 images fewer than odometry.csv (4 of 6)" in flags
    assert ("images after a gap may be late" in flags) == (last == "000003")
    assert source.read_frame(3).name == f"{last}.jpg"


def test_the_inner_folder_of_polycam_is_its_scan(tmp_path, views):
    path = write_polycam(tmp_path, views)
    assert recognise(path / "keyframes") == ("polycam", path)


def each(change: Callable[[dict], object]) -> Callable[[dict], list]:
    """Return a change of all frames of transforms.json."""
    return lambda content: [change(frame) for frame in content["frames"]]


def linked(folder):
    """Move the images elsewhere, with a link in their place."""
    (folder / "images").rename(folder.parent / "large disk")
    (folder / "images").symlink_to(folder.parent / "large disk")
    return folder


# Each takes the folder of a scan of nerfstudio, changes it, and returns the path to open.
RELATIVES = {
    "camera_angle_x": edited(
        lambda c: c.update(camera_angle_x=2 * np.arctan(c.pop("w") / 2 / c.pop("fl_x"))),
        lambda c: [c.pop(name) for name in ("fl_y", "h", "cx", "cy")],
    ),
    # The first of the two scales counts.
    "depth_path": edited(
        each(lambda f: f.update(depth_path=f.pop("depth_file_path"))),
        lambda c: c.update(integer_depth_scale=0.001, depth_unit_scale_factor=5),
    ),
    "names without extension": edited(
        each(lambda f: f.update(file_path="./" + f["file_path"][:-4]))
    ),
    "3 x 4": edited(each(lambda f: f["transform_matrix"].pop())),
    "byte-order mark": edited(encoding="utf-8-sig"),
    "the file itself": lambda folder: folder / "transforms.json",
    "transforms_train.json": edited(name="transforms_train.json"),
    "back slashes": edited(each(lambda f: f.update(file_path=f["file_path"].replace("/", "\\")))),
    "absolute paths": lambda folder: edited(
        each(lambda f: f.update(file_path=f"{folder}/{f['file_path']}"))
    )(folder),
    "a linked folder": linked,
    "shuffled": edited(lambda c: c["frames"].reverse()),
}


@pytest.mark.parametrize("kind", RELATIVES)
def test_relatives_of_nerfstudio_are_read(tmp_path, views, kind, links):
    (tmp_path / "scan").mkdir()
    write_nerfstudio(tmp_path / "scan", views)
    # Where a file gives an angle alone, the principal point is the middle, 0.6 pixels off.
    check_frames(open_capture(RELATIVES[kind](tmp_path / "scan")), views, tolerance=0.02)


def first(change):
    """Return a change of the first frame of transforms.json."""
    return edited(lambda content: change(content["frames"][0]))


@pytest.mark.parametrize(
    "damage, message",
    [
        (
            first(lambda f: f["transform_matrix"][0].__setitem__(0, float("nan"))),
            "frame 0: pose is .*None",
        ),
        (
            first(lambda f: f.update(file_path="images/lost.jpg")),
            "frame 0: images/lost.jpg is missing in",
        ),
        (
            lambda folder: (folder / "masks/0000.png").write_bytes(b""),
            "mask .*0000.png cannot be decoded",
        ),
    ],
)
def test_a_frame_that_cannot_be_used_is_left_out_and_named(tmp_path, views, damage, message):
    write_nerfstudio(tmp_path, views)
    damage(tmp_path)
    capture = open_capture(tmp_path)
    assert [frame.image.name for frame in capture.frames] == ["0001.jpg", "0002.jpg", "0003.jpg"]
    source = open_source(tmp_path)
    (flag,) = source.flags(source.load([0]))
    assert all(re.search(message, line) for line in (*capture.left_out, flag))
    assert "frames left out: 1: " in flag


def test_an_import_names_a_damaged_image_unless_too_few_remain(tmp_path, views, run):
    images = tmp_path / "scan/images"
    write_nerfstudio(images.parent, views)
    (images / "0002.jpg").write_bytes((images / "0002.jpg").read_bytes()[:500])
    line = f"data import {tmp_path}/scan --root {tmp_path}/mine --category teapot --sequence"
    text = run(f"{line} one --box 20,30,60,70 --frames 4")
    assert re.search("3 frames, .* the object in .* is .* m wide and .* m away", text)
    assert "flag: frames left out: 1: image" in text
    (images / "0001.jpg").write_bytes(b"")
    assert "2 of 4 frames remain, expected 3: image" in run(f"{line} two", 2)


@pytest.mark.parametrize(
    "path", ["../../etc/passwd", "/etc/passwd", "images/../../x.jpg", "..\\x.jpg"]
)
def test_a_path_that_leads_out_of_the_capture_is_refused(tmp_path, views, path):
    write_nerfstudio(tmp_path, views)
    first(lambda f: f.update(file_path=path))(tmp_path)
    message = "leads out of the folder .*, expected a path inside, relative or absolute"
    refused(message, open_capture, tmp_path)


def test_masks_belong_to_images_by_relative_path_then_name_then_stem(tmp_path):
    for name in "a/1.png 2.jpg.png 2.png 3.png 4.png".split():
        write_mask(tmp_path / name, np.ones((4, 4), np.float32))
    mask_of = {
        "a/1.jpg": tmp_path / "a/1.png",
        "b/1.jpg": None,
        "a/2.jpg": tmp_path / "2.jpg.png",
        "a/3.jpg": tmp_path / "3.png",
        # Two images have this name: it does not tell them apart.
        "a/4.jpg": None,
        "b/4.jpg": None,
    }
    images = [Path("scan/images", name) for name in mask_of]
    assert find_masks(tmp_path, images) == [*mask_of.values()]


def test_lists_have_names_with_signs_cameras_for_each_image_and_several_sizes(tmp_path, views):
    camera = views[1].camera.crop((0, 0, 96, 64))
    upright = with_images(views[1], camera, lambda image: image[:, :64])
    write_lists(tmp_path, [replace(views[0], name="cup #10"), replace(upright, name="cup #9")])
    np.savetxt(tmp_path / "intrinsics.txt", [[300, 301, 60, 48], [200, 201, 40, 48]])
    # Frames are in the order of the numbers in their names.
    upright, wide = [frame.load().camera for frame in open_capture(tmp_path).frames]
    assert upright.size == (96, 64)
    assert wide.size == (96, 128)
    assert upright.focal_length.tolist() == [200, 201]
    assert wide.focal_length.tolist() == [300, 301]


def test_frames_whose_names_are_times_are_numbered_by_their_order(tmp_path, views):
    write_tum(tmp_path, views)
    listed = tmp_path / "rgb.txt"
    for number, seconds in enumerate(("1.9", "2.1")):
        (tmp_path / f"images/{number:06d}.jpg").rename(tmp_path / f"images/{seconds}.jpg")
        listed.write_text(listed.read_text().replace(f"{number:06d}", seconds))
    assert open_source(tmp_path).numbers == tuple(range(len(views)))


def test_the_camera_of_tum_is_by_default_that_of_its_sensors(tmp_path, views):
    write_tum(tmp_path, views)
    source = open_source(tmp_path)
    assert source.cameras[0].principal_point.tolist() == [320, 240]
    assert source.doubts[-1].startswith("no --intrinsics FX,FY,CX,CY: ")


def test_of_several_objects_of_bop_one_is_chosen(tmp_path, views):
    write_bop(tmp_path, views, objects=(3, 5))
    refused("has the objects 3, 5, expected one of them as --object N", open_source, tmp_path)
    assert open_source(tmp_path, object=5).mask == "given"


@pytest.mark.parametrize(
    "files, message",
    [
        (
            ["sparse/0/images.bin", "rgb/0.png", "depth/0.png"],
            "has COLMAP's poses, whose lengths are not those of measured depth, expected rgb/ and",
        ),
        (
            ["cameras/1.json", "images/1.jpg", "depth/1.png"],
            "as .* of Polycam's raw data, .* or of others .* lists",
        ),
        (["frame_00000.json", "depth_00000.png"], "is a scan of 3d Scanner App, .* format lists: "),
        (["lowres_wide.traj", "mesh.ply"], "is a scene of ARKitScenes, expected .* lists: rgb.txt"),
        (
            ["rgb_cam1/0.png", "scene_camera_cam1.json"],
            "several cameras, expected the files of one",
        ),
        (["gray/0.tif", "scene_camera.json", "scene_gt.json"], "in grey, expected rgb/ and depth/"),
        (["rgb/0.png", "scene_camera.json"], "lacks scene_gt.json, scene_camera.json or rgb/"),
        (
            ["depth/0.exr", "rgb/0.jpg", "metadata.json"],
            r"has depth/\*.exr, .*Record3D's .* no library here decodes, expected .*'s .r3d export",
        ),
        (["depth/0.png", "images/0.jpg"], "has images and depth, but no poses"),
        (["scan.bag"], "is a recording of RealSense, expected the folder that open3d.t.io"),
        (["Scan.MKV"], "is a video, such as Azure Kinect's, expected .* azure_kinect_mkv_reader"),
        (["0.JPG"], "has photographs, but no depth and poses in a known .* expected raw"),
        (["scan.mp4"], "is a video without depth and poses"),
        (["model.obj", "model.mtl"], "is a model as Luma or KIRI export it"),
        (
            ["notes.doc"],
            "expected .* a folder or zip with the files of nerfstudio.*; Stray.*; TUM.*; BOP.*; "
            "Open3D",
        ),
        (["intrinsic.json", "color/0.png"], "has no trajectory.log, expected poses: run Open3D's"),
    ],
)
def test_what_is_no_capture_is_answered_with_what_it_lacks(tmp_path, files, message):
    for name in files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    refused(message, open_capture, tmp_path)


def test_a_file_that_is_no_capture_is_answered_with_what_it_is(tmp_path):
    (tmp_path / "scan.bag").touch()
    refused("scan.bag is a recording of RealSense", open_capture, tmp_path / "scan.bag")


@pytest.mark.parametrize(
    "write_scan, change",
    [
        (write_open3d, edited(lambda c: c.update(coeffs=DISTORTION), name="intrinsic.json")),
        (
            write_nerfstudio,
            edited(lambda c: c.update(zip(("k1", "k2", "p1", "p2", "k3"), DISTORTION))),
        ),
        (
            write_lists,
            lambda folder: np.savetxt(folder / "intrinsics.txt", [[60, 61, 64, 48, *DISTORTION]]),
        ),
    ],
)
def test_files_carry_the_distortion(tmp_path, views, write_scan, change):
    write_scan(tmp_path, views)
    change(tmp_path)
    for frame in open_capture(tmp_path).frames:
        assert_array_equal(frame.distortion, DISTORTION)


@pytest.mark.parametrize(
    "name, size, message",
    # Zeros of 60 kB are compressed to a hundred bytes.
    [("../../climbs", 0, "path ../../climbs leads"), ("a", 60_000, "1.. bytes unpack to 60,000")],
)
def test_a_zip_that_is_malicious_or_large_is_refused(tmp_path, monkeypatch, name, size, message):
    monkeypatch.setattr("zsp_lite.importers.unpacked._LARGE", 20_000)
    with zipfile.ZipFile(tmp_path / "scan.zip", "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(name, bytes(size))
    refused(f"zip .*scan.zip cannot be unpacked: .*{message}", recognise, tmp_path / "scan.zip")


# Images of a video, of files, and of a zip.
@pytest.mark.parametrize("layout", ["stray", "lists", "record3d"])
def test_the_sharpest_image_of_each_part_is_chosen(tmp_path, views, layout):
    image = views[0].rgb
    blurred = cv2.GaussianBlur(image, ksize=(15, 15), sigmaX=3)
    # In the first of three parts all images are equal.
    images = [image if k in (3, 8) else blurred for k in range(9)]
    frames = [replace(views[0], rgb=rgb, name=f"{k:04d}") for k, rgb in enumerate(images)]
    path, _ = write(layout, tmp_path / layout, frames)
    assert [frame.number for frame in open_capture(path, count=3).frames] == [0, 3, 8]


def test_images_without_a_pose_or_a_file_are_left_out(tmp_path, views):
    folder = tmp_path / "scan"
    write("record3d", folder, views)
    edited(lambda c: c["poses"].pop(), name="metadata")(folder)
    left_out = open_capture(folder).left_out
    assert left_out == ["rgbd/3.jpg: no pose in metadata"]
    for depth in folder.glob("rgbd/*.depth"):
        depth.unlink()
    refused("none of 4 frames can be used", open_capture, folder, masks=tmp_path)


def test_a_scan_of_record3d_without_tracking_is_refused(tmp_path):
    metadata = {"K": [1.0] * 9, "dw": 4, "dh": 4, "poses": [[0.0] * 7] * 3}
    (tmp_path / "rgbd").mkdir()
    (tmp_path / "metadata").write_text(json.dumps(metadata))
    refused("/metadata: all 3 poses are zero: the tracking", open_source, tmp_path)
    (tmp_path / "metadata").write_text("{")
    zipped = shutil.make_archive(tmp_path / "cup", "zip", tmp_path)
    refused("^capture cup.zip.metadata: ", open_source, zipped)


# A disc before a wall, in metres, whose depth map is low-pass filtered: its silhouette is smeared.
# The confidence is in the middle, 1, where the depth is wrong.
_Y, _X = np.mgrid[:192, :256]
DISC = (_Y - 96) ** 2 + (_X - 128) ** 2 < 50**2
TRUE_DEPTH = np.where(DISC, 0.5, 1.2)
WRONG = np.abs(cv2.blur(TRUE_DEPTH, (5, 5)) - TRUE_DEPTH) > 0.01
LEVELS = np.where(WRONG, 1, CERTAIN).astype(np.uint8)
# The disc is dark, so that the middle level is all that there is.
DARK = np.where(DISC, 1, LEVELS).astype(np.uint8)


# The three levels as Apple and as Polycam store them.
@pytest.mark.parametrize("stored", [[0, 1, 2], [0, 127, 255]])
def test_thin_bands_of_middle_confidence_are_dropped_and_surfaces_kept(stored):
    stored = np.array(stored, np.uint8)
    assert WRONG.mean() > 0.01
    assert_array_equal(trusted(stored[LEVELS]), ~WRONG)
    assert trusted(stored[DARK])[DISC & ~WRONG].mean() > 0.95


def test_a_confidence_map_has_the_size_of_the_depth(tmp_path, views):
    path = write_stray(tmp_path, views)
    # The depth of the upper half is not trusted.
    levels = np.full((96, 128), CERTAIN, np.uint8)
    levels[:48] = 0
    cv2.imwrite(str(path / "confidence/000001.png"), levels)
    depth = open_capture(path).frames[1].load().depth
    assert not depth[:48].any()
    assert (depth[48:] > 0).any()
    cv2.imwrite(str(path / "confidence/000001.png"), levels[::2])
    (line,) = open_capture(path).left_out
    assert "000001.png is (48, 128) pixels, expected (H, W) = (96, 128)" in line


def spread(degrees: np.ndarray, count: int) -> np.ndarray:
    """Choose some of the azimuths of cameras around the origin."""
    turns = Rotation.from_euler("y", degrees[:, None], degrees=True).as_matrix()
    camera = look_at((1, 0, 0))
    cameras = [replace(camera, R=turn) for turn in turns]
    return np.sort(degrees[spread_views(cameras, count)])


@pytest.mark.parametrize("count", [3, 8])
def test_views_are_spread_evenly_whatever_their_order(count):
    degrees = np.arange(0, 360, 10.0)
    chosen = spread(degrees, count)
    gaps = np.diff(chosen, append=chosen[0] + 360)
    assert len(chosen) == count
    assert chosen[0] == 0
    assert np.abs(gaps - 360 / count).max() <= 15  # the cameras stand 10 degrees apart
    # The first view is always taken; the order of the others is of no account.
    shuffled = np.array([0, *np.random.default_rng(0).permutation(degrees[1:])])
    assert_array_equal(spread(shuffled, count), chosen)


def test_images_of_bop_with_an_object_twice_are_left_out(tmp_path, views):
    write_bop(tmp_path, views, objects=(5, 5))
    refused("none of 4 .* shows object 5 2 times, expected once", open_capture, tmp_path)


def test_frames_with_one_pose_are_refused(tmp_path, views):
    write_lists(tmp_path, [replace(frame, camera=views[0].camera) for frame in views])
    refused(r"all \d frames have one camera pose", open_source, tmp_path)


def test_a_folder_of_masks_with_other_names_is_refused(tmp_path, views):
    write_lists(tmp_path, views)
    write_mask(tmp_path / "others/mask.png", views[0].mask)
    refused(
        "has no mask that is named like an image, such as 0000.png",
        open_source,
        tmp_path,
        masks=tmp_path / "others",
    )
