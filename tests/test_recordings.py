"""Recordings without poses, rendered around an object: the poses that are found, what breaks them,
and names of files."""

import json
import re
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import open3d as o3d
import pytest
from captures import METRES, write_depth16
from numpy.testing import assert_allclose
from refusals import refused

from zsp_lite import Frame, open_source
from zsp_lite.course.synthetic.export import make_object
from zsp_lite.course.synthetic.primitives import box_centre
from zsp_lite.course.synthetic.raytracing import MeshScene
from zsp_lite.course.synthetic.room import random_room
from zsp_lite.course.synthetic.sequences import orbit_pose
from zsp_lite.data.cameras import Camera
from zsp_lite.data.writing import write_image
from zsp_lite.importers import recognise
from zsp_lite.importers.convert import scale_frame
from zsp_lite.metrics import rotation_angle

# A quarter of Redwood's camera; pixel centres at half-integers.
INTRINSICS = (131.25, 131.25, 80.0, 60.0)


@pytest.fixture(scope="module")
def views():
    """Once around a chair on a rug, and a little more, in metres."""
    mesh = make_object("chair", 0, 1)  # index and seed
    rng = np.random.default_rng([1, 7])
    scene = MeshScene(mesh, random_room(rng, turn=0.3), rng, samples=1)
    frames = []
    # From somewhat above, with a little roll, at a distance of 7.5 times METRES.
    for azimuth in np.radians(np.arange(0, 376, 8)):
        R, t = orbit_pose(azimuth, 0.45, 0.05 * np.sin(azimuth), 7.5, box_centre(mesh.vertices))
        camera = Camera(R, t, np.array(INTRINSICS[:2]), np.array(INTRINSICS[2:]), (120, 160))
        view = scene.render(camera)
        frames.append(scale_frame(Frame(view.rgb, view.depth, None, camera), METRES))
    return frames


def write(folder, frames, names="rgb/{:06d}.jpg depth/{:06d}.png", enlarge=1):
    """Write images and depth; returns the folder."""
    image, depth = names.split()
    for k, frame in enumerate(frames):
        rgb, values = (
            pixels.repeat(enlarge, axis=0).repeat(enlarge, axis=1)
            for pixels in (frame.rgb, frame.depth)
        )
        write_image(folder / image.format(k, k), rgb, 95)
        write_depth16(folder / depth.format(k, k), values)
    return folder


# Opens a recording with the cameras of the views.
open_recording = partial(open_source, intrinsics=INTRINSICS)


def errors(source, frames):
    """The largest errors of poses relative to the first frame, degrees and metres."""
    poses = []
    for views in (source.cameras, [frame.camera for frame in frames]):
        to_world = np.linalg.inv([view.matrix for view in views])
        poses.append((views[0].matrix @ to_world)[:, :3])
    found, true = poses
    apart = np.linalg.norm((found - true)[..., 3], axis=1)
    return rotation_angle(found[..., :3], true[..., :3]).max(), apart.max()


def flags(source):
    """The flags of a source in one text."""
    return " ".join(source.flags(source.load([0])))


def test_poses_around_an_object_are_found_within_2_degrees_and_4_centimetres(tmp_path, views):
    source = open_recording(write(tmp_path, views))
    assert (source.format, len(source.numbers)) == ("recording", len(views))
    degrees, metres = errors(source, views)
    assert degrees < 2
    assert metres < 0.04  # of cameras at a distance of 1 m
    assert flags(source) == ""


def test_a_turn_whose_loops_do_not_close_is_flagged(tmp_path, views, monkeypatch):
    registration = o3d.pipelines.registration

    # Loops are the uncertain edges of the graph.
    def without_loops(graph, *_):
        kept = [edge for edge in graph.edges if not edge.uncertain]
        graph.edges = registration.PoseGraphEdgeVector(kept)

    monkeypatch.setattr(registration, "global_optimization", without_loops)
    said = flags(open_recording(write(tmp_path, views)))
    assert re.search(r"the poses may drift: 0 of \d+ loops close", said)


def test_the_longer_part_of_a_recording_that_breaks_is_used(tmp_path, views):
    write(tmp_path, views[:5] + views[20:27])
    source = open_recording(tmp_path)
    assert errors(source, views[20:27])[0] < 1
    assert re.search(
        "frames left out: 5: the recording breaks: from .*000000.jpg on, 5 of 12 do not join",
        flags(source),
    )


