"""Files of users' own photographs and captures: kinds of masks and depth maps, EXIF orientations,
intrinsics."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image, ImageOps
from refusals import refused
from synthetic_views import AT_HOME, ELSEWHERE, CoordinateBackbone, around, look_at, render
from test_importers import write_lists, write_nerfstudio
from test_masks import DIRECTIONS, ball_on_floor, overlap

from zsp_lite import InputError, estimate_pose, open_source
from zsp_lite.data.cameras import camera_from_pose
from zsp_lite.data.frames import encode_depth, write_mask
from zsp_lite.importers import open_capture
from zsp_lite.importers.convert import import_source
from zsp_lite.importers.files import (
    display_image,
    question_intrinsics,
    read_depth_file,
    read_mask_file,
    read_picture,
)
from zsp_lite.importers.sources import open_pair
from zsp_lite.metrics import rotation_error

DISC = np.hypot(*np.mgrid[-16:16, -20:20]) < 9  # the object, at (32, 40) pixels
RING = (np.hypot(*np.mgrid[-16:16, -20:20]) < 11) & ~DISC
DEEP = DISC[..., None]
SMOOTH = cv2.GaussianBlur(255 * DISC.astype(np.uint8), (9, 9), 0)
VOC = [0, 0, 0, 128, 0, 0, 0, 128, 0] + [224, 224, 192] * 253
MASKS = {
    "0 and 255.png": 255 * DISC,
    "0 and 1.png": 1 * DISC,
    "0 and 7.png": 7 * DISC,
    "100 and 120.png": 100 + 20 * DISC,
    "1 bit.png": Image.fromarray(DISC),
    "16 bit.png": Image.fromarray((65535 * DISC).astype(np.uint16)),
    "booleans.npy": DISC,
    "smooth.png": SMOOTH,
    "tiff.tiff": 255 * DISC,
    "jpeg.jpg": 255 * DISC,
    "dark.jpg": 120 * DISC,
    "webp.webp": 255 * DEEP.repeat(3, 2),
    "palette.png": (DISC, None),
    "palette, void.png": (DISC + 255 * RING, None),
    "palette of two.png": (2 * DISC + RING, 2),
    "labels.png": (2 * DISC + 5 * RING, 2),
    "colours.png": (DEEP * [90, 0, 0] + RING[..., None] * [0, 90, 200], 1),
    "cut out.png": np.dstack([np.arange(1280).reshape(32, 40, 1).repeat(3, 2) % 256, 255 * DISC]),
    "alpha.png": np.where(DEEP, [255] * 4, [255, 255, 255, 0]),
}


@pytest.mark.parametrize("name", MASKS)
def test_every_kind_of_mask_shows_the_object(tmp_path, name):
    content, path = MASKS[name], tmp_path / name
    content, label = content if isinstance(content, tuple) else (content, None)
    if name.endswith(".npy"):
        np.save(path, content)
    else:
        image = (
            content
            if isinstance(content, Image.Image)
            else Image.fromarray(content.astype(np.uint8))
        )
        if name.startswith("palette"):
            image.putpalette(VOC)
        image.save(path)
    assert overlap(read_mask_file(path, label), DISC) > (
        0.95 if re.search("smooth|jpg|webp", name) else 0.9999
    )
    if label:
        refused("has the labels 1, 2|2, 5, expected --label with one of them", read_mask_file, path)
        assert not read_mask_file(path, 9).any(), "a frame may not show the object"


COUNT, DEPTH = np.arange(48).reshape(6, 8), np.linspace(0.5, 3, 48, dtype=np.float32).reshape(6, 8)
FLOAT = np.where(COUNT < 4, np.float32([0, np.nan, np.inf, -1, 9, 9, 9, 9]), DEPTH)
STORED = np.where(
    COUNT < 4, np.uint16([0, 65535, 0, 0, 9, 9, 9, 9]), (1000 * DEPTH).astype(np.uint16)
)


@pytest.mark.parametrize("name", "d.npy d.npz d.tiff d.pfm d.geometric.png 16.png 16.tiff".split())
def test_every_kind_of_depth_file_is_read_with_zeros_where_it_is_unknown(tmp_path, name):
    path, values = tmp_path / name, STORED if "16" in name else FLOAT
    if path.suffix == ".npy":
        np.save(path, values[..., None])
    elif path.suffix == ".npz":
        np.savez_compressed(path, depth=values)
    else:
        cv2.imwrite(str(path), encode_depth(values) if "geometric" in name else values)
    expected = np.where(COUNT < 4, 0, values)
    assert_allclose(read_depth_file(path), expected, rtol=1e-3 if "geometric" in name else 0)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    refused("cannot be decoded .* expected a complete", read_depth_file, path)


def test_files_that_hold_something_else_are_refused_in_one_line(tmp_path):
    np.savez(tmp_path / "two.npz", a=DEPTH, b=DEPTH)
    for name, values in (
        ("text", ["x"]),
        ("number", 3.0),
        ("colours", np.ones((4, 4, 3))),
        ("empty", np.ones((0, 4))),
    ):
        np.save(tmp_path / f"{name}.npy", values)
        refused(
            rf"{name}.npy holds .*, expected numbers \(H, W\)",
            read_depth_file,
            tmp_path / f"{name}.npy",
        )
    (tmp_path / "d.exr").write_bytes(b"v/1\x01" + bytes(99))
    (tmp_path / "a.heic").write_bytes(bytes(99))
    Image.fromarray(SMOOTH).convert("RGB").save(tmp_path / "a.webp")
    (tmp_path / "half.webp").write_bytes((tmp_path / "a.webp").read_bytes()[:-40])
    assert read_picture(tmp_path / "a.webp")[0].shape == (32, 40, 3)
    for name, read, message in (
        ("two.npz", read_depth_file, "two.npz holds 2 arrays, expected one"),
        (
            "d.exr",
            read_depth_file,
            "expected an OpenCV that reads .exr, or the depth as .npy or a float .tiff",
        ),
        ("a.webp", read_depth_file, "holds uint8 of shape .*, expected numbers"),
        ("half.webp", read_picture, "half.webp cannot be decoded"),
        ("a.heic", read_picture, "HEIC is not read, expected the photograph as JPEG"),
    ):
        refused(message, read, tmp_path / name)


@pytest.fixture(scope="module")
def portrait():
    """A frame with an upright camera, higher than wide."""
    return render(look_at((1, 0.6, 0.4), size=(180, 140)), AT_HOME, "portrait")


def as_stored(image, tag):
    return display_image(image, {6: 8, 8: 6}.get(tag, tag))


def write_photograph(path, frame, tag, stored=True):
    """Write a photograph as a phone stores it, its depth and mask in the stored form, or as
    displayed."""
    exif = Image.Exif()
    exif[0x0112] = tag
    Image.fromarray(as_stored(frame.rgb, tag)).save(path, exif=exif, quality=98)
    shown = np.asarray(ImageOps.exif_transpose(Image.open(path)))
    assert np.abs(shown.astype(int) - frame.rgb).mean() < 3
    depth, mask = (as_stored(one, tag) if stored else one for one in (frame.depth, frame.mask))
    cv2.imwrite(
        str(path.with_name(f"{path.stem}_depth.png")), np.rint(1000 * depth).astype(np.uint16)
    )
    write_mask(path.with_name(f"{path.stem}_mask.png"), mask)
    return path


@pytest.mark.parametrize("form", ["stored", "displayed"])
@pytest.mark.parametrize("tag", range(1, 9))
def test_a_photograph_is_upright_with_its_depth_mask_and_camera_in_either_form(
    tmp_path, portrait, tag, form
):
    path = write_photograph(tmp_path / "a.jpg", portrait, tag, form == "stored")
    spot = np.zeros((180, 140))
    spot[99, 74] = 1  # the principal point, as displayed
    row, column = np.argwhere(as_stored(spot, tag))[0]
    ambiguous = tag in (2, 3, 4)
    for intrinsics in [form] if ambiguous else ["stored", "displayed"]:
        given = (190, 190, column, row) if intrinsics == "stored" else (190, 190, 74, 99)
        if ambiguous:
            refused(
                f"orientation {tag} .* --orientation stored or",
                lambda: open_source(path, given).load([0]),
            )
        (frame,) = open_source(path, given, orientation=form if ambiguous else None).load([0])
        assert_allclose(frame.depth, portrait.depth, atol=6e-4)
        assert_array_equal(frame.mask, portrait.mask)
        assert_allclose(frame.camera.K, [[190, 0, 74], [0, 190, 99], [0, 0, 1]], atol=1.01)
        assert_allclose(frame.camera.R, np.eye(3), atol=1e-12)
        assert np.abs(frame.rgb.astype(int) - portrait.rgb).mean() < 3


def test_a_capture_of_turned_photographs_keeps_its_world_and_refuses_mirrored_ones(tmp_path):
    views = around(AT_HOME, 2)
    write_nerfstudio(tmp_path, views)  # the camera is that of the stored pixels
    for view, tag in zip(views, (6, 5), strict=True):
        picture = Image.open(tmp_path / f"images/{view.name}.jpg")
        picture.getexif()[0x0112] = tag
        picture.save(tmp_path / f"images/{view.name}.jpg", exif=picture.getexif(), quality=98)
    (first,), (line,) = open_capture(tmp_path, "nerfstudio")
    frame = first.load()
    y, x = np.argwhere(frame.mask > 0)[::97].T
    points = frame.camera.unproject(np.stack([x, y], -1) + 0.5, frame.depth[y, x])
    assert frame.depth.shape == (180, 140)
    assert_allclose(views[0].camera.project(points)[0], np.stack([y, 139 - x], -1) + 0.5, atol=0.01)
    assert "0001.jpg is mirrored by its EXIF orientation 5" in line


@pytest.mark.parametrize(
    "values, message",
    [
        ((600, 600, 320, 240), None),
        ((600, 600, 280, 260), None),
        (
            (1200, 1200, 640, 480),
            "fit an image.* of 1280 x 960, not 640 x 480 .*: .* 600,600,320,240$",
        ),
        (
            (300, 300, 160, 120),
            "fit an image.* of 320 x 240, not 640 x 480 .*: .* 600,600,320,240$",
        ),
        (
            (240, 240, 128, 96),
            "256 x 192, not 640 x 480 .*: .* 600,600,320,240; .* view of 130 degrees",
        ),
        ((1200, 1200, 900, -200), "far from the middle, as those of a crop$"),
        ((0.9375, 1.25, 0.5, 0.5), "look normalised: .* 600,600,320,240; .* view of"),
        ((4.2, 4.2, 2.8, 2.1), "millimetres of 5.6 x 4.2, .*: .* 480,480,320,240; .* view of"),
        (
            (1, 1, 320, 240),
            "a.jpg: the intrinsics 1,1,320,240 have a field of view of 180 degrees, expected "
            "10 to 120",
        ),
        ((9000, 0, 320, 0, 9000, 240, 0, 0, 1), "view of 4.07 degrees"),
    ],
)
def test_intrinsics_of_another_image_or_unit_are_questioned_and_corrected(values, message):
    camera = camera_from_pose(np.eye(4), values, (480, 640), "a.jpg")
    if message and "view of" in message:
        refused(message, question_intrinsics, camera, "a.jpg")
    else:
        flags = question_intrinsics(camera, "a.jpg")
        assert re.search(message, *flags) if message else flags == ()


def test_frames_without_a_mask_get_one_by_depth_and_are_named(tmp_path):
    scenes = [ball_on_floor(direction) for direction in DIRECTIONS]
    views = [
        replace(frame, mask=truth.astype(np.float32), name=str(k))
        for k, (frame, truth) in enumerate(scenes)
    ]
    write_lists(tmp_path, views)
    refused(
        "no mask, expected masks named like the images, --mask auto or --box",
        open_source,
        tmp_path,
        mask="given",
    )
    done = import_source(open_source(tmp_path), tmp_path / "auto", "ball", "one")
    assert (done.frames, done.flags) == (4, ())
    for view in views[1:]:
        write_mask(
            tmp_path / f"masks/{view.name}.png", 1 - view.mask if view.name == "3" else view.mask
        )
    source = open_source(tmp_path)
    frames = source.load([0, 1])
    assert source.mask == "given"
    assert overlap(frames[0].mask, scenes[0][1]) > 0.95
    assert_array_equal(frames[1].mask, views[1].mask)
    missing, inverted = source.flags(source.load([0, 1, 3]))
    assert inverted.endswith(
        "the masks may be wrong: those of 1 of 3 frames cover most of the border: inverted?"
    )
    assert missing.endswith("no mask is given for 0.jpg: found by depth")
    (tmp_path / "masks").rename(tmp_path / "others")
    done = import_source(
        open_source(tmp_path, masks=tmp_path / "others"), tmp_path / "some", "ball", "one"
    )
    assert done.frames == 4
    assert done.flags[0] == "no mask is given for 0.jpg: found by depth"
    assert done.flags[1].startswith(
        "the masks may be wrong: those of 1 of 4 frames cover most of the border"
    )


def test_depth_of_another_shape_is_refused_with_what_is_allowed(tmp_path, portrait):
    path = write_photograph(tmp_path / "a.jpg", portrait, 1)
    for shape in ((90, 90), (360, 280)):
        np.save(tmp_path / "z.npy", np.ones(shape, np.float32))
        with pytest.raises(
            InputError, match=r"= \(180, 140\) as the image, or smaller with its aspect ratio"
        ):
            open_source(path, (190, 190, 70, 90), depth=tmp_path / "z.npy").load([0])
    np.save(tmp_path / "z.npy", np.full((90, 70, 1), 1e10))
    matrix = np.array([[190, 0, 70], [0, 190, 90], [0, 0, 1]])
    assert not open_source(path, matrix, depth=tmp_path / "z.npy").load([0])[0].depth.any()


def test_the_pose_of_a_sideways_portrait_is_that_of_the_upright_one(tmp_path, portrait):
    """A later run leaves no file of an earlier one in its folder, and a single image is a
    helper."""
    names = ("upright.png", "sideways.jpg", "third.jpg")
    given = (190, 190, 70, 90)
    out = tmp_path / "out"
    poses = []
    images = [
        write_photograph(tmp_path / name, portrait, 6 if name == "sideways.jpg" else 1)
        for name in names
    ]
    write_lists(tmp_path / "scan", around(ELSEWHERE, 4))
    out.mkdir()
    (out / "aligned_paper.ply").touch()
    options = {"references": 1, "intrinsics": given, "backbone": CoordinateBackbone(), "out": out}
    for image, helpers in ((images[0], ()), (images[1], ()), (images[1], images[2:])):
        found = estimate_pose(image, tmp_path / "scan", targets=9, helpers=helpers, **options)
        poses.append(found.world_sim3.R)
        assert any(
            "number of target views: 4, all that there are, not 9" in flag
            for flag in found.estimate.flags
        )
    assert rotation_error(poses[0], poses[1]) < 3
    assert rotation_error(poses[0], poses[2]) < 15
    assert {path.name for path in out.iterdir()} == {
        "report.html",
        "target.ply",
        "aligned_verified.ply",
    }
    pair = open_pair(*images[:2], {"intrinsics": (given, given, (200, 200, 70, 90))}, images[2:])
    assert [one.load([0])[0].camera.K[0, 0] for one in pair] == [190, 190, 200]


def test_a_link_to_a_sequence_is_one_and_the_disks_root_no_folder_for_results(
    links, tmp_path, ellipsoids
):
    (tmp_path / "mine").symlink_to(ellipsoids.root / "ellipsoid/a")
    source = open_source(tmp_path / "mine")
    assert (source.format, source.name, len(source.numbers)) == ("sequence", "mine", 7)
    refused(
        "is the root of the disk",
        estimate_pose,
        tmp_path / "mine",
        tmp_path / "mine",
        out=tmp_path.anchor,
    )
