"""Training data and losses: renders of one object at a time, batches with their geometry, four losses."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from model_files import write_wedge

from zsp_lite.errors import InputError
from zsp_lite.matching import similarities
from zsp_lite.synthetic.assembly import make_shape, make_variant
from zsp_lite.synthetic.materials import random_materials, with_materials
from zsp_lite.synthetic.render import framed_camera, orbit_pose
from zsp_lite.synthetic.training_categories import TRAINING, random_assembly
from zsp_lite.training.batches import crop_grids, on_photographs, sample_batch
from zsp_lite.training.instances import ModelInstances
from zsp_lite.training.objectives import attention_loss, correspondence_loss, geometry_loss, view_loss
from zsp_lite.training.renders import ARRAYS, GRID, SIZE, VIEWS, load_render_set, render_object, render_set
from zsp_lite.training.views import render_view

pytestmark = pytest.mark.slow


def fourier(surface, seed=0):
    """Descriptors that know the surface point exactly; background patches get noise."""
    generator = torch.Generator().manual_seed(seed)
    waves = torch.randn(3, 32, generator=generator) * 3
    phase = surface.nan_to_num(0) @ waves
    known = F.normalize(torch.cat([phase.sin(), phase.cos()], -1), dim=-1)
    noise = F.normalize(torch.randn(known.shape, generator=generator), dim=-1)
    return torch.where(surface[..., :1].isnan(), noise, known)


def test_an_object_is_rendered_the_same_in_every_process_and_differs_from_the_next(renders):
    for array, rows in zip(render_object(1), (getattr(renders, name) for name in ARRAYS), strict=True):
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


def test_render_set_continues_where_it_stopped(render_folder, renders):
    paths = render_set(render_folder, 4, shard=1)
    kept = {path: path.stat().st_mtime_ns for path in paths[1:]}
    paths[0].unlink()
    again = load_render_set(render_set(render_folder, 4, shard=1))
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
    # The coverage is measured at four points around the centre; a narrow gap can lie between them.
    assert batch.surface[..., 0].isnan()[covered].float().mean() < 0.005


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
    logits = (score + score.T) / 2 / 0.1
    logits[:, 5] = -1e4
    logits[::2, ::2] = logits[1::2, 1::2] = -1e4  # views of the same instance
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


def test_views_of_a_deformed_copy_show_points_of_the_original_and_differ_in_room_and_materials():
    shape, factors, offset = make_shape(TRAINING["teapot"], 3), [1.3, 0.8, 1.1], [0.4, 0, 0.2]
    copy = shape.vertices * factors + offset
    camera = framed_camera(copy, *orbit_pose(0.5, 0.4, 0, 7, np.zeros(3)), 96)
    meshes = (with_materials(shape, random_materials(seed), copy) for seed in (0, 1))
    one, two = (
        render_view(0, mesh, shape.vertices, camera, np.random.default_rng(seed)) for seed, mesh in enumerate(meshes)
    )
    assert np.abs(one.rgb.astype(int) - two.rgb).mean() > 20
    for drawn in (one, two):
        row, col = np.nonzero(drawn.mask)
        seen = camera.unproject(np.stack([col + 0.5, row + 0.5], 1), drawn.depth[row, col])
        assert drawn.canonical[row, col] * factors + offset == pytest.approx(seen, abs=2e-3)


def test_variants_keep_the_parts_and_change_the_proportions():
    """Vertex i of a variant is the same point of the same part, so that correspondences are known."""
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


def test_shards_that_are_damaged_or_of_another_renderer_are_refused(tmp_path):
    path = tmp_path / "shard.npz"
    path.write_bytes(b"cut off")
    with pytest.raises(InputError, match="shard.npz cannot be read"):
        load_render_set([path])
    sizes = (9, 9, 3), (9, 9), (3, 3, 3), (3, 3, 4)
    np.savez(path, **{name: np.zeros((1, 6, *size)) for name, size in zip(ARRAYS, sizes, strict=True)})
    with pytest.raises(InputError, match="rgb has shape .1, 6, 9, 9, 3., expected .1, 8, 192, 192, 3.; remove it"):
        load_render_set([path])


@pytest.fixture(scope="module")
def model_folder(tmp_path_factory):
    """Two models of one category, of slightly different heights, and one of a mixed category."""
    folder = tmp_path_factory.mktemp("models")
    for name, seat in (("cabinet/one", 0.5), ("cabinet/two", 0.7), ("plant/one", 0.5)):
        write_wedge(folder / f"{name}.obj", seat)
    return folder


def test_even_and_odd_views_show_two_models_whose_coordinates_agree(model_folder):
    found = set()
    for seed in range(12):
        instances = ModelInstances(model_folder, np.random.default_rng(seed), 0.0)
        even, odd = instances.instance(0), instances.instance(1)
        assert instances.instance(2) is even and instances.instance(3) is odd
        np.testing.assert_allclose(np.ptp(even.coordinates, axis=0), np.ptp(odd.coordinates, axis=0), rtol=1e-5)
        found.add((np.ptp(even.mesh.vertices, axis=0) / np.ptp(odd.mesh.vertices, axis=0)).round(2).max())
    assert len(found) > 1  # in some draws the two are one model, in some they are two


def test_instances_of_a_model_differ_in_colour_and_shape(model_folder):
    instances = ModelInstances(model_folder, np.random.default_rng(1), 1.0)
    one, other = (instances.instance(view).mesh for view in (0, 1))
    assert np.abs(one.vertices - other.vertices).max() > 0.05
    assert not np.allclose(one.materials[0].colour, other.materials[0].colour)


def test_a_share_of_the_objects_are_models_and_their_shards_are_named_apart(model_folder, tmp_path):
    paths = render_set(tmp_path, 1, models=model_folder, share=1.0), render_set(tmp_path, 1, workers=1)
    models, procedural = map(load_render_set, paths)
    assert paths[0] != paths[1] and not np.array_equal(models.rgb, procedural.rgb)
    assert models.mask.any((2, 3)).all()
    np.testing.assert_array_equal(models.mask[:, :, 2::4, 2::4], ~np.isnan(models.surface[..., 0]))


def test_photographs_replace_what_is_behind_the_object_in_half_of_the_views():
    rng, n = np.random.default_rng(0), 64
    rgb, mask = torch.rand(n, 3, 32, 32), torch.zeros(n, 1, 32, 32)
    mask[:, :, 8:24, 8:24] = 1
    white = np.full((2, 24, 36, 3), 255, np.uint8)
    shown = on_photographs(rng, rgb.clone(), mask, white, 2)
    changed = (shown != rgb).flatten(1).any(1)
    assert 0.3 < changed.float().mean() < 0.7
    assert torch.equal(shown[:, :, 9:23, 9:23], rgb[:, :, 9:23, 9:23])
    assert (shown[changed][:, :, :7] == 1).float().mean() > 0.5  # the rest shows other objects
