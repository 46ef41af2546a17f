"""Users' own photographs and captures: kinds of masks and of depth maps, EXIF orientations,
intrinsics."""

import re
import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest
from captures import write_depth16, write_lists, write_nerfstudio
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image, ImageOps
from refusals import refused
from synthetic_views import (
    ABOVE_FLOOR,
    AT_HOME,
    ELSEWHERE,
    CoordinateBackbone,
    around,
    look_at,
    object_on_floor,
    overlap,
    render,
)

from zsp_lite import estimate_pose, open_source
from zsp_lite.data.arrays import camera_from_pose
from zsp_lite.data.writing import encode_depth, write_mask
from zsp_lite.importers import open_capture
from zsp_lite.importers.files import (
    display_image,
    question_intrinsics,
    read_depth_file,
    read_mask_file,
    read_picture,
)
from zsp_lite.importers.sources import open_pair
from zsp_lite.metrics import rotation_error

RADIUS = np.hypot(*np.mgrid[-16:16, -20:20])  # pixels from the middle, (32, 40)
DISC = RADIUS < 9  # the object
RING = (RADIUS < 11) & ~DISC  # another object, or pixels that were left undecided
DEEP = DISC[..., None]  # with an axis of channels
SMOOTH = cv2.GaussianBlur(255 * DISC.astype(np.uint8), (9, 9), 0)
# The palette of Pascal VOC: black, red, green; the last colour is that of undecided pixels.
VOC = [0, 0, 0, 128, 0, 0, 0, 128, 0] + [224, 224, 192] * 253
# Pictures of the disc by file name; (picture, label) where the label of the object is to be given.
MASKS = {
    "0 and 255.png": 255 * DISC,
    "0 and 1.png": 1 * DISC,
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
    # Any colours; the fourth channel is the object.
    "cut out.png": np.dstack([np.arange(1280).reshape(32, 40, 1).repeat(3, 2) % 256, 255 * DISC]),
    "alpha.png": np.where(DEEP, [255] * 4, [255, 255, 255, 0]),
}


@pytest.mark.parametrize("name", MASKS)
def test_every_kind_of_mask_shows_the_object(tmp_path, name):
    mask, label = MASKS[name], None
    if isinstance(mask, tuple):
        mask, label = mask
    path = tmp_path / name
    if name.endswith(".npy"):
        np.save(path, mask)
    else:
        image = mask if isinstance(mask, Image.Image) else Image.fromarray(mask.astype(np.uint8))
        if name.startswith("palette"):
            image.putpalette(VOC)
        image.save(path)
    # Smooth edges and lossy formats change pixels at the edge.
    least = 0.95 if re.search("smooth|jpg|webp", name) else 0.9999
    assert overlap(read_mask_file(path, label), DISC) > least
    if label:
        refused("has the labels 1, 2|2, 5, expected --label with one of them", read_mask_file, path)
        assert not read_mask_file(path, 9).any(), "a frame may not show the object"


# A depth map in metres, (6, 8), with unknown values in the first half of its first row: as
# floating-point numbers, and as millimetres in 16 bits. The nines only fill the row.
UNKNOWN = np.arange(48).reshape(6, 8) < 4
DEPTH = np.linspace(0.5, 3, 48, dtype=np.float32).reshape(6, 8)
FLOAT = np.where(UNKNOWN, np.float32([0, np.nan, np.inf, -1, 9, 9, 9, 9]), DEPTH)
STORED = np.where(
    UNKNOWN, np.uint16([0, 65535, 0, 0, 9, 9, 9, 9]), (1000 * DEPTH).astype(np.uint16)
)


@pytest.mark.parametrize("name", "d.npy d.npz d.tiff d.pfm d.geometric.png 16.png 16.tiff".split())
def test_a_depth_file_is_read_with_zeros_where_it_is_unknown_and_refused_if_cut(tmp_path, name):
    path = tmp_path / name
    values = STORED if "16" in name else FLOAT
    if path.suffix == ".npy":
        np.save(path, values[..., None])
    elif path.suffix == ".npz":
        np.savez_compressed(path, depth=values)
    else:
        cv2.imwrite(str(path), encode_depth(values) if "geometric" in name else values)
    expected = np.where(UNKNOWN, 0, values)
    # CO3D's PNG files hold numbers of 16 bits, all others are exact.
    assert_allclose(read_depth_file(path), expected, rtol=1e-3 if "geometric" in name else 0)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    refused("cannot be decoded .* expected a complete", read_depth_file, path)


ORIENTATION = 0x0112  # the tag of EXIF; its values are 1 (upright) to 8


@pytest.fixture(scope="module")
def portrait():
    """A frame with an upright camera, higher than wide."""
    return render(look_at((1, 0.6, 0.4), size=(180, 140)), AT_HOME, "portrait")


def as_stored(image, tag):
    """An upright image as a phone stores it with an orientation."""
    # Quarter turns in either direction undo each other; all other orientations undo themselves.
    return display_image(image, {6: 8, 8: 6}.get(tag, tag))


