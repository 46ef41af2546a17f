"""Captures written in every format from rendered views are read with the true cameras and depth,
and imported."""

import weakref
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from captures import edited, hairdryer_views, straight_places, write_lists, write_nerfstudio
from numpy.testing import assert_allclose
from refusals import refused
from scipy.spatial import cKDTree

from zsp_lite import Co3D, open_source
from zsp_lite.data.check import check_folder
from zsp_lite.data.writing import write_image
from zsp_lite.importers import open_capture
from zsp_lite.importers.capture import CaptureFrame
from zsp_lite.importers.convert import fuse, import_captures, import_source
from zsp_lite.importers.masks import masks_from_box


@pytest.fixture(scope="module")
def views():
    """The views, rendered once."""
    return hairdryer_views()


WRITERS = {"nerfstudio": write_nerfstudio, "lists": write_lists}


@pytest.fixture
def scan(tmp_path, views) -> Path:
    """A capture of nerfstudio."""
    write_nerfstudio(tmp_path / "scan", views)
    return tmp_path / "scan"


@pytest.fixture(scope="module")
def imported(tmp_path_factory, views):
    """A data folder into which a scan was imported, and what the import says of it."""
    root = tmp_path_factory.mktemp("imported")
    write_nerfstudio(root / "scan", views)
    return root / "data", import_source(open_source(root / "scan"), root / "data", "teapot", "mine")


def test_an_import_is_a_complete_data_folder_with_a_cloud_of_unit_scale(imported):
    root, done = imported
    (check,) = check_folder(root, deep=True)
    assert (check.problems, check.complete) == ([], 1)
    assert done.frames == 8
    points, _ = Co3D(root).point_cloud("teapot", "mine")
    assert done.points == len(points) > 500
    assert_allclose(points.std(axis=0).mean(), 1, rtol=1e-3)


def test_an_import_has_the_depth_and_cameras_in_its_scale(imported, views):
    root, done = imported
    for annotation, view in zip(Co3D(root).frames("teapot", "mine"), views, strict=True):
        frame = Co3D(root).load(annotation)
        inside = (frame.mask > 0.9) & (frame.depth > 0)
        assert_allclose(frame.depth[inside], done.scale * view.depth[inside], rtol=5e-3)
        assert_allclose(frame.camera.t, done.scale * view.camera.t, rtol=1e-5)


@pytest.mark.parametrize("box", [None, (20, 30, 60, 70)])
def test_an_import_holds_a_few_frames_at_once(tmp_path, scan, monkeypatch, box):
    def load_counted(captured):
        frame = load(captured)
        images.append(weakref.ref(frame.rgb))  # a frame with another mask has the same one
        held.append(sum(image() is not None for image in images))
        return frame

    load = CaptureFrame.load
    images = []
    held = []
    monkeypatch.setattr(CaptureFrame, "load", load_counted)
    done = import_source(open_source(scan, box=box), tmp_path / "data", "teapot", "mine")
    assert done.frames == 8
    assert max(held) <= 3


def test_the_distortion_of_fisheye_cameras_is_corrected(tmp_path, views):
    folder = tmp_path / "scan"
    write_nerfstudio(folder, views[:1])
    distortion = {"k1": 0.12, "k2": -0.03, "k3": 0.02, "k4": -0.01}
    edited(lambda content: content.update(distortion, camera_model="OPENCV_FISHEYE"))(folder)
    # In the stored picture, red and green of a pixel are its place without distortion. In the
    # corrected picture they are the place of the pixel itself.
    height, width = views[0].camera.size
    places, straight = straight_places(
        views[0].camera, [*distortion.values()], cv2.fisheye.undistortPoints
    )
    picture = np.zeros((height, width, 3))
    level = 255 / width  # per pixel
    picture[..., :2] = level * straight
    picture = np.rint(picture.clip(0, 255)).astype(np.uint8)
    write_image(folder / f"images/{views[0].name}.jpg", picture, quality=98)
    loaded = open_capture(folder, "nerfstudio").frames[0].load().rgb[..., :2] / level
    inside = np.s_[10:-10, 10:-10]  # without the border, which the stored picture may lack
    # In pixels; the differences are those of JPEG and of the 256 levels.
    errors = np.abs(loaded - places)[inside]
    assert errors.mean() < 0.3  # without the correction it is 0.6
    assert errors.max() < 2


def test_the_fused_cloud_lies_on_the_surface(views):
    points, colours, normals = fuse(views)
    seen = []
    for view in views:
        pixels = np.argwhere(view.mask > 0)[:, ::-1] + 0.5
        seen.append(view.camera.unproject(pixels, view.depth[view.mask > 0]))
    seen = np.concatenate(seen)
    spread = seen.std(axis=0).mean()
    # All but the outliers: 90 % of the points, in either direction.
    assert np.percentile(cKDTree(seen).query(points)[0], 90) < 0.1 * spread
    assert np.percentile(cKDTree(points).query(seen)[0], 90) < 0.2 * spread
    assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-3)
    assert colours.shape == points.shape


