"""Sequences, captures and images are opened by their path; masks come from them, from a box or from depth."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from synthetic_views import AT_HOME, look_at, render
from test_importers import write_lists, write_nerfstudio, write_tum

from zsp_lite.cli.estimate import MASKS, SOLVERS
from zsp_lite.data.frames import Frame, write_image, write_mask
from zsp_lite.errors import InputError
from zsp_lite.importers.convert import READERS, capture_format
from zsp_lite.importers.geometry_masks import masks_from_depth
from zsp_lite.pair_result import SOLVER_CHOICES
from zsp_lite.sources import MASK_CHOICES, open_pair, open_source

RADIUS, INTRINSICS = 0.3, (190.0, 190.0, 89.5, 69.5)


def ball_on_floor(direction, distance: float = 2.0) -> tuple[Frame, np.ndarray]:
    """A frame of a ball on a floor in front of a wall, in metres, and the true mask; the depth has holes."""
    camera = look_at(direction, distance)
    height, width = camera.size
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = camera.unproject_camera(np.stack([x, y], -1), np.ones((height, width))) @ camera.R  # world directions
    start = camera.centre
    along, across = rays @ start, np.square(rays).sum(axis=-1)
    root = along**2 - across * (start @ start - RADIUS**2)
    on_ball = root > 0
    ball = np.where(on_ball, (-along - np.sqrt(np.maximum(root, 0))) / across, np.inf)
    with np.errstate(divide="ignore"):
        surfaces = [(-RADIUS - start[2]) / rays[..., 2], (-1.2 - start[0]) / rays[..., 0]]
    depth = np.minimum(ball, np.min([np.where(one > 0, one, np.inf) for one in surfaces], axis=0))
    depth = np.where(np.isfinite(depth) & (depth < 8), depth, 0)
    holes = np.random.default_rng(0).uniform(size=(height // 7, width // 9)) < 0.3
    depth[cv2.resize(holes.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0] = 0
    return Frame(np.full((height, width, 3), 90, np.uint8), depth.astype(np.float32), None, camera), on_ball


def overlap(mask, truth):
    found = mask > 0.5
    return (found & truth).sum() / (found | truth).sum()


@pytest.mark.parametrize("count", [1, 4])
def test_the_object_on_a_floor_is_found_from_depth_alone(count):
    directions = [(1, 0.2, 0.6), (0.4, 1, 0.5), (0.7, -0.8, 0.4), (1, 0.5, 1.5)]
    scenes = [ball_on_floor(direction) for direction in directions[:count]]
    masked = masks_from_depth([frame for frame, _ in scenes])
    assert min(overlap(frame.mask, truth) for frame, (_, truth) in zip(masked, scenes)) > 0.85


def test_the_plane_is_found_in_any_unit_of_length():
    frame, truth = ball_on_floor((1, 0.2, 0.6))
    scaled = replace(frame, depth=frame.depth * 1000, camera=replace(frame.camera, t=frame.camera.t * 1000))
    (masked,) = masks_from_depth([scaled])
    assert overlap(masked.mask, truth) > 0.85


def test_depth_without_an_object_is_refused():
    frame, _ = ball_on_floor((1, 0.2, 0.6))
    with pytest.raises(InputError, match="no depth is known"):
        masks_from_depth([replace(frame, depth=np.zeros_like(frame.depth))])
    with pytest.raises(InputError, match="no depth map"):
        masks_from_depth([replace(frame, depth=None)])
    wall = replace(frame, depth=np.full_like(frame.depth, 2))
    with pytest.raises(InputError, match="nothing stands out"):
        masks_from_depth([wall])


@pytest.fixture(scope="module")
def frames():
    """Four views around an object, in metres."""
    angles = np.linspace(0, 2 * np.pi, 4, endpoint=False)
    return [render(look_at((np.cos(a), np.sin(a), 0.3)), AT_HOME, f"{k:04d}") for k, a in enumerate(angles)]


@pytest.fixture
def image(tmp_path, frames):
    return write_picture(tmp_path / "cup.jpg", frames[0])


def write_picture(path, frame, mask=True):
    write_image(path, frame.rgb, 98)
    cv2.imwrite(str(path.with_name(f"{path.stem}_depth.png")), np.rint(1000 * frame.depth).astype(np.uint16))
    if mask:
        write_mask(path.with_name(f"{path.stem}_mask.png"), frame.mask)
    return path


def test_a_sequence_of_a_data_folder_is_read_with_its_numbers_and_masks(ellipsoids):
    source = open_source(ellipsoids.root / "ellipsoid/b")
    assert (source.kind, source.mask, source.numbers) == ("sequence", "given", (0, 1, 2, 3, 4, 5, 6))
    assert source.spread(3) == [0, 2, 4] and source.spread(50) == [0, 1, 2, 3, 4, 5, 6]
    (frame,) = source.load([source.position(5)])
    expected = ellipsoids.load(ellipsoids.frame("ellipsoid", "b", 5))
    np.testing.assert_array_equal(frame.rgb, expected.rgb)
    np.testing.assert_array_equal(frame.mask, expected.mask)
    assert source.describe([0, 2]).endswith("ellipsoid/b, frames 0, 2") and source.first_usable()[0] == 0
    with pytest.raises(InputError, match="no frame 7, expected one of 7 from 0 to 6"):
        source.position(7)


def test_a_source_named_by_a_dot_has_the_name_of_its_folder(ellipsoids, monkeypatch):
    monkeypatch.chdir(ellipsoids.root / "ellipsoid/b")
    assert open_source(".").name == "b"


def test_the_command_line_offers_the_choices_of_the_library():
    assert SOLVERS == tuple(SOLVER_CHOICES) and MASKS == MASK_CHOICES


def test_an_image_is_read_with_the_files_beside_it(image, frames):
    source = open_source(image, INTRINSICS)
    assert (source.kind, source.mask, len(source)) == ("image", "given", 1)
    (frame,) = source.load([0])
    np.testing.assert_allclose(frame.depth, frames[0].depth, atol=6e-4)
    np.testing.assert_allclose(frame.camera.K, frames[0].camera.K)
    np.testing.assert_array_equal(frame.mask, frames[0].mask)


def test_depth_of_an_image_may_have_another_name_and_unit(image, tmp_path, frames):
    np.save(tmp_path / "z.npy", frames[0].depth * 50)
    (frame,) = open_source(image, INTRINSICS, depth=tmp_path / "z.npy", depth_unit=0.02).load([0])
    np.testing.assert_allclose(frame.depth, frames[0].depth, atol=1e-5)


@pytest.mark.parametrize(
    ("layout", "write", "mask"), [("nerfstudio", write_nerfstudio, "given"), ("lists", write_lists, "auto")]
)
def test_a_capture_is_recognised_by_its_files(tmp_path, frames, layout, write, mask):
    write(tmp_path, frames)
    assert capture_format(tmp_path) == layout
    source = open_source(tmp_path)
    assert (source.kind, source.numbers, source.mask) == ("capture", (0, 1, 2, 3), mask)
    np.testing.assert_allclose(source.load([2])[0].camera.centre, frames[2].camera.centre, atol=1e-4)


def test_a_tum_capture_takes_intrinsics(tmp_path, frames):
    write_tum(tmp_path, frames)
    source = open_source(tmp_path, INTRINSICS)
    np.testing.assert_allclose(source.load([1])[0].camera.K, frames[1].camera.K)


def test_a_box_gives_masks_to_every_frame(tmp_path, frames):
    write_lists(tmp_path, frames)
    inside = np.argwhere(frames[0].mask > 0)
    (top, left), (bottom, right) = inside.min(axis=0) - 4, inside.max(axis=0) + 5
    source = open_source(tmp_path, box=(int(top), int(left), int(bottom - top), int(right - left)))
    assert source.mask == "box"
    masked = source.load([3, 1])
    assert [frame.name for frame in masked] == ["0003.jpg", "0001.jpg"]
    assert min(overlap(frame.mask, frames[k].mask > 0.5) for frame, k in zip(masked, (3, 1))) > 0.7


def test_options_go_to_the_sources_that_take_them(image, tmp_path, ellipsoids, frames):
    other = write_picture(tmp_path / "mug.jpg", frames[1], mask=False)
    sequence = ellipsoids.root / "ellipsoid/a"
    first, second = open_pair(sequence, other, {"intrinsics": (INTRINSICS,), "mask": ()})
    assert (first.kind, second.kind, second.mask) == ("sequence", "image", "auto")
    wide = (100.0, 100.0, 89.5, 69.5)
    pair = open_pair(image, other, {"intrinsics": (INTRINSICS, wide), "mask": ("auto",), "box": ()})
    assert [one.load([0])[0].camera.focal_length[0] for one in pair] == [190, 100]
    assert [one.mask for one in pair] == ["auto", "auto"]
    pair = open_pair(image, other, {"intrinsics": (INTRINSICS,), "box": ((1, 2, 30, 40),)})
    assert [one.box for one in pair] == [(1, 2, 30, 40), None]
    pair = open_pair(image, sequence, {"intrinsics": (INTRINSICS,), "depth": (tmp_path / "mug_depth.png",)})
    np.testing.assert_allclose(pair[0].load([0])[0].depth, frames[1].depth, atol=6e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "no intrinsics, expected --intrinsics FX,FY,CX,CY"),
        ({"intrinsics": INTRINSICS, "mask": "box"}, "expected --box TOP,LEFT,HEIGHT,WIDTH"),
        ({"intrinsics": INTRINSICS, "mask": "auto", "box": (1, 1, 9, 9)}, "--box goes with --mask box"),
        ({"intrinsics": INTRINSICS, "mask": "sam"}, "mask is 'sam', expected one of given, box, auto"),
        ({"intrinsics": (0.0, 190.0, 1.0, 1.0)}, "focal_length"),
        ({"intrinsics": INTRINSICS, "depth": "lost.png"}, "lost.png"),
    ],
)
def test_what_an_image_lacks_is_named_with_the_option_that_gives_it(image, options, message):
    with pytest.raises(InputError, match=message):
        open_source(image, **options)


def test_masks_and_depth_that_are_not_there_are_named_with_the_option_that_cures(tmp_path, frames):
    bare = write_picture(tmp_path / "bare.jpg", frames[0], mask=False)
    with pytest.raises(InputError, match="no mask, expected --mask auto or --box TOP,LEFT,HEIGHT,WIDTH"):
        open_source(bare, INTRINSICS, mask="given").load([0])
    (tmp_path / "bare_depth.png").unlink()
    with pytest.raises(InputError, match="bare_depth.png or bare_depth.npy beside it, expected .* --depth FILE"):
        open_source(bare, INTRINSICS)


def test_paths_that_are_no_source_are_refused(tmp_path, ellipsoids, frames):
    (tmp_path / "notes.txt").write_text("x")
    for path, message in (
        (tmp_path / "nowhere", "nowhere does not exist, expected CATEGORY/SEQUENCE"),
        (tmp_path / "notes.txt", "is neither a folder nor a JPEG or PNG file"),
        (ellipsoids.root / "ellipsoid", "is a category, expected one of its sequences: a, b"),
        (ellipsoids.root / "ellipsoid/c", "does not exist"),
        (tmp_path, "nerfstudio: transforms.json"),
    ):
        with pytest.raises(InputError, match=message):
            open_source(path)
    write_lists(tmp_path, frames)
    (tmp_path / "transforms.json").write_text("{}")
    with pytest.raises(InputError, match="files of the formats nerfstudio, lists, expected one"):
        open_source(tmp_path)


def test_options_that_no_source_takes_are_refused(ellipsoids, image):
    sequence = ellipsoids.root / "ellipsoid/a"
    with pytest.raises(InputError, match="--depth-unit does not go with a sequence of a data folder"):
        open_source(sequence, depth_unit=1.0)
    with pytest.raises(InputError, match="--intrinsics does not go with a sequence of a data folder and a sequence"):
        open_pair(sequence, sequence, {"intrinsics": (INTRINSICS,)})
    with pytest.raises(InputError, match="--mask is given 3 times, expected at most two"):
        open_pair(sequence, sequence, {"mask": ("auto",) * 3})
    with pytest.raises(InputError, match="--depth is given 1 times, expected one for each image"):
        open_pair(image, image, {"intrinsics": (INTRINSICS,), "depth": ("z.png",)})


def test_every_reader_has_a_sign_by_which_it_is_recognised():
    from zsp_lite.importers.convert import _SIGNS

    assert set(_SIGNS) == set(READERS)