def write_photograph(path, frame, tag, stored=True):
    """Write a photograph as a phone stores it, with its depth and mask, which are in the stored
    form or as displayed."""
    exif = Image.Exif()
    exif[ORIENTATION] = tag
    Image.fromarray(as_stored(frame.rgb, tag)).save(path, exif=exif, quality=98)
    # Pillow agrees that it is upright; the difference is that of JPEG.
    shown = np.asarray(ImageOps.exif_transpose(Image.open(path)))
    assert np.abs(shown.astype(int) - frame.rgb).mean() < 3
    depth, mask = frame.depth, frame.mask
    if stored:
        depth, mask = as_stored(depth, tag), as_stored(mask, tag)
    write_depth16(path.with_name(f"{path.stem}_depth.png"), depth)
    write_mask(path.with_name(f"{path.stem}_mask.png"), mask)
    return path


@pytest.mark.parametrize(
    "tag",  # its type, its number of values, and a value or an offset
    [
        (3, 1, b"\x60\xea\0\0"),
        (2, 4, b"abc\0"),
        (5, 1, b"\xff" * 4),
        (3, 1 << 31, bytes(4)),
    ],
)
def test_a_damaged_orientation_is_ignored(tmp_path, tag):
    # The directory of EXIF names itself as the next one.
    directory = b"Exif\0\0II*\0\x08\0\0\0\x01\0" + struct.pack("<HHI4sI", ORIENTATION, *tag, 8)
    jpeg = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    length = (len(directory) + 2).to_bytes(2)
    (tmp_path / "a.jpg").write_bytes(jpeg[:2] + b"\xff\xe1" + length + directory + jpeg[2:])
    assert read_picture(tmp_path / "a.jpg")[1] == 1


@pytest.mark.parametrize("form", ["stored", "displayed"])
@pytest.mark.parametrize("tag", range(1, 9))
def test_a_photograph_is_upright_with_its_depth_mask_and_camera_in_either_form(
    tmp_path, portrait, tag, form
):
    path = write_photograph(tmp_path / "a.jpg", portrait, tag, form == "stored")
    # The principal point as displayed, and the pixel that shows it in the stored image.
    x, y = 74, 99
    spot = np.zeros((180, 140))
    spot[y, x] = 1
    row, column = np.argwhere(as_stored(spot, tag))[0]
    # These orientations keep the size: nothing shows which form the files have.
    ambiguous = tag in (2, 3, 4)
    for intrinsics in [form] if ambiguous else ["stored", "displayed"]:
        given = (190, 190, column, row) if intrinsics == "stored" else (190, 190, x, y)
        if ambiguous:
            refused(
                f"orientation {tag} .* --orientation stored or",
                lambda: open_source(path, given).load([0]),
            )
        (frame,) = open_source(path, given, orientation=form if ambiguous else None).load([0])
        assert_allclose(frame.depth, portrait.depth, atol=6e-4)  # millimetres
        assert_array_equal(frame.mask, portrait.mask)
        # A pixel is turned above, a point by the library: they are up to a pixel apart.
        assert_allclose(frame.camera.K, [[190, 0, x], [0, 190, y], [0, 0, 1]], atol=1.01)
        assert_allclose(frame.camera.R, np.eye(3), atol=1e-12)
        assert np.abs(frame.rgb.astype(int) - portrait.rgb).mean() < 3


def test_a_capture_of_turned_photographs_keeps_its_world_and_refuses_mirrored_ones(tmp_path):
    views = around(AT_HOME, 2)
    write_nerfstudio(tmp_path, views)  # the cameras are those of the stored pixels
    quarter_turn, mirrored = 6, 5
    for view, tag in zip(views, (quarter_turn, mirrored), strict=True):
        path = tmp_path / f"images/{view.name}.jpg"
        picture = Image.open(path)
        picture.getexif()[ORIENTATION] = tag
        picture.save(path, exif=picture.getexif(), quality=98)
    (turned,), (line,) = open_capture(tmp_path, "nerfstudio")
    frame = turned.load()
    assert frame.depth.shape == (180, 140)
    # The pixel (x, y) of the upright image is (y, 139 - x) of the stored one.
    y, x = np.argwhere(frame.mask > 0)[::97].T  # some pixels of the object
    points = frame.camera.unproject(np.stack([x, y], -1) + 0.5, frame.depth[y, x])
    pixels, _ = views[0].camera.project(points)
    assert_allclose(pixels, np.stack([y, 139 - x], -1) + 0.5, atol=0.01)
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
    # A wrong angle of view is refused, all else is a flag.
    if message and "view of" in message:
        refused(message, question_intrinsics, camera, "a.jpg")
    else:
        doubt = question_intrinsics(camera, "a.jpg")
        assert re.search(message, doubt) if message else not doubt


# Options of an import to a new data folder.
NEW = "--category lump --sequence one --root imported"


@pytest.fixture
def on_floor(tmp_path, monkeypatch):
    """Four frames of an object on a floor, with true masks, written to `tmp_path`, the working
    folder, as lists without masks."""
    frames = []
    for number, direction in enumerate(ABOVE_FLOOR):
        frame, truth = object_on_floor(direction)
        frames.append(replace(frame, mask=truth.astype(np.float32), name=str(number)))
    write_lists(tmp_path, frames)
    monkeypatch.chdir(tmp_path)
    return frames


