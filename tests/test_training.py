"""Training of the backbone: renders, objectives, export and resumption."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from zsp_lite.backbones.backbone import IMAGENET_MEAN, IMAGENET_STD
from zsp_lite.backbones.load import load_backbone
from zsp_lite.backbones.pretrained import TINY as SHIPPED
from zsp_lite.cli import main as cli
from zsp_lite.errors import InputError
from zsp_lite.matching import similarities
from zsp_lite.synthetic.assembly import make_shape, make_variant
from zsp_lite.synthetic.render import orbit_pose
from zsp_lite.synthetic.training_categories import TRAINING, random_assembly
from zsp_lite.training import ablations, distillation, recipe
from zsp_lite.training.batches import MEAN, STD, crop_grids, sample_batch
from zsp_lite.training.export import export_checkpoint, starting_weights
from zsp_lite.training.loop import read_checkpoint
from zsp_lite.training.objectives import attention_loss, correspondence_loss, geometry_loss, view_loss
from zsp_lite.training.recipe import CONTINUATION, Stage, TrainingConfig
from zsp_lite.training.renders import GRID, SIZE, VIEWS, RenderSet, load_render_set, render_object, render_set
from zsp_lite.training.train import train
from zsp_lite.training.trainee import Trainee, fit_heads, initialise

TINY = TrainingConfig(
    objects=4, embed_dim=24, depth=2, num_heads=2, layer=0,
    stages=(Stage(2, 32, 2, 2, (0.5, 1.0), helpers=1.0), Stage(2, 32, 1, 8, (0.5, 1.0), view=1.0)),
)  # fmt: skip


@pytest.fixture(autouse=True)
def float32(monkeypatch):
    """The results must not depend on whether the processor is fast in bfloat16."""
    monkeypatch.setattr("zsp_lite.backbones.precision.bfloat16_is_fast", lambda device_type: False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("renders")


@pytest.fixture(scope="module")
def renders(folder) -> RenderSet:
    return load_render_set(render_set(folder, 4, shard=1))


@pytest.fixture(scope="module")
def first_run(folder, renders, tmp_path_factory):
    """Folder of a finished run in float32."""
    run = tmp_path_factory.mktemp("runs") / "first"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("zsp_lite.backbones.precision.bfloat16_is_fast", lambda device_type: False)
        train(TINY, run, folder)
    return run


def fourier(surface, seed=0):
    """Descriptors that know the surface point exactly; background patches get noise."""
    generator = torch.Generator().manual_seed(seed)
    waves = torch.randn(3, 32, generator=generator) * 3
    phase = surface.nan_to_num(0) @ waves
    known = F.normalize(torch.cat([phase.sin(), phase.cos()], -1), dim=-1)
    noise = F.normalize(torch.randn(known.shape, generator=generator), dim=-1)
    return torch.where(surface[..., :1].isnan(), noise, known)


def test_an_object_is_rendered_the_same_in_every_process_and_differs_from_the_next(renders):
    for array, rows in zip(render_object(1), (renders.rgb, renders.surface, renders.geometry), strict=True):
        np.testing.assert_array_equal(array, rows[1])
    assert not np.array_equal(renders.rgb[1], renders.rgb[2])


def test_the_two_views_of_a_pair_are_nearer_in_azimuth_than_any_others(monkeypatch):
    azimuths = []
    monkeypatch.setattr("zsp_lite.training.renders.orbit_pose", lambda *a: azimuths.append(a[0]) or orbit_pose(*a))
    render_object(3)
    turns = np.subtract.outer(azimuths, azimuths)
    apart = np.degrees(np.abs((turns + np.pi) % (2 * np.pi) - np.pi))
    partner = np.arange(8) ^ 1
    found = apart[np.arange(8), partner]
    assert ((5 <= found) & (found <= 45)).all()
    apart[np.arange(8), partner] = apart[np.arange(8), np.arange(8)] = 360
    assert (apart.min(1) >= 45).all()


def test_render_set_continues_where_it_stopped(folder, renders):
    paths = render_set(folder, 4, shard=1)
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
    """A patch's surface point must be one that the uncropped view shows."""
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


