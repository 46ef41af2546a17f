"""Files of users' own photographs and captures: kinds of masks and depth maps, EXIF orientations, intrinsics."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps
from synthetic_views import AT_HOME, ELSEWHERE, CoordinateBackbone, around, look_at, render
from test_importers import write_lists, write_nerfstudio
from test_masks import DIRECTIONS, ball_on_floor, overlap

from zsp_lite.cli import main as cli
from zsp_lite.data.cameras import Camera
from zsp_lite.data.frames import encode_depth, write_mask
from zsp_lite.errors import InputError
from zsp_lite.importers import READERS, import_capture
from zsp_lite.importers.files import question_intrinsics, read_depth_file, read_mask_file, read_picture, turn_image
from zsp_lite.metrics import rotation_error
from zsp_lite.own_objects import estimate_pose, open_pair, open_source

DISC = np.hypot(*np.mgrid[-16:16, -20:20]) < 9  # the object, at (32, 40) pixels
RING = (np.hypot(*np.mgrid[-16:16, -20:20]) < 11) & ~DISC
SMOOTH = cv2.GaussianBlur(255 * DISC.astype(np.uint8), (9, 9), 0)
VOC = [0, 0, 0, 128, 0, 0, 0, 128, 0] + [224, 224, 192] * 253
CUT_OUT = np.dstack([np.arange(1280).reshape(32, 40, 1).repeat(3, 2) % 256, 255 * DISC]).astype(np.uint8)


def palette(numbers):
    image = Image.fromarray(numbers.astype(np.uint8), "P")
    image.putpalette(VOC)
    return image


@pytest.mark.parametrize(
    ("name", "content", "label"),
    [
        ("m.png", 255 * DISC, None),
        ("m.png", 1 * DISC, None),
        ("m.png", 7 * DISC, None),
        ("m.png", 100 + 20 * DISC, None),
        ("m.png", Image.fromarray(DISC), None),
        ("m.png", (65535 * DISC).astype(np.uint16), None),
        ("m.png", SMOOTH, None),
        ("m.png", 2 * DISC + 5 * RING, 2),
        ("m.png", palette(DISC), None),
        ("m.png", palette(DISC + 255 * RING), None),
        ("m.png", palette(2 * DISC + RING), 2),
        ("m.png", DISC[..., None] * [90, 0, 0] + RING[..., None] * [0, 90, 200], 1),
        ("m.png", CUT_OUT, None),
        ("m.png", np.where(DISC[..., None], [255] * 4, [255, 255, 255, 0]), None),
        ("m.jpg", 255 * DISC, None),
        ("m.jpg", 120 * DISC, None),
        ("m.webp", 255 * DISC[..., None].repeat(3, 2), None),
        ("m.tiff", 255 * DISC, None),
        ("m.npy", DISC, None),
    ],
)
def test_every_kind_of_mask_shows_the_object(tmp_path, name, content, label):
    if name.endswith(".npy"):
        np.save(tmp_path / name, content)
    else:
        if isinstance(content, np.ndarray):
            content = Image.fromarray(content if content.dtype == np.uint16 else content.astype(np.uint8))
        content.save(tmp_path / name)
    mask = read_mask_file(tmp_path / name, label)
    assert overlap(mask, DISC) > (0.95 if content is SMOOTH or name in ("m.jpg", "m.webp") else 0.9999)
    assert 0 <= mask.min() < mask.max() <= 1
    if label:
        with pytest.raises(InputError, match="m.png has the labels .*2.*, expected --label with one of them"):
            read_mask_file(tmp_path / name)
        assert not read_mask_file(tmp_path / name, 9).any(), "a frame may not show the object"


DEPTH = np.linspace(0.5, 3, 48, dtype=np.float32).reshape(6, 8)
UNKNOWN = np.where(np.arange(48).reshape(6, 8) < 4, [0, np.nan, np.inf, -1, 9, 9, 9, 9], DEPTH).astype(np.float32)
STORED = (1000 * DEPTH).astype(np.uint16)
STORED[0, :2] = 0, 65535


@pytest.mark.parametrize("name", ["d.npy", "d.npz", "d.tiff", "d.pfm", "d.geometric.png", "d16.png", "d16.tiff"])
def test_every_kind_of_depth_file_is_read_with_zeros_where_it_is_unknown(tmp_path, name):
    path, values = tmp_path / name, STORED if "16" in name else UNKNOWN
    if path.suffix == ".npy":
        np.save(path, values[..., None])
    elif path.suffix == ".npz":
        np.savez_compressed(path, depth=values)
    else:
        cv2.imwrite(str(path), encode_depth(values) if "geometric" in name else values)
    expected = np.where(np.arange(48).reshape(6, 8) < (2 if "16" in name else 4), 0, STORED if "16" in name else DEPTH)
    np.testing.assert_allclose(read_depth_file(path), expected, rtol=1e-3 if "geometric" in name else 0)
    if path.suffix != ".npy":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        with pytest.raises(InputError, match="cannot be decoded .* expected a complete") as caught:
            read_depth_file(path)
        assert "\n" not in str(caught.value)


def test_files_that_hold_something_else_are_refused_in_one_line(tmp_path):
    np.savez(tmp_path / "two.npz", a=DEPTH, b=DEPTH)
    (tmp_path / "d.exr").write_bytes(b"v/1\x01" + bytes(99))
    (tmp_path / "a.heic").write_bytes(bytes(99))
    Image.fromarray(SMOOTH).convert("RGB").save(tmp_path / "a.webp")
    (tmp_path / "half.webp").write_bytes((tmp_path / "a.webp").read_bytes()[:-40])
    assert read_picture(tmp_path / "a.webp")[0].shape == (32, 40, 3)
    for name, read, message in (
        ("two.npz", read_depth_file, "two.npz cannot be decoded"),
        ("d.exr", read_depth_file, "expected an OpenCV that reads .exr, or the depth as .npy or a float .tiff"),
        ("a.webp", read_depth_file, "holds uint8 of shape .*, expected numbers"),
        ("half.webp", read_picture, "half.webp cannot be decoded"),
        ("a.heic", read_picture, "HEIC is not read here, expected `pip install pillow-heif`|cannot be decoded"),
    ):
        with pytest.raises(InputError, match=message):
            read(tmp_path / name)


@pytest.fixture(scope="module")
def portrait():
    """A frame with an upright camera, higher than wide."""
    return render(look_at((1, 0.6, 0.4), size=(180, 140)), AT_HOME, "portrait")


def write_photograph(path, frame, tag, stored=True):
    """Write a photograph as a phone stores it, its depth and mask in the stored form, or as displayed."""
    exif = Image.Exif()
    exif[0x0112] = tag
    Image.fromarray(turn_image(frame.rgb, tag, back=True)).save(path, exif=exif, quality=98)
    shown = np.asarray(ImageOps.exif_transpose(Image.open(path)))
    assert np.abs(shown.astype(int) - frame.rgb).mean() < 3
    depth, mask = (turn_image(one, tag, back=True) if stored else one for one in (frame.depth, frame.mask))
    cv2.imwrite(str(path.with_name(f"{path.stem}_depth.png")), np.rint(1000 * depth).astype(np.uint16))
    write_mask(path.with_name(f"{path.stem}_mask.png"), mask)
    return path


@pytest.mark.parametrize("intrinsics", ["stored", "displayed"])
@pytest.mark.parametrize("form", ["stored", "displayed"])
@pytest.mark.parametrize("tag", range(1, 9))
def test_a_photograph_is_upright_with_its_depth_mask_and_camera_in_either_form(
    tmp_path, portrait, tag, form, intrinsics
):
    camera = replace(portrait.camera, principal_point=portrait.camera.principal_point + (4, 9))
    if tag < 5 and form != intrinsics:
        return  # the option says both
    path = write_photograph(tmp_path / "a.jpg", portrait, tag, form == "stored")
    given = [*camera.focal_length, *camera.principal_point]
    if intrinsics == "stored":
        x, y = turn_image(np.dstack(np.meshgrid(np.arange(140), np.arange(180))), tag, back=True).reshape(-1, 2).T
        at = np.flatnonzero((x == 74) & (y == 99))[0]  # of the stored pixel that is displayed at the principal point
        row, column = np.divmod(at, 140 if tag < 5 else 180)
        given[2:] = column, row
    if tag in (2, 3, 4):
        with pytest.raises(InputError, match=f"orientation {tag}, .* --orientation stored or --orientation displayed"):
            open_source(path, given).load([0])
    (frame,) = open_source(path, given, orientation=form if tag in (2, 3, 4) else None).load([0])
    np.testing.assert_allclose(frame.depth, portrait.depth, atol=6e-4)
    np.testing.assert_array_equal(frame.mask, portrait.mask)
    np.testing.assert_allclose(frame.camera.K, camera.K, atol=1.01)
    np.testing.assert_allclose(frame.camera.R, np.eye(3), atol=1e-12)
    assert np.abs(frame.rgb.astype(int) - portrait.rgb).mean() < 3


def test_a_capture_of_turned_photographs_keeps_its_world_and_refuses_mirrored_ones(tmp_path):
    views = around(AT_HOME, 2)
    write_nerfstudio(tmp_path, views)  # the camera is that of the stored pixels
    for view, tag in zip(views, (6, 5), strict=True):
        picture = Image.open(tmp_path / f"images/{view.name}.jpg")
        picture.getexif()[0x0112] = tag
        picture.save(tmp_path / f"images/{view.name}.jpg", exif=picture.getexif(), quality=98)
    first, second = READERS["nerfstudio"](tmp_path)
    frame = first.load()
    assert frame.depth.shape == (180, 140)
    y, x = np.argwhere(frame.mask > 0)[::97].T
    points = frame.camera.unproject(np.stack([x, y], -1) + 0.5, frame.depth[y, x])
    pixels, _ = views[0].camera.project(points)
    np.testing.assert_allclose(pixels, np.stack([y, 139 - x], -1) + 0.5, atol=0.01)
    with pytest.raises(InputError, match="0001.jpg is mirrored by its EXIF orientation 5"):
        second.load()
    square = replace(first, camera=look_at((1, 0, 0), size=(140, 180)), image=tmp_path / "square.jpg")
    Image.new("RGB", (64, 64)).save(square.image, exif=picture.getexif())
    with pytest.raises(InputError, match="square.jpg has EXIF orientation .* expected --orientation stored"):
        square.load()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((600, 600, 320, 240), "^$"),
        ((600, 600, 280, 260), "^$"),
        ((1200, 1200, 640, 480), "fit an image.* of 1280 x 960, not of 640 x 480 .*: .* 600,600,320,240$"),
        ((300, 300, 160, 120), "fit an image.* of 320 x 240, not of 640 x 480 .*: .* 600,600,320,240$"),
        ((240, 240, 128, 96), "fit an image.* of 256 x 192, not of 640 x 480 .*: .* 600,600,320,240$"),
        ((1200, 1200, 900, -200), r"far from the middle of 640 x 480 pixels, as a crop has$"),
        ((0.9375, 1.25, 0.5, 0.5), "view of .* look normalised: .* 600,600,320,240$"),
        ((4.2, 4.2, 2.8, 2.1), "view of .* millimetres, of 5.6 x 4.2, .*: .* 480,480,320,240$"),
        ((1, 1, 320, 240), "a.jpg: intrinsics 1,1,320,240 have a field of view of 180 degrees, expected 10 to 120"),
        ((9000, 9000, 320, 240), "view of 4.07 degrees"),
    ],
)
def test_intrinsics_of_another_image_or_unit_are_questioned_with_the_corrected_numbers(values, message):
    camera = Camera(np.eye(3), np.zeros(3), np.array(values[:2]), np.array(values[2:]), (480, 640))
    if "view of" not in message:
        assert re.search(message, question_intrinsics(camera, "a.jpg"))
    else:
        with pytest.raises(InputError, match=message):
            question_intrinsics(camera, "a.jpg")


def test_frames_without_a_mask_get_one_by_depth_and_are_named(tmp_path):
    scenes = [ball_on_floor(direction) for direction in DIRECTIONS]
    views = [replace(frame, mask=truth.astype(np.float32), name=str(k)) for k, (frame, truth) in enumerate(scenes)]
    write_lists(tmp_path, views)
    capture = READERS["lists"](tmp_path)
    with pytest.raises(InputError, match="0.jpg has no mask, expected .* or --mask auto"):
        import_capture(capture, tmp_path / "none", "ball", "one")
    done = import_capture(capture, tmp_path / "auto", "ball", "one", mask="auto")
    assert (done.frames, done.flags) == (4, ())
    for view in views[1:]:
        write_mask(tmp_path / f"masks/{view.name}.png", 1 - view.mask if view.name == "3" else view.mask)
    source = open_source(tmp_path)
    frames = source.load([0, 1])
    assert source.mask == "given" and overlap(frames[0].mask, scenes[0][1]) > 0.95
    np.testing.assert_array_equal(frames[1].mask, views[1].mask)
    inverted, missing = source.flags(source.load([0, 1, 3]))
    assert inverted.endswith("the masks of 1 of 3 frames cover most of the border: inverted?")
    assert missing.endswith("1 of 4 frames have no mask, it is made by depth: 0")
    done = import_capture(READERS["lists"](tmp_path), tmp_path / "some", "ball", "one")
    assert done.frames == 4 and "1 of 4 frames have no mask, it is made by depth: 0.jpg" in done.flags
    assert any("1 of 4 frames cover most of the border" in flag for flag in done.flags)


def test_depth_of_another_shape_is_refused_with_what_is_allowed(tmp_path, portrait):
    path = write_photograph(tmp_path / "a.jpg", portrait, 1)
    for shape in ((90, 90), (360, 280)):
        np.save(tmp_path / "z.npy", np.ones(shape, np.float32))
        source = open_source(path, (190, 190, 70, 90), depth=tmp_path / "z.npy")
        with pytest.raises(
            InputError, match=r"expected \(H, W\) = \(180, 140\) as the image, or smaller with its aspect"
        ):
            source.load([0])
    np.save(tmp_path / "a_depth.npy", np.full((90, 70, 1), 1e10))
    (tmp_path / "a_depth.png").unlink()
    assert not open_source(path, np.array([[190, 0, 70], [0, 190, 90], [0, 0, 1]])).load([0])[0].depth.any()


def test_the_pose_of_a_sideways_portrait_is_that_of_the_upright_one(tmp_path, portrait):
    """By the command; a second run leaves no file of the first, and a single image is a helper."""
    write_photograph(tmp_path / "upright.png", portrait, 1)
    write_photograph(tmp_path / "sideways.jpg", portrait, 6)
    write_photograph(tmp_path / "third.jpg", render(look_at((1, 0.2, 0.5), size=(180, 140)), AT_HOME), 1)
    write_lists(tmp_path / "scan", around(ELSEWHERE, 4))
    given = (190, 190, 70, 90)
    out, poses = tmp_path / "out", []
    out.mkdir()
    (out / "aligned_paper.ply").touch()
    for name, helpers in (("upright.png", ()), ("sideways.jpg", ()), ("sideways.jpg", [tmp_path / "third.jpg"])):
        found = estimate_pose(
            tmp_path / name, tmp_path / "scan", targets=9, references=1, intrinsics=given, helpers=helpers,
            backbone=CoordinateBackbone(), out=out,
        )  # fmt: skip
        poses.append(found.world_sim3.R)
        assert any("the target has 4 frames: these are used, not 9" in flag for flag in found.estimate.flags)
    assert rotation_error(poses[0], poses[1]) < 3 and rotation_error(poses[0], poses[2]) < 15
    assert {path.name for path in out.iterdir()} == {"report.html", "target.ply", "aligned_verified.ply"}
    values = {"intrinsics": (given, given, (200, 200, 70, 90))}
    images = [tmp_path / name for name in ("upright.png", "sideways.jpg", "third.jpg")]
    assert [one.load([0])[0].camera.K[0, 0] for one in open_pair(*images[:2], values, images[2:])] == [190, 190, 200]


def test_a_link_to_a_sequence_is_one_and_the_root_of_the_disk_is_no_folder_for_results(
    tmp_path, links, ellipsoids, capsys
):
    (tmp_path / "mine").symlink_to(ellipsoids.root / "ellipsoid/a")
    source = open_source(tmp_path / "mine")
    assert (source.format, source.name, len(source.numbers)) == ("sequence", "mine", 7)
    assert cli.main(["estimate", str(tmp_path / "mine"), str(tmp_path / "mine"), "--out", "/"]) == 2
    assert "is the root of the disk, expected a folder" in capsys.readouterr().err