def test_frames_that_are_dark_or_damaged_are_left_out(tmp_path, views):
    dark = replace(views[3], rgb=np.zeros_like(views[3].rgb))
    write(tmp_path, [*views[:3], dark, *views[4:7]])
    (tmp_path / "rgb/000005.jpg").write_bytes(b"damaged")
    (tmp_path / "depth/000006.png").unlink()
    source = open_recording(shutil.make_archive(tmp_path / "scan", "zip", tmp_path))
    # Frames 3, 5 and 6 are bad.
    assert errors(source, [*views[:3], views[4]])[0] < 1
    left_out = " ".join(source.left_out)
    for reason in (
        "000003.jpg on, 1 of 6 do not join",
        "000005.jpg",
        "(^| )scan.zip.rgb.000006.jpg: no depth of its number",  # not the temporary folder
    ):
        assert re.search(reason, left_out)


def test_a_depth_of_half_the_images_goes_to_no_second_image(tmp_path, views):
    write(tmp_path, views[:8])
    for path in sorted((tmp_path / "depth").iterdir())[1::2]:
        path.unlink()
    left_out = open_recording(tmp_path).left_out
    assert [re.search(r"(\d).jpg: no depth", text)[1] for text in left_out] == ["1", "3", "5", "7"]


def test_the_unit_of_depth_scales_the_poses(tmp_path, views):
    write(tmp_path, views[:3])
    far = open_recording(tmp_path, depth_unit=0.002).cameras[2].t
    assert_allclose(far, 2 * open_recording(tmp_path).cameras[2].t, rtol=0.05)


def test_of_many_frames_only_some_are_tracked(tmp_path, views, monkeypatch):
    monkeypatch.setattr("zsp_lite.importers.recordings._MOST", 3)
    write(tmp_path, views[:6])
    # Every second one of six.
    assert errors(open_recording(tmp_path), views[:6:2])[0] < 1


def test_a_recording_without_intrinsics_is_refused(tmp_path, views):
    write(tmp_path, views[:2])
    refused("has no intrinsics, expected --intrinsics FX,FY,CX,CY", open_source, tmp_path)


def test_two_images_of_one_number_are_refused(tmp_path, views):
    write(tmp_path, views[:1])
    write(tmp_path, views[:1], "color/{}.jpg depth/{:06d}.png")
    refused("0.jpg and .*000000.jpg have one number", open_recording, tmp_path)


def test_a_recording_whose_images_have_no_depth_is_refused(tmp_path, views):
    write(tmp_path, views[:2], "rgb/{:06d}.jpg depth/9{:06d}.png")
    refused(
        "can be used: .*0.jpg: no depth of its number.*; .*1.jpg: no depth",
        open_recording,
        tmp_path,
    )


def test_recorders_of_open3d_and_redwood_need_no_option(tmp_path, views):
    recorder = write(tmp_path / "open3d", views[:3], "color/{:05d}.jpg depth/{:05d}.png")
    fx, fy, cx, cy = INTRINSICS
    matrix = [fx, 0, 0, 0, fy, 0, cx - 0.5, cy - 0.5, 1]
    (recorder / "camera_intrinsic.json").write_text(json.dumps({"intrinsic_matrix": matrix}))
    assert errors(open_source(recorder), views[:3])[0] < 1

    # Redwood's images are of 640 x 480 pixels. Depth has other times.
    redwood = tmp_path / "redwood"
    write(redwood, views[:3], "rgb/{:07d}-{:09d}000.jpg depth/{:07d}-{:09d}400.png", enlarge=4)
    source = open_source(redwood)
    assert errors(source, views[:3])[0] < 1
    assert "PrimeSense" in flags(source)
    assert_allclose(source.cameras[0].K, [[525, 0, 320], [0, 525, 240], [0, 0, 1]])


@pytest.mark.parametrize("sign", ["pose", "groundtruth.txt", "scene_camera.json", "trajectory.log"])
def test_poses_of_other_formats_are_not_found_again(tmp_path, views, sign):
    write(tmp_path, views[:1])
    (tmp_path / sign).touch()
    # The second message is for scene_camera.json, of BOP.
    refused("but no poses|lacks scene_gt.json", recognise, tmp_path)
