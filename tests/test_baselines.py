"""Baselines: networks load the published checkpoints, geometry is exact for exact input, RootSIFT is OpenCV's."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from synthetic_views import look_at, render, true_pose

from zsp_lite.alignment import Sim3
from zsp_lite.backbones.backbone import normalize
from zsp_lite.baselines import icp as icp_module
from zsp_lite.baselines.essential_matrix import essential_rotation
from zsp_lite.baselines.icp import align, icp
from zsp_lite.baselines.networks import (
    PoseContrast,
    ResNet50,
    euler_to_rotation,
    load_posecontrast,
    load_swav,
    square_crop,
)
from zsp_lite.baselines.sift import Keypoints, RootSift, Sift, dense_sift, mutual_matches, unproject_pixels
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.matching import Matches
from zsp_lite.metrics import rotation_error
from zsp_lite.views import object_crop


@pytest.fixture(scope="module")
def resnet():
    return ResNet50()


def test_resnet50_has_torchvisions_weights_and_its_layers_their_strides(resnet):
    model = resnet
    shapes = {key: tuple(x.shape) for key, x in model.state_dict().items()}
    # torchvision's 25,557,032 parameters and 320 entries without the last layer
    assert sum(x.numel() for x in model.parameters()) == 25_557_032 - 1000 * 2049 and len(shapes) == 318
    assert shapes["conv1.weight"] == (64, 3, 7, 7) and shapes["layer1.0.downsample.0.weight"] == (256, 64, 1, 1)
    assert shapes["layer2.0.conv2.weight"] == (128, 128, 3, 3) and shapes["layer3.5.bn3.running_var"] == (1024,)
    assert shapes["layer4.0.downsample.1.bias"] == (2048,) and shapes["layer4.2.conv1.weight"] == (512, 2048, 1, 1)
    assert [tuple(x.shape[1:]) for x in model(torch.zeros(1, 3, 64, 64))] == [(1024, 4, 4), (2048, 2, 2)]


def test_a_block_is_three_convolutions_and_a_shortcut(resnet):
    block = resnet.layer1[1]
    x = torch.rand(1, 256, 8, 8)
    first = torch.relu(block.bn1(torch.conv2d(x, block.conv1.weight)))
    second = torch.relu(block.bn2(torch.conv2d(first, block.conv2.weight, padding=1)))
    third = block.bn3(torch.conv2d(second, block.conv3.weight))
    assert torch.allclose(block(x), torch.relu(third + x), atol=1e-6)


@pytest.mark.slow
def test_the_swav_checkpoint_loads_and_describes_patches_on_the_papers_grid(resnet, tmp_path, monkeypatch):
    monkeypatch.setenv("ZSP_LITE_CACHE", str(tmp_path))
    state = resnet.state_dict() | {"projection_head.0.weight": torch.ones(8), "prototypes.weight": torch.ones(8)}
    state = {f"module.{key}": x for key, x in state.items()}
    path = tmp_path / "swav_800ep_pretrain.pth.tar"
    torch.save(state, path)
    (found,) = load_swav()([np.full((224, 224, 3), 100, np.uint8)])
    assert found.keys.shape == (28, 28, 1024) and found.global_feature.shape == (2048,) and found.saliency.min() == 1
    torch.save(state | {"module.conv1.weight": torch.zeros(64, 3, 5, 5)}, path)
    with pytest.raises(InputError, match="conv1.weight"):
        load_swav()


@pytest.mark.parametrize(
    ("load", "url", "variable"),
    [(load_swav, "https://dl.fbaipublicfiles.com/.*swav", "ZSP_LITE_SWAV"),
     (load_posecontrast, "https://github.com/.*PoseContrast", "ZSP_LITE_POSECONTRAST")],
)  # fmt: skip
def test_without_a_checkpoint_one_line_says_where_to_get_it(tmp_path, monkeypatch, load, url, variable):
    monkeypatch.setenv(variable, str(tmp_path / "nowhere.pth"))
    with pytest.raises(InputError, match=f"nowhere.pth.* download it from {url}.*, and set {variable} to its path$"):
        load()


def test_viewpoints_follow_the_convention_of_pascal3d():
    """At azimuth, elevation and in-plane rotation 0, the camera is at -y and looks along +y with +z up."""
    front = euler_to_rotation(np.array([0.0, 90.0, 180.0]))
    assert front == pytest.approx(np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]), abs=1e-12)
    # From above (elevation 90 degrees), +y of the object is up in the image.
    above = euler_to_rotation(np.array([0.0, 180.0, 180.0]))
    assert above @ (0, 1, 0) == pytest.approx((0, -1, 0), abs=1e-12)
    assert above @ (0, 0, 1) == pytest.approx((0, 0, -1), abs=1e-12)


@pytest.mark.slow
def test_the_posecontrast_checkpoint_loads_and_its_difference_is_the_relative_pose(tmp_path, monkeypatch):
    network, path = PoseContrast(), tmp_path / "posecontrast.pth"
    head, features = network.net_vp.state_dict(), network.net_feat.state_dict()
    features |= {"fc.weight": torch.ones(128, 2048), "fc.bias": torch.ones(128)}
    torch.save({"epoch": 14, "net_feat": features, "net_vp": head}, path)
    monkeypatch.setenv("ZSP_LITE_POSECONTRAST", str(path))
    frame = object_crop(render(look_at((1, 0.2, 0.4), size=(60, 80)), Sim3.identity()))
    (found,) = load_posecontrast().describe([frame])
    batch = normalize(torch.from_numpy(square_crop(frame)).permute(2, 0, 1)[None] / 255)
    x = network.net_feat(batch)[-1].mean((2, 3))
    torch.testing.assert_close(found.feature, x[0])
    x, angles = network.net_vp["compress"](x)[0], []
    for name, bins in (("azi", 24), ("ele", 12), ("inp", 24)):
        score, offset = (
            head[f"fc_{kind}_{name}.weight"] @ x + head[f"fc_{kind}_{name}.bias"] for kind in ("cls", "reg")
        )
        assert len(score) == bins
        angles.append(15 * (int(score.argmax()) + float(offset[score.argmax()])))
    assert rotation_error(found.rotation, euler_to_rotation(np.clip(angles, 0, 360))) < 0.1
    assert {"compress.0.weight", "compress.1.running_mean", "compress.7.bias"} <= head.keys()
    for content in ([1], {"net_feat": features}, {"net_feat": {}, "net_vp": {}}):
        torch.save(content, path)
        with pytest.raises(InputError, match="posecontrast"):
            load_posecontrast()


def test_a_square_crop_has_the_aspect_ratio_of_the_photograph():
    frame = render(look_at((1, 0.2, 0.4), size=(60, 80)), Sim3.identity())
    square = square_crop(object_crop(replace(frame, mask=None)))
    assert (square[:27] == 0).all() and (square[197:] == 0).all() and square[57:167].any()


def test_icp_finds_a_small_motion_of_a_cloud_and_its_scale():
    rng = np.random.default_rng(0)
    source = rng.normal(size=(400, 3)) * (1.5, 1.0, 0.6)
    truth = Sim3(1.1, Rotation.from_rotvec([0.05, -0.08, 0.06]).as_matrix(), np.array([0.05, 0.02, -0.04]))
    found = icp(source, truth.apply(source))
    assert rotation_error(found.R, truth.R) < 0.1 and found.scale == pytest.approx(1.1, rel=1e-3)
    with pytest.raises(InputError):
        icp(source, np.zeros((20, 3)))


def test_icp_is_initialised_by_the_first_cameras(monkeypatch):
    """Two sequences of the same object, whose first cameras differ by a few degrees."""
    clouds = []
    monkeypatch.setattr(icp_module, "icp", lambda *points: (clouds.extend(points), Sim3.identity())[1])
    cameras = [look_at(side) for side in [(1.0, 0.1, 0.3), (0.95, 0.2, 0.35), (-0.2, 1.0, 0.3)]]
    # As in CO3D, the first camera has the same rotation in the world of every sequence.
    turn = cameras[0].R.T @ cameras[1].R
    placements = Sim3.identity(), Sim3(1.0, turn, np.zeros(3))
    first = render(cameras.pop(0), placements[0])
    cameras = [replace(camera, R=camera.R @ turn.T) for camera in cameras]
    targets = [render(camera, placements[1]) for camera in cameras]
    firsts = first.camera, targets[0].camera
    found = align(first, targets, 0, firsts, seed=0)
    assert rotation_error(found.R, np.eye(3)) < 1e-6
    source, target = clouds
    assert len(source) <= icp_module.POINTS and len(target) == icp_module.POINTS
    distance, _ = cKDTree(target).query(source)
    truth = true_pose(first.camera, placements[0], cameras[0], placements[1])
    assert np.median(distance) < 0.15 and 2 < rotation_error(found.R, truth.R) < 10
    # With the true pose, both clouds coincide.
    placed = firsts[1].to_world(truth.apply(firsts[0].to_camera(source)))
    assert np.median(cKDTree(target).query(placed)[0]) < 0.05


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 256, (28, 28, 3), dtype=np.uint8)
    return cv2.resize(noise, (224, 224), interpolation=cv2.INTER_CUBIC)


def test_sift_matches_an_image_with_its_rotated_copy(picture):
    camera = look_at((1, 0, 0), size=(224, 224))
    mask = np.zeros((224, 224), np.float32)
    mask[40:200, 30:190] = 1
    turned = Frame(np.ascontiguousarray(np.rot90(picture)), None, np.rot90(mask), camera)
    one, two = Sift().describe([Frame(picture, None, mask, camera), turned])
    a, b, similarity = mutual_matches(one, two)
    assert len(a) == 50 and (np.diff(similarity) <= 0).all()
    x, y = one.pixels[a].T
    turned = np.stack([y, 224 - x], axis=1)
    assert np.median(np.linalg.norm(turned - two.pixels[b], axis=1)) < 0.1
    assert (one.pixels > (29, 39)).all() and (one.pixels < (191, 201)).all()
    empty = Keypoints(np.empty((0, 2)), np.empty((0, 128), np.float32))
    assert len(mutual_matches(one, empty)[0]) == 0
    blank = Frame(np.zeros((224, 224, 3), np.uint8), None, mask, camera)
    assert len(Sift().describe([blank])[0].pixels) == 0


def test_keypoints_are_unprojected_onto_the_surface():
    frame = render(look_at((1, 0.2, 0.4)), Sim3.identity())
    pixels = np.argwhere(frame.mask > 0)[::50, ::-1] + 0.5
    points = unproject_pixels(frame, pixels)
    back, depth = frame.camera.project(frame.camera.to_world(points))
    assert back == pytest.approx(pixels, abs=1e-6)
    rows, columns = np.floor(pixels).astype(int).T[::-1]
    assert depth == pytest.approx(frame.depth[rows, columns], rel=1e-6)


def test_the_essential_matrix_gives_the_rotation_between_cameras_with_other_intrinsics():
    rng = np.random.default_rng(0)
    grid = (224, 224)  # one patch per pixel, for nearly exact matches
    first = replace(look_at((1, 0, 0.3), size=(224, 224)), focal_length=np.array([300.0, 260.0]))
    second = replace(look_at((0.9, 0.45, 0.3), size=(224, 224)), focal_length=np.array([350.0, 330.0]))
    points = rng.normal(size=(60, 3)) * 0.5
    pixels = [np.floor(camera.project(points)[0]).astype(int)[:, ::-1] for camera in (first, second)]
    pixels[1][:15] = rng.integers(40, 180, (15, 2))  # a quarter of the matches are wrong
    image = np.zeros((224, 224, 3), np.uint8)
    frames = [Frame(image, None, None, camera) for camera in (first, second)]
    matches = Matches(pixels[0], pixels[1], np.ones(60), np.zeros(60))
    rotation, inliers, note = essential_rotation(*frames, matches, grid)
    assert rotation_error(rotation, second.R @ first.R.T) < 5 and 30 <= inliers <= 50 and note == ""
    few = Matches(pixels[0][:4], pixels[1][:4], np.ones(4), np.zeros(4))
    rotation, inliers, note = essential_rotation(*frames, few, grid)
    assert (rotation == np.eye(3)).all() and inliers == 0 and "4 matches" in note


def test_every_patch_is_salient_and_has_a_descriptor_of_unit_length(picture):
    features = RootSift()([picture, np.full((100, 150, 3), 0.5)])
    assert [f.keys.shape for f in features] == [(28, 28, 128)] * 2
    assert bool((features[0].saliency == 1).all()) and features[0].global_feature.shape == (128,)
    torch.testing.assert_close(features[0].keys.square().sum(-1), torch.ones(28, 28))
    assert bool(features[1].keys.isfinite().all())


def test_the_descriptors_are_those_of_opencv(picture):
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    for size, centres in ((24.0, np.arange(3.5, 224, 32)), (7.0, np.array([0.5, 100.3, 223.0]))):
        keypoints = [cv2.KeyPoint(float(x), float(y), size, 0.0) for y in centres for x in centres]
        _, expected = cv2.SIFT_create().compute(grey, keypoints)
        found = dense_sift(grey, centres, size).reshape(expected.shape)
        assert np.abs(found - expected).max() <= 1 and (found != expected).mean() < 1e-3
