"""Baselines: networks load the published checkpoints, geometry is exact for exact input, RootSIFT is OpenCV's."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from synthetic_views import look_at, render, true_pose

from zsp_lite.alignment import Sim3
from zsp_lite.backbones.backbone import normalize
from zsp_lite.baselines import geometry
from zsp_lite.baselines.geometry import align, essential_rotation, icp
from zsp_lite.baselines.networks import PoseContrast, Swav, euler_to_rotation, square_crop
from zsp_lite.baselines.sift import Keypoints, Sift, dense_sift, mutual_matches
from zsp_lite.data.frames import Frame
from zsp_lite.errors import InputError
from zsp_lite.matching import Matches
from zsp_lite.metrics import rotation_error
from zsp_lite.views import object_crop

STAGES = ((64, 3), (128, 4), (256, 6), (512, 3))  # width and number of blocks of each layer of ResNet-50
BLOCKS = [(f"layer{layer}.{k}", layer, k) for layer, (_, blocks) in enumerate(STAGES, 1) for k in range(blocks)]


def torchvision_weights() -> dict[str, torch.Tensor]:
    """Random weights by the names of torchvision's ResNet-50, without the last linear layer."""
    shapes, inputs = {"conv1": (64, 3, 7, 7), "bn1": (64,)}, 64
    for name, layer, block in BLOCKS:
        width = STAGES[layer - 1][0]
        kernels = {"conv1": (width, inputs, 1, 1), "conv2": (width, width, 3, 3), "conv3": (4 * width, width, 1, 1)}
        kernels |= {"downsample.0": (4 * width, inputs, 1, 1)} if block == 0 else {}
        for part, shape in kernels.items():
            norm = part.replace("conv", "bn").replace("sample.0", "sample.1")
            shapes |= {f"{name}.{part}": shape, f"{name}.{norm}": shape[:1]}
        inputs = 4 * width
    rng, weights = torch.Generator().manual_seed(0), {}
    for name, shape in shapes.items():
        spread = (2 / np.prod(shape[1:])) ** 0.5 if len(shape) > 1 else 0.1
        weights[f"{name}.weight"] = spread * torch.randn(shape, generator=rng) + (len(shape) == 1)
        if len(shape) == 1:
            for part in ("bias", "running_mean", "running_var"):
                weights[f"{name}.{part}"] = torch.rand(shape, generator=rng)
            weights[f"{name}.num_batches_tracked"] = torch.tensor(1)
    return weights