@pytest.fixture
def partly_masked(tmp_path, on_floor):
    """The folder "others" with a mask of each frame but the first; the last mask is inverted."""
    for frame in on_floor[1:]:
        mask = 1 - frame.mask if frame is on_floor[-1] else frame.mask
        write_mask(tmp_path / f"others/{frame.name}.png", mask)
    return tmp_path / "others"


def test_a_capture_without_masks_is_imported(tmp_path, on_floor, run):
    text = run(f"data import {tmp_path} --mask auto --frames 3 {NEW}")
    assert "3 frames" in text
    assert "flag" not in text


def test_a_frame_without_a_mask_gets_one_by_depth(tmp_path, on_floor, partly_masked):
    source = open_source(tmp_path, masks=partly_masked)
    found, given = source.load([0, 1])
    assert source.mask == "given"
    assert overlap(found.mask, on_floor[0].mask > 0) > 0.95
    assert_array_equal(given.mask, on_floor[1].mask)


def test_missing_and_inverted_masks_are_named(tmp_path, partly_masked, run):
    source = open_source(tmp_path, masks=partly_masked)
    missing, inverted = source.flags(source.load([0, 1, 3]))
    assert missing.endswith("no mask is given for 0.jpg: found by depth")
    wrong = "the masks may be wrong: those of 1 of {} frames cover most of the border: inverted?"
    assert inverted.endswith(wrong.format(3))
    text = run(f"data import {tmp_path} --masks {partly_masked} {NEW}")
    assert "4 frames" in text
    assert "flag: no mask is given for 0.jpg: found by depth\n" in text
    assert wrong.format(4) in text


INTRINSICS = (190, 190, 70, 90)  # of the portrait as displayed


def test_depth_of_another_shape_is_refused_and_depth_too_far_for_any_scene_unknown(
    tmp_path, portrait
):
    path = write_photograph(tmp_path / "a.jpg", portrait, 1)
    source = open_source(path, np.array([[190, 0, 70], [0, 190, 90], [0, 0, 1]]))
    depth = tmp_path / "a_depth.png"
    cv2.imwrite(str(depth), np.ones((90, 90), np.uint16))
    message = r"= \(180, 140\) as the image, or smaller with its aspect ratio"
    refused(message, source.load, [0])
    source = open_source(path, INTRINSICS, depth_unit=1e4)  # 2 becomes 20 km
    cv2.imwrite(str(depth), np.full((90, 70), 2, np.uint16))
    assert not source.load([0])[0].depth.any()


@pytest.fixture
def photographs(tmp_path, portrait):
    """The portrait as an upright, a sideways and a second upright photograph."""
    tags = {"upright.png": 1, "sideways.jpg": 6, "third.jpg": 1}
    return [write_photograph(tmp_path / name, portrait, tag) for name, tag in tags.items()]


def test_the_pose_of_a_sideways_portrait_is_that_of_the_upright_one(tmp_path, photographs):
    upright, sideways, third = photographs
    write_lists(tmp_path / "scan", around(ELSEWHERE, 4))
    out = tmp_path / "out"
    out.mkdir()
    (out / "aligned_paper.ply").touch()  # of an earlier run: a later one removes it
    rotations = []
    for image, helpers in ((upright, ()), (sideways, [third])):
        # A report is made once, of the last one.
        result = estimate_pose(
            image,
            tmp_path / "scan",
            targets=9,
            helpers=helpers,
            references=1,
            intrinsics=INTRINSICS,
            backbone=CoordinateBackbone(),
            out=out if helpers else None,
        )
        rotations.append(result.world_sim3.R)
        flags = "; ".join(result.estimate.flags)
        assert "number of target views: 4, all that there are, not 9" in flags
    # In degrees. JPEG changes the colours, and so the features; a helper changes the pose, too.
    assert rotation_error(*rotations) < 15
    names = {path.name for path in out.iterdir()}
    assert names == {"report.html", "target.ply", "aligned_verified.ply"}


def test_helpers_may_have_intrinsics_of_their_own(photographs):
    reference, target, helper = photographs
    options = {"intrinsics": (INTRINSICS, INTRINSICS, (200, 200, 70, 90))}
    sources = open_pair(reference, target, options, [helper])
    assert [source.load([0])[0].camera.K[0, 0] for source in sources] == [190, 190, 200]


def test_a_link_to_a_sequence_is_a_sequence(links, tmp_path, ellipsoids):
    (tmp_path / "mine").symlink_to(ellipsoids.root / "ellipsoid/a")
    source = open_source(tmp_path / "mine")
    assert (source.format, source.name, len(source.numbers)) == ("sequence", "mine", 7)


def test_the_root_of_the_disk_is_no_folder_for_results(tmp_path, ellipsoids):
    sequence = ellipsoids.root / "ellipsoid/a"
    refused("is the root of the disk", estimate_pose, sequence, sequence, out=tmp_path.anchor)