def replaced(name, content):
    """Return a change of a folder: a file gets other content."""
    return lambda folder: (folder / name).write_text(content)


@pytest.mark.parametrize(
    "kind, damage, message",
    [
        (
            "nerfstudio",
            edited(lambda c: c.update(camera_model="PANORAMA")),
            "none of 8 frames .* 'PANORAMA'",
        ),
        (
            "nerfstudio",
            edited(lambda c: c.pop("fl_x")),
            "frame 0: no focal length, expected fl_x or",
        ),
        (
            "nerfstudio",
            edited(lambda c: [f.pop("depth_file_path") for f in c["frames"]]),
            "none of 8 frames can be used: .*frame 0: no depth_file_path",
        ),
        ("nerfstudio", edited(lambda c: c.update(w=31.5)), "multiple of 1"),
        (
            "nerfstudio",
            edited(lambda c: c.update(k4=0.01)),
            "frame 0: .* with k4 = 0.01, expected .* with k4 = 0",
        ),
        (
            "lists",
            replaced("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n"),
            r"rgb.txt, depth.txt, poses.txt and .* have \[8, 8, 1, 8\] lines",
        ),
        (
            "lists",
            replaced("poses.txt", 8 * ("1 0 0 0 " * 3 + "1 0 0 1\n")),
            "off the expected 0 0 0 1",
        ),
        (
            "lists",
            replaced("intrinsics.txt", "60 0 0\n0 60 0\n32 24 1\n"),
            "expected fx 0 cx, 0 fy cy, 0 0 1",
        ),
        (
            "lists",
            replaced("intrinsics.txt", 3 * "60 60 32 24\n"),
            r"\[8, 8, 8, 3\] lines, expected equal",
        ),
    ],
)
def test_an_invalid_capture_is_refused_in_one_line_that_names_the_part(
    tmp_path, views, kind, damage, message
):
    WRITERS[kind](tmp_path, views)
    damage(tmp_path)
    refused(message, open_capture, tmp_path, kind)


def test_a_single_frame_is_fused_and_what_one_of_many_frames_saw_is_left_out(views):
    assert len(fuse(views[:1])[0]) > 200
    view = views[0]
    on_object = view.mask > 0.5
    near = np.where(on_object, 0.5 * view.depth, 0).astype(np.float32)
    points, *_ = fuse([*views, replace(view, depth=near)])
    _, depth = view.camera.project(points)
    # The depth that the other frames contradict is half of that.
    assert depth.min() > 0.7 * view.depth[on_object].min()


def test_bad_boxes_empty_depth_and_frames_without_overlap_are_refused(views):
    refused("expected one inside", masks_from_box, views, (0, 0, 5, 9999))
    blind = [replace(view, depth=np.zeros_like(view.depth)) for view in views]
    refused("no known depth on the object", fuse, blind)
    apart = [
        replace(view, camera=replace(view.camera, t=view.camera.t + 100 * i))
        for i, view in enumerate(views[:3])
    ]
    refused("expected overlapping depth maps", fuse, apart)


def test_frames_without_the_object_are_left_out_and_a_sequence_is_not_replaced(tmp_path, views):
    folder = tmp_path / "scan"
    dark = replace(views[1], rgb=views[1].rgb // 10)
    empty = replace(views[5], mask=np.zeros_like(views[5].mask))
    write_nerfstudio(folder, [views[0], dark, *views[2:5], empty])
    source = open_source(folder)
    done = import_source(source, tmp_path / "data", "teapot", "mine")
    (flag,) = done.flags
    assert flag == "frames left out: 2: frame 1: black image; frame 5: empty object mask"
    frames = Co3D(tmp_path / "data").frames("teapot", "mine")
    assert [frame.frame_number for frame in frames] == [0, 2, 3, 4]
    message = "mine exists already, expected another"
    refused(message, import_source, source, tmp_path / "data", "teapot", "mine")


def test_every_capture_in_a_folder_is_imported_once(tmp_path, views, caplog):
    for name in ("one", "two"):
        write_lists(tmp_path / "scans" / name, views, masks=True)
    (tmp_path / "scans/one.txt").touch()
    done = dict(import_captures(tmp_path / "scans", tmp_path / "data", "teapot"))
    numbers = {name: one.frames for name, one in done.items()}
    assert numbers == {"one": len(views), "two": len(views)}
    assert "one.txt is left out" in caplog.text
    assert not list(import_captures(tmp_path / "scans", tmp_path / "data", "teapot"))


def test_no_capture_and_two_captures_of_one_name_are_refused(tmp_path):
    refused("has no scan, expected", next, import_captures(tmp_path, tmp_path, "cup"))
    for name in ("cup.r3d", "cup.zip"):
        (tmp_path / name).touch()
    refused("cup.r3d and cup.zip, expected one", next, import_captures(tmp_path, tmp_path, "cup"))