def test_normals_turn_and_flip_with_the_crop(renders):
    grid, turn = crop_grids(np.random.default_rng(3), 3 * VIEWS, VIEWS, 96, (0.5, 1.0))
    batch = sample_batch(renders, np.random.default_rng(3), 3, VIEWS, 96, (0.5, 1.0), members=np.arange(3))
    assert set(torch.linalg.det(turn).round().tolist()) == {-1.0, 1.0}
    for crop in range(3 * VIEWS):
        right, down = grid[crop, 4, 5] - grid[crop, 4, 4], grid[crop, 5, 4] - grid[crop, 4, 4]
        axes = torch.stack([right / right.norm(), down / down.norm()])  # of the crop, in the uncropped view
        torch.testing.assert_close(turn[crop], axes, atol=0.15, rtol=0)  # a crop that is not square leans a little
        on_object = ~batch.surface[crop, :, 0].isnan()
        before = batch.geometry[crop, on_object, :3].clone()
        before[:, :2] = before[:, :2] @ turn[crop]
        view = renders.geometry[crop // VIEWS, crop % VIEWS].reshape(-1, 4)[:, :3].astype(np.float32)
        nearest = torch.cdist(before, torch.from_numpy(view)).amin(1)
        assert nearest.max() < 1e-3


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


def view_loss_of(keys, on_object, objects, temperature, queries=10**6):
    return view_loss(keys, on_object, objects, temperature, queries, torch.Generator().manual_seed(0))


def test_the_view_loss_asks_for_the_partner_and_takes_the_opposite_side_for_wrong():
    """Two objects x 8 views; a pair shares its patches' keys, the others have their own."""
    sides = torch.randn(2, 4, 3, 3, 32, generator=torch.Generator().manual_seed(0))
    on_object = torch.ones(16, 9, dtype=torch.bool)
    right, hits = view_loss_of(sides.repeat_interleave(2, 1).flatten(0, 1), on_object, 2, 0.03)
    assert right < 1e-3 and hits == 1
    # View 2k looks like view 2k + 5 of the opposite side: the partner never wins.
    wrong, hits = view_loss_of(sides[:, [0, 2, 1, 3, 2, 0, 3, 1]].flatten(0, 1), on_object, 2, 0.03)
    assert wrong > 5 and hits == 0


def test_the_view_loss_scores_by_the_methods_similarity_on_the_object():
    generator = torch.Generator().manual_seed(1)
    keys = torch.randn(8, 7, 6, 16, generator=generator)
    on_object = torch.rand(8, 42, generator=generator) < 0.4
    on_object[5] = False  # this side shows no patch of the object
    score = torch.full((8, 8), -1.0)
    for a in range(8):
        for b, product in enumerate(similarities(keys[a], list(keys))):
            if b != 5 and a != 5:
                score[a, b] = product[on_object[a]][:, on_object[b]].amax(1).mean()
    logits = ((score + score.T) / 2 / 0.1).fill_diagonal_(-1e4)
    logits[:, 5] = -1e4
    partner = torch.arange(8) ^ 1
    rest = (torch.arange(8) != 5) & (partner != 5)  # view 4 is not asked for a partner that shows nothing
    loss, hits = view_loss_of(keys, on_object, 1, 0.1)
    torch.testing.assert_close(loss, F.cross_entropy(logits[rest], partner[rest]))
    assert hits == pytest.approx(float((logits.argmax(1) == partner)[rest].float().mean()))
    assert view_loss_of(keys, torch.zeros_like(on_object), 1, 0.1) == (0, 0)


def test_the_view_loss_averages_over_as_many_patches_as_it_is_told():
    keys = torch.randn(8, 6, 6, 16, generator=torch.Generator().manual_seed(2))
    on_object = torch.ones(8, 36, dtype=torch.bool)
    whole = view_loss_of(keys, on_object, 1, 0.1)[0]
    assert view_loss_of(keys, on_object, 1, 0.1, queries=36)[0] == pytest.approx(float(whole), rel=1e-6)
    assert view_loss_of(keys, on_object, 1, 0.1, queries=5)[0] != pytest.approx(float(whole), rel=1e-3)


def test_losses_of_crops_without_an_object_are_zero_not_nan():
    generator, nothing = torch.Generator().manual_seed(0), torch.zeros(8, 9, dtype=torch.bool)
    keys, nowhere = torch.randn(8, 3, 3, 4, requires_grad=True), torch.full((8, 9, 3), torch.nan)
    found = [
        view_loss_of(keys, nothing, 1, 0.1),
        correspondence_loss(keys.flatten(1, 2), nowhere, 1, 0.15, 0.1, 9, generator),
        attention_loss(keys.flatten(1, 2)[:, None, :, 0], torch.zeros(8, 8)),
    ]
    for loss, share in found:
        assert loss == 0 and share == 0
        loss.backward()
    assert keys.grad.isfinite().all()


def test_siblings_keep_the_build_and_change_the_proportions():
    """Vertex i of a sibling is the same place of the same part, so that correspondence is known."""
    builds = [(generator, 5) for generator in TRAINING.values()] + [(random_assembly, seed) for seed in range(30)]
    for generator, seed in builds:
        first = make_shape(generator, seed)
        other = make_variant(generator, seed, np.random.default_rng(1))
        np.testing.assert_array_equal(first.faces, other.faces)
        np.testing.assert_array_equal(first.part, other.part)
        assert np.abs(first.vertices - other.vertices).max() > 0.02
    same = make_variant(generator, seed, np.random.default_rng(1), amount=0.0)
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
    seen = torch.from_numpy(renders.rgb[:, ::3].reshape(-1, SIZE, SIZE, 3)).permute(0, 3, 1, 2) / 255
    seen = F.interpolate(seen, (224, 224), mode="bilinear")
    with torch.no_grad():
        before, after = (m.extract(x, 0).keys.mean((0, 1)).norm() for m, x in
                         ((model.backbone, (seen - MEAN) / STD), (exported, (seen - mean) / std)))  # fmt: skip
    assert after < 0.02 < 0.2 < before
    torch.testing.assert_close(ours.cls, theirs.cls, atol=0.05, rtol=0.02)
    torch.testing.assert_close(ours.attention, theirs.attention, atol=1e-3, rtol=0.05)


def test_a_killed_run_resumes_to_the_same_weights(folder, renders, tmp_path):
    class Killed(Exception):
        pass

    def kill_at_three(line):
        if line.startswith("step 3"):
            raise Killed

    options = dict(checkpoint_every=2, log_every=1)
    whole = train(TINY, tmp_path / "whole", folder, **options)
    with pytest.raises(Killed):
        train(TINY, tmp_path / "killed", folder, log=kill_at_three, **options)
    resumed = train(TINY, tmp_path / "killed", folder, **options)
    expected, got = load_file(whole), load_file(resumed)
    assert all(torch.equal(expected[name], got[name]) for name in expected | got)
    logs = []
    for run in ("whole", "killed"):
        rows = [json.loads(line) for line in (tmp_path / run / "log.jsonl").read_text().splitlines()]
        assert [row["step"] for row in rows] == [1, 2, 3, 4]
        logs.append([{name: value for name, value in row.items() if name != "seconds"} for row in rows])
    assert logs[0] == logs[1]
    assert "held_out_accuracy" in rows[-1] and np.isfinite(rows[-1]["loss"])


def test_a_run_can_start_from_the_average_of_another(folder, first_run, tmp_path):
    checkpoint = Path(shutil.copy(first_run / "checkpoint.pt", tmp_path))
    still = replace(TINY, learning_rate=0.0)
    train(still, tmp_path / "second", folder, start_from=checkpoint)
    before, after = (read_checkpoint(path)["task"] for path in (checkpoint, tmp_path / "second" / "checkpoint.pt"))
    torch.testing.assert_close(after["model.backbone.pos_embed"], before["average.backbone.pos_embed"])
    with pytest.raises(InputError, match="a network of another shape, expected 2 blocks, 32 wide"):
        train(replace(TINY, embed_dim=32), tmp_path / "third", folder, start_from=checkpoint)
    with pytest.raises(InputError, match="no such file"):
        train(TINY, tmp_path / "fourth", folder, start_from=tmp_path / "lost.pt")
    assert not (tmp_path / "fourth").exists()
    checkpoint.unlink()  # no longer needed
    train(still, tmp_path / "second", folder, start_from=checkpoint)


def test_exported_weights_give_the_same_keys_to_a_further_run(first_run):
    weights = first_run / "zsp-tiny.safetensors"
    again = Trainee(TINY)
    assert set(again.load_state_dict(starting_weights(TINY, weights), strict=False).missing_keys) == {
        f"geometry_of_{what}.{part}" for what in ("tokens", "keys") for part in ("weight", "bias")
    }
    image, exported = torch.rand(1, 3, 32, 32), load_backbone(weights, "cpu").model
    mean, std = (torch.tensor(values).view(1, 3, 1, 1) for values in (IMAGENET_MEAN, IMAGENET_STD))
    with torch.no_grad():
        expected = exported.forward_training((image - mean) / std, 0)
        got = again((image - MEAN) / STD)
    torch.testing.assert_close(got.keys, expected.keys, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(got.tokens, expected.tokens, atol=1e-4, rtol=1e-4)


def test_a_run_can_start_from_exported_weights(folder, renders, first_run, tmp_path):
    weights = first_run / "zsp-tiny.safetensors"
    still = replace(TINY, learning_rate=0.0)
    second = load_file(train(still, tmp_path / "second", folder, start_from=weights))
    first = load_file(weights)
    for name in ("patch_embed.proj.weight", "pos_embed", "blocks.1.mlp.fc2.weight"):
        torch.testing.assert_close(second[name], first[name], atol=1e-3, rtol=2e-3)
    model = Trainee(still)
    model.load_state_dict(starting_weights(still, weights), strict=False)
    fit_heads(model, renders, still.seed)
    kept = read_checkpoint(tmp_path / "second" / "checkpoint.pt")["task"]
    torch.testing.assert_close(kept["average.geometry_of_tokens.weight"], model.geometry_of_tokens.weight.data)
    train(still, tmp_path / "second", folder, start_from=weights)
    with pytest.raises(InputError, match="second/checkpoint.pt: run that started from other weights, expected a new"):
        train(still, tmp_path / "second", folder, start_from=first_run / "checkpoint.pt")


def test_weights_that_no_run_can_start_from_are_refused_before_a_folder_is_made(tmp_path):
    heads, damaged = tmp_path / "heads.safetensors", tmp_path / "damaged.safetensors"
    with safe_open(SHIPPED, "pt") as file:
        save_file(load_file(SHIPPED), heads, metadata=file.metadata() | dict(num_heads="3", saliency_heads="0"))
    damaged.write_bytes(b"cut off")
    for source, problem in (
        ("zsp-tinny", "zsp-tinny: no such file, expected a checkpoint of `train`, exported .safetensors, or zsp-tiny"),
        (tmp_path, "is a folder, expected a checkpoint"),
        (heads, "heads.safetensors: a network of another shape, .*'num_heads': 3.* expected .*'num_heads': 6"),
        (damaged, "damaged.safetensors: damaged"),
    ):
        with pytest.raises(InputError, match=problem):
            train(CONTINUATION, tmp_path / "run", start_from=source)
    with pytest.raises(InputError, match="zsp-tiny: a network of another shape, .*'depth': 12.* expected .*'depth': 2"):
        train(TINY, tmp_path / "run", start_from="zsp-tiny")
    assert not (tmp_path / "run").exists()


def test_read_outs_of_exported_weights_are_fitted_before_they_are_trained(renders):
    """They read normals and foreground on other crops than the fit's; depth takes more than these four objects."""
    model = Trainee(CONTINUATION)
    assert model.load_state_dict(starting_weights(CONTINUATION, "zsp-tiny"), strict=False).missing_keys
    batch = sample_batch(renders, np.random.default_rng(99), 2, VIEWS, 96, (0.6, 1.0))
    on_object = ~batch.surface[..., 0].isnan()
    fit_heads(model, renders, 0, side=96)
    with torch.no_grad():
        out = model(batch.images)
        for read_out, features in (
            (model.geometry_of_tokens, out.tokens[:, 1:]), (model.geometry_of_keys, out.key_input)
        ):  # fmt: skip
            found, truth = read_out(features), batch.geometry[on_object]
            unexplained = (found[on_object][:, :4] - truth).square().mean(0) / truth.square().mean(0)
            assert (unexplained[:3] < 0.7).all() and unexplained[3] < 1.2
            assert ((found[..., 4] > 0) == on_object).float().mean() > 0.9


def test_the_ablations_do_what_their_rows_say(folder, first_run, tmp_path, monkeypatch, capsys):
    few = replace(TINY, objects=1, learning_rate=0.03, stages=(Stage(2, 32, 1, 8, (0.6, 1.0), view=1.0),))
    settings = ("proportions", "deformation", "log_binned")
    variants = {name: replace(few, **{setting: getattr(config, setting) for setting in settings})
                for name, config in ablations.VARIANTS.items() if config.stages == ablations.BASE.stages}  # fmt: skip
    assert len(variants) == 4  # the others differ in their stages, which are cut short here
    for name, value in dict(BASE=few, VARIANTS=variants, SIDE=48, UNSEEN=2).items():
        monkeypatch.setattr(ablations, name, value)
    monkeypatch.setattr(ablations, "keep_freed_memory", lambda: None)  # this process lives on
    weights = first_run / "zsp-tiny.safetensors"
    shutil.copytree(folder, tmp_path / "out" / "renders")  # those of two variants
    other = str(first_run / "checkpoint.pt")
    monkeypatch.setattr("sys.argv", ["ablations", str(weights), str(tmp_path / "out"), "--also", other])
    ablations.main()
    table = capsys.readouterr().out.partition("| |")[2].splitlines()[2:]
    rows = {row.split("|")[1].strip(): [float(cell) for cell in row.split("|")[2:5]] for row in table}
    full = [ablations.ALL, "no averaging of weights", "mean key at each grid position removed"]
    assert list(rows) == [f"{weights}, without further training", other, *full, *list(variants)[1:]]
    assert all(0 <= matches <= 100 and 0 <= view <= 100 and 0 <= iou <= 1 for matches, view, iou in rows.values())
    assert len({tuple(rows[name]) for name in full}) == 3
    logs = {name: json.loads((tmp_path / "out" / name.replace(" ", "-").replace(",", "") / "log.jsonl").read_text())
            for name in variants}  # fmt: skip
    assert len({log["loss"] for log in logs.values()}) == 4  # three ways to render, and bare keys
    for arguments, problem in (
        (["lost.pt", str(tmp_path / "other")], "error: lost.pt: no such file"),
        ([other, str(tmp_path / "out")], "full-training/checkpoint.pt: run that started from other weights"),
    ):
        monkeypatch.setattr("sys.argv", ["ablations", *arguments])
        with pytest.raises(SystemExit) as exit:
            ablations.main()
        assert exit.value.code == 2 and problem in capsys.readouterr().err
    assert not (tmp_path / "other").exists()


def test_a_folder_with_another_configuration_is_refused(folder, renders, tmp_path):
    (tmp_path / "config.json").write_text('{"seed": 5}')
    with pytest.raises(InputError, match="another configuration"):
        train(TINY, tmp_path, folder)


def test_a_run_that_diverges_says_so(folder, renders, tmp_path):
    with pytest.raises(InputError, match="step 2: the gradient has norm nan, expected a lower learning rate"):
        train(replace(TINY, learning_rate=float("inf")), tmp_path, folder)


def test_shards_that_are_damaged_or_of_another_renderer_are_refused(tmp_path):
    path = tmp_path / "shard.npz"
    path.write_bytes(b"cut off")
    with pytest.raises(InputError, match="shard.npz cannot be read"):
        load_render_set([path])
    np.savez(path, rgb=np.zeros((1, 6, 9, 9, 3)), surface=np.zeros((1, 6, 3, 3, 3)), geometry=np.zeros((1, 6, 3, 3, 4)))
    with pytest.raises(InputError, match="rgb has shape .1, 6, 9, 9, 3., expected .1, 8, 192, 192, 3.; remove it"):
        load_render_set([path])


def test_a_damaged_run_and_no_objects_are_refused_in_one_line(folder, renders, tmp_path):
    with pytest.raises(InputError, match="expected at least 1"):
        train(replace(TINY, objects=0), tmp_path, folder)
    for amount in (-0.1, float("nan")):
        with pytest.raises(InputError, match="proportions: expected a finite number of at least 0"):
            replace(TINY, proportions=amount)
    (tmp_path / "checkpoint.pt").write_bytes(b"cut off")
    with pytest.raises(InputError, match="checkpoint.pt: damaged"):
        train(TINY, tmp_path, folder)
    (tmp_path / "config.json").write_text('{"seed": ')
    with pytest.raises(InputError, match="config.json are not valid JSON"):
        train(TINY, tmp_path, folder)


def test_the_command_trains_continues_and_distils(folder, renders, tmp_path, capsys, monkeypatch):
    """The command with tiny recipes: one step in each stage."""
    monkeypatch.setattr("zsp_lite.training.loop.keep_freed_memory", lambda: None)  # this process lives on
    monkeypatch.setattr(recipe, "TrainingConfig", lambda: TINY)
    monkeypatch.setattr(recipe, "CONTINUATION", replace(TINY, stages=TINY.stages[1:]))
    short = distillation.DistillationConfig(steps=2000, images=2, local_crops=1, outputs=8, hidden=8, bottleneck=8)
    monkeypatch.setattr(distillation, "LONG_RUN", short)
    common = ["--objects", "4", "--shorten", "0.0005", "--renders", str(folder)]

    def run(name, *options):
        cli.main(["train", "--out", str(tmp_path / name), *common, *options])
        rows = [json.loads(line) for line in (tmp_path / name / "log.jsonl").read_text().splitlines()]
        weights = capsys.readouterr().out.rpartition("Written: ")[2].strip()
        assert load_backbone(weights, "cpu").name == Path(weights).stem
        return rows[-1], Path(weights).name

    first, name = run("first")
    assert name == "zsp-tiny.safetensors" and first["step"] == 2 and first["view"] > 0
    second, _ = run("second", "--start-from", str(tmp_path / "first" / "checkpoint.pt"))
    assert second["step"] == 1
    third, name = run("third", "--self-distillation")
    assert name == "dino-tiny.safetensors" and third["step"] == 1 and third["teacher_entropy"] > 0


def test_stages_follow_one_another_and_the_learning_rate_falls():
    config = TrainingConfig()
    assert config.steps == sum(stage.steps for stage in config.stages) == 6950
    assert config.stage_at(0) == (config.stages[0], 0) and config.stage_at(1199)[0] is config.stages[0]
    assert config.stage_at(1200) == (config.stages[1], 0) and config.stage_at(1550) == (config.stages[1], 0.5)
    assert config.stage_at(6949)[0] is config.stages[-1]
    rates = [config.learning_rate_at(step) for step in (0, 74, 150, 2000, 6949)]
    assert rates[:4] == pytest.approx([1e-3 / 150, 0.5e-3, 1e-3, 1e-3]) and rates[4] == pytest.approx(0.7e-5, rel=1e-3)
    with pytest.raises(InputError, match="step: expected 0 to 6949, got 6950"):
        config.stage_at(6950)
