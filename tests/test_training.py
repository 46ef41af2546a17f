"""The trainer: renders of one object at a time, three objectives, exact export, resumption."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from safetensors.torch import load_file

from zsp_lite.backbones import IMAGENET_MEAN, IMAGENET_STD, load_backbone
from zsp_lite.errors import InputError
from zsp_lite.synthetic.assembly import make_shape, make_sibling
from zsp_lite.synthetic.training_categories import TRAINING
from zsp_lite.training.batches import MEAN, STD, sample_batch
from zsp_lite.training.objectives import attention_loss, correspondence_loss, geometry_loss, view_loss
from zsp_lite.training.renders import GRID, SIZE, VIEWS, RenderSet, load_render_set, render_object, render_set
from zsp_lite.training.train import Stage, Trainee, TrainingConfig, export_checkpoint, initialise, train

TINY = TrainingConfig(
    objects=4, embed_dim=24, depth=2, num_heads=2, key_block=0,
    stages=(Stage(2, 32, 2, 2, (0.5, 1.0), helpers=1.0), Stage(2, 32, 1, 8, (0.5, 1.0), view=1.0)),
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("renders")


@pytest.fixture(scope="module")
def renders(folder) -> RenderSet:
    return load_render_set(render_set(folder, 4, shard=1))


def fourier(surface, seed=0):
    """Descriptors that know the surface point exactly; background patches get noise."""
    generator = torch.Generator().manual_seed(seed)
    waves = torch.randn(3, 32, generator=generator) * 3
    phase = surface.nan_to_num(0) @ waves
    known = F.normalize(torch.cat([phase.sin(), phase.cos()], -1), dim=-1)
    noise = F.normalize(torch.randn(known.shape, generator=generator), dim=-1)
    return torch.where(surface[..., :1].isnan(), noise, known)


def test_an_object_is_rendered_the_same_twice_and_differs_from_the_next():
    first, again, other = render_object(3), render_object(3), render_object(4)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
    assert not np.array_equal(first[0], other[0])


def test_render_set_continues_where_it_stopped(folder, renders):
    paths = sorted(folder.glob("*.npz"))
    kept = {path: path.stat().st_mtime_ns for path in paths[1:]}
    paths[0].unlink()
    again = load_render_set(render_set(folder, 4, shard=1))
    np.testing.assert_array_equal(again.rgb, renders.rgb)
    assert kept == {path: path.stat().st_mtime_ns for path in paths[1:]}


def test_renders_hold_unit_normals_and_centred_depth_on_the_object(renders):
    inside = ~np.isnan(renders.surface[..., 0])
    assert renders.rgb.shape == (4, VIEWS, SIZE, SIZE, 3) and inside.shape == (4, VIEWS, GRID, GRID)
    assert 0.05 < inside.mean() < 0.9
    normals = np.linalg.norm(renders.geometry[..., :3].astype(np.float64), axis=-1)
    np.testing.assert_allclose(normals[inside], 1, atol=5e-3)
    np.testing.assert_array_equal(renders.geometry[~inside], 0)
    # Visible surfaces face the camera, which looks along +z, up to the slant of the rays.
    assert np.mean(renders.geometry[..., 2][inside] < 0.2) > 0.99
    depth = renders.geometry[..., 3].astype(np.float64)
    for values, on in zip(depth.reshape(-1, GRID, GRID), inside.reshape(-1, GRID, GRID), strict=True):
        assert abs(values[on].mean()) < 0.01 and abs(values[on].std() - 1) < 0.01


def test_a_batch_carries_surface_points_through_crops_and_flips(renders):
    """A patch's surface point must be one that the uncropped view shows, and flips turn whole objects."""
    batch = sample_batch(renders, np.random.default_rng(0), 3, VIEWS, 96, (0.4, 1.0), members=np.array([0, 1, 2]))
    crops = 3 * VIEWS
    assert batch.images.shape == (crops, 3, 96, 96) and batch.surface.shape == (crops, 144, 3)
    for crop in range(crops):
        points = batch.surface[crop][~batch.surface[crop, :, 0].isnan()].numpy()
        view = renders.surface[crop // VIEWS, crop % VIEWS].reshape(-1, 3).astype(np.float32)
        known = {tuple(point) for point in view[~np.isnan(view[:, 0])]}
        assert {tuple(point) for point in points} <= known
    covered = batch.coverage > 0.99
    assert not batch.surface[..., 0].isnan()[covered].any()


def test_perfect_descriptors_match_and_random_ones_do_not(renders):
    batch = sample_batch(renders, np.random.default_rng(1), 2, VIEWS, 96, (0.8, 1.0))

    def loss(descriptors):
        return correspondence_loss(descriptors, batch.surface, 2, 0.15, 0.1, 256, torch.Generator().manual_seed(0))

    perfect, accuracy = loss(fourier(batch.surface))
    noise, chance = loss(F.normalize(torch.randn(batch.surface.shape[:2] + (64,)), dim=-1))
    assert accuracy > 0.9 > 0.2 > chance
    assert 0 <= perfect < 0.5 * noise


def test_no_object_is_compared_with_another(renders):
    """The loss of two objects is the mean of the losses of each alone."""
    batch = sample_batch(renders, np.random.default_rng(2), 2, VIEWS, 96, (0.8, 1.0), members=np.array([0, 1]))
    z = fourier(batch.surface)
    full = dict(radius=0.15, temperature=0.1, queries=10**6)
    both = correspondence_loss(z, batch.surface, 2, generator=torch.Generator(), **full)[0]
    alone = [
        correspondence_loss(z[part], batch.surface[part], 1, generator=torch.Generator(), **full)[0]
        for part in (slice(0, VIEWS), slice(VIEWS, 2 * VIEWS))
    ]
    torch.testing.assert_close(both, torch.stack(alone).mean())


def test_the_view_loss_asks_for_the_partner_and_takes_the_opposite_side_for_wrong():
    """Two objects x 8 views; a pair shares its patches' descriptors, the others have their own."""
    sides = F.normalize(torch.randn(2, 4, 9, 32, generator=torch.Generator().manual_seed(0)), dim=-1)
    on_object = torch.ones(16, 9, dtype=torch.bool)
    right, hits = view_loss(sides.repeat_interleave(2, 1).flatten(0, 1), on_object, 2, 0.03)
    assert right < 1e-3 and hits == 1
    # View 2k looks like view 2k + 5 of the opposite side: the partner never wins.
    wrong, hits = view_loss(sides[:, [0, 2, 1, 3, 2, 0, 3, 1]].flatten(0, 1), on_object, 2, 0.03)
    assert wrong > 5 and hits == 0


def test_the_view_loss_sees_the_object_only():
    z = F.normalize(torch.randn(8, 9, 16, generator=torch.Generator().manual_seed(1)), dim=-1)
    on_object = torch.zeros(8, 9, dtype=torch.bool)
    on_object[:, :5] = True
    background = torch.where(on_object[..., None], z, z.flip(0))
    torch.testing.assert_close(view_loss(z, on_object, 1, 0.1)[0], view_loss(background, on_object, 1, 0.1)[0])
    highest = (z[0, :5] @ z[1, :5].T).amax(1).mean(), (z[1, :5] @ z[0, :5].T).amax(1).mean()
    alone = view_loss(z[:2], on_object[:2], 1, 0.1)  # one partner, nothing to confuse it with
    assert alone[0] == 0 and alone[1] == 1 and all(value <= 1 for value in highest)


def test_siblings_keep_the_build_and_change_the_proportions():
    """Vertex i of a sibling is the same place of the same part, so that correspondence is known."""
    for generator in TRAINING.values():
        first = make_shape(generator, 5)
        other = make_sibling(generator, 5, np.random.default_rng(1))
        np.testing.assert_array_equal(first.faces, other.faces)
        np.testing.assert_array_equal(first.part, other.part)
        assert np.abs(first.vertices - other.vertices).max() > 0.02
    same = make_sibling(generator, 5, np.random.default_rng(1), amount=0.0)
    np.testing.assert_allclose(same.vertices, first.vertices)


def test_attention_on_the_mask_is_worth_more_than_attention_off_it():
    coverage = torch.zeros(1, 16)
    coverage[:, 4:9] = 1
    logits = torch.full((1, 3, 17), -12.0)
    logits[:, :, 5:10] = 0.0  # column 0 is the CLS token itself
    on, iou = attention_loss(logits, coverage)
    off, missed = attention_loss(-logits, coverage)
    assert iou == 1 and missed == 0
    assert on < 0.6 < 5 < off


def test_geometry_loss_counts_geometry_only_on_the_object():
    geometry, inside = torch.randn(2, 9, 4), torch.rand(2, 9) > 0.5
    logit = torch.where(inside, 20.0, -20.0)[..., None]
    assert geometry_loss(torch.cat([geometry, logit], -1), geometry, inside) < 1e-6
    elsewhere = torch.where(inside[..., None], geometry, geometry + 5)
    assert geometry_loss(torch.cat([elsewhere, logit], -1), geometry, inside) < 1e-6
    assert geometry_loss(torch.cat([geometry + 5, logit], -1), geometry, inside) > 1


def test_the_exported_checkpoint_sees_the_same_with_imagenet_statistics(renders, tmp_path):
    """Folding key means and input scaling changes keys by a constant and nothing else."""
    model = Trainee(TINY)
    initialise(model, renders, 0)
    path = export_checkpoint(model, renders, TINY, tmp_path / "tiny.safetensors")
    exported = load_backbone(path).model
    image = torch.rand(2, 3, 224, 224)
    mean, std = (torch.tensor(x).view(1, 3, 1, 1) for x in (IMAGENET_MEAN, IMAGENET_STD))
    with torch.no_grad():
        ours = model.backbone.extract((image - MEAN) / STD, 0)
        theirs = exported.extract((image - mean) / std, 0)
    difference = ours.keys - theirs.keys
    assert (difference - difference.mean((0, 1))).abs().max() < 0.02  # float16 weights
    torch.testing.assert_close(ours.cls, theirs.cls, atol=0.05, rtol=0.02)
    torch.testing.assert_close(ours.attention, theirs.attention, atol=1e-3, rtol=0.05)


def test_a_killed_run_resumes_to_the_same_weights(folder, renders, tmp_path):
    class Killed(Exception):
        pass

    def kill_at_three(line):
        if line.startswith("step 3"):
            raise Killed

    options = dict(checkpoint_every=2, log_every=1)
    whole = train(TINY, tmp_path / "whole", folder, log=lambda line: None, **options)
    with pytest.raises(Killed):
        train(TINY, tmp_path / "killed", folder, log=kill_at_three, **options)
    resumed = train(TINY, tmp_path / "killed", folder, log=lambda line: None, **options)
    expected, got = load_file(whole), load_file(resumed)
    assert all(torch.equal(expected[name], got[name]) for name in expected | got)
    for run in ("whole", "killed"):
        rows = [json.loads(line) for line in (tmp_path / run / "log.jsonl").read_text().splitlines()]
        assert [row["step"] for row in rows] == [1, 2, 3, 4]
    assert "held_out_accuracy" in rows[-1] and np.isfinite(rows[-1]["loss"])


def test_a_run_can_start_from_the_average_of_another(folder, renders, tmp_path):
    quiet = dict(log=lambda line: None)
    train(TINY, tmp_path / "first", folder, **quiet)
    still = replace(TINY, learning_rate=0.0)
    train(still, tmp_path / "second", folder, start_from=tmp_path / "first" / "checkpoint.pt", **quiet)
    load = dict(weights_only=True)
    before = torch.load(tmp_path / "first" / "checkpoint.pt", **load)["average"]
    after = torch.load(tmp_path / "second" / "checkpoint.pt", **load)["model"]
    torch.testing.assert_close(after["backbone.pos_embed"], before["backbone.pos_embed"])
    with pytest.raises(InputError, match="of another configuration"):
        wider = replace(TINY, embed_dim=32)
        train(wider, tmp_path / "third", folder, start_from=tmp_path / "first" / "checkpoint.pt", **quiet)


def test_a_folder_with_another_configuration_is_refused(folder, renders, tmp_path):
    (tmp_path / "config.json").write_text('{"seed": 5}')
    with pytest.raises(InputError, match="another configuration"):
        train(TINY, tmp_path, folder, log=lambda line: None)


def test_a_damaged_run_and_a_single_object_are_refused_in_one_line(folder, renders, tmp_path):
    with pytest.raises(InputError, match="expected at least 2"):
        train(replace(TINY, objects=1), tmp_path, folder, log=lambda line: None)
    (tmp_path / "checkpoint.pt").write_bytes(b"cut off")
    with pytest.raises(InputError, match="checkpoint.pt: damaged"):
        train(TINY, tmp_path, folder, log=lambda line: None)
    (tmp_path / "config.json").write_text('{"seed": ')
    with pytest.raises(InputError, match="config.json are not valid JSON"):
        train(TINY, tmp_path, folder, log=lambda line: None)