def resnet_by_hand(weights: dict[str, torch.Tensor], x: torch.Tensor) -> list[torch.Tensor]:
    """The outputs of the four layers."""

    def convolved(x, conv, bn, stride=1):
        x = torch.conv2d(x, kernel := weights[f"{conv}.weight"], stride=stride, padding=kernel.shape[-1] // 2)
        return F.batch_norm(x, *(weights[f"{bn}.{part}"] for part in ("running_mean", "running_var", "weight", "bias")))

    x, outputs = F.max_pool2d(convolved(x, "conv1", "bn1", 2).relu(), 3, stride=2, padding=1), {}
    for name, layer, block in BLOCKS:
        stride = 2 if layer > 1 and block == 0 else 1
        y = convolved(x, f"{name}.conv1", f"{name}.bn1").relu()
        y = convolved(y, f"{name}.conv2", f"{name}.bn2", stride).relu()
        y = convolved(y, f"{name}.conv3", f"{name}.bn3")
        shortcut = convolved(x, f"{name}.downsample.0", f"{name}.downsample.1", stride) if block == 0 else x
        x = outputs[layer] = (y + shortcut).relu()
    return list(outputs.values())


@pytest.mark.slow
def test_the_swav_checkpoint_describes_patches_by_the_third_layer_on_the_papers_grid(tmp_path, monkeypatch):
    monkeypatch.setenv("ZSP_LITE_CACHE", str(tmp_path))
    weights = torchvision_weights()
    assert len(weights) == 318  # of torchvision's 320 entries, those without the last layer
    state = weights | {"projection_head.0.weight": torch.ones(8), "prototypes.weight": torch.ones(8)}
    state = {f"module.{key}": x for key, x in state.items()}
    path = tmp_path / "swav_800ep_pretrain.pth.tar"
    torch.save(state, path)
    image = np.random.default_rng(0).integers(0, 256, (448, 448, 3), dtype=np.uint8)
    (found,) = Swav()([image])
    *_, third, last = resnet_by_hand(weights, normalize(torch.from_numpy(image).permute(2, 0, 1)[None] / 255))
    assert found.keys.shape == (28, 28, 1024) and found.saliency.min() == 1
    torch.testing.assert_close(found.keys.permute(2, 0, 1), third[0], rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(found.global_feature, last.mean((2, 3))[0], rtol=1e-3, atol=1e-3)
    torch.save(state | {"module.conv1.weight": torch.zeros(64, 3, 5, 5)}, path)
    with pytest.raises(InputError, match="swav.* the weights do not fit: .*size mismatch"):
        Swav()


@pytest.mark.parametrize(
    ("load", "url", "variable"),
    [(Swav, "https://dl.fbaipublicfiles.com/.*swav", "ZSP_LITE_SWAV"),
     (PoseContrast, "https://github.com/.*PoseContrast", "ZSP_LITE_POSECONTRAST")],
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
    path, weights, layers = tmp_path / "posecontrast.pth", torchvision_weights(), []
    for inputs, outputs in ((2048, 800), (800, 400), (400, 200)):
        layers += [torch.nn.Linear(inputs, outputs), torch.nn.BatchNorm1d(outputs), torch.nn.ReLU()]
    compress, bins = torch.nn.Sequential(*layers).eval().requires_grad_(False), {"azi": 24, "ele": 12, "inp": 24}
    parts = {f"fc_{kind}_{name}": torch.nn.Linear(200, n) for name, n in bins.items() for kind in ("cls", "reg")}
    head = torch.nn.ModuleDict({"compress": compress} | parts).state_dict()
    features = weights | {"fc.weight": torch.ones(128, 2048), "fc.bias": torch.ones(128)}
    torch.save({"epoch": 14, "net_feat": features, "net_vp": head}, path)
    monkeypatch.setenv("ZSP_LITE_POSECONTRAST", str(path))
    frame = object_crop(render(look_at((1, 0.2, 0.4), size=(60, 80)), Sim3.identity()))
    ((rotation, feature),) = PoseContrast().describe([frame])
    batch = normalize(torch.from_numpy(square_crop(frame)).permute(2, 0, 1)[None] / 255)
    x = resnet_by_hand(weights, batch)[-1].mean((2, 3))
    torch.testing.assert_close(feature, x[0], rtol=1e-3, atol=1e-3)
    x, angles = compress(x)[0], []
    for name in bins:
        score, offset = (
            head[f"fc_{kind}_{name}.weight"] @ x + head[f"fc_{kind}_{name}.bias"] for kind in ("cls", "reg")
        )
        angles.append(15 * (int(score.argmax()) + float(offset[score.argmax()])))
    assert rotation_error(rotation, euler_to_rotation(np.clip(angles, 0, 360))) < 0.1
    assert {"compress.0.weight", "compress.1.running_mean", "compress.7.bias"} <= head.keys()
    for content in ([1], {"net_feat": features}, {"net_feat": {}, "net_vp": {}}):
        torch.save(content, path)
        with pytest.raises(InputError, match="posecontrast"):
            PoseContrast()


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
    monkeypatch.setattr(geometry, "icp", lambda *points: (clouds.extend(points), Sim3.identity())[1])
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
    assert len(source) <= geometry.POINTS and len(target) == geometry.POINTS
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


def test_the_descriptors_are_those_of_opencv(picture):
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    for size, centres in ((24.0, np.arange(3.5, 224, 32)), (7.0, np.array([0.5, 100.3, 223.0]))):
        keypoints = [cv2.KeyPoint(float(x), float(y), size, 0.0) for y in centres for x in centres]
        _, expected = cv2.SIFT_create().compute(grey, keypoints)
        found = dense_sift(grey, centres, size).reshape(expected.shape)
        assert np.abs(found - expected).max() <= 1 and (found != expected).mean() < 1e-3
