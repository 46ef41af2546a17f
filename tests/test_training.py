"""Training of the backbone: renders, objectives, export and resumption."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from model_files import write_quad
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from tools import ablations
from zsp_lite.backbones.backbone import IMAGENET_MEAN, IMAGENET_STD
from zsp_lite.backbones.load import load_backbone
from zsp_lite.backbones.pretrained import TINY as SHIPPED
from zsp_lite.cli import main as cli
from zsp_lite.errors import InputError
from zsp_lite.training import distillation, recipe
from zsp_lite.training.batches import MEAN, STD, sample_batch
from zsp_lite.training.export import export_checkpoint, starting_weights
from zsp_lite.training.loop import read_checkpoint
from zsp_lite.training.recipe import CONTINUATION, Stage, TrainingConfig
from zsp_lite.training.renders import SIZE, VIEWS
from zsp_lite.training.train import train
from zsp_lite.training.trainee import Trainee, fit_heads, initialise

pytestmark = pytest.mark.slow

TINY = TrainingConfig(
    objects=4, embed_dim=24, depth=2, num_heads=2, layer=0,
    stages=(Stage(2, 32, 2, 2, (0.5, 1.0), helpers=1.0), Stage(2, 32, 1, 8, (0.5, 1.0), view=1.0)),
)  # fmt: skip


@pytest.fixture(autouse=True)
def float32(monkeypatch):
    """The results must not depend on whether the processor is fast in bfloat16."""
    monkeypatch.setattr("zsp_lite.backbones.precision.bfloat16_is_fast", lambda device_type: False)


@pytest.fixture(scope="module")
def first_run(render_folder, renders, tmp_path_factory):
    """Folder of a finished run in float32."""
    run = tmp_path_factory.mktemp("runs") / "first"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("zsp_lite.backbones.precision.bfloat16_is_fast", lambda device_type: False)
        train(TINY, run, render_folder)
    return run


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


def test_a_killed_run_resumes_to_the_same_weights(render_folder, first_run, tmp_path):
    class Killed(Exception):
        pass

    def kill_at_three(line):
        if line.startswith("step 3"):
            raise Killed

    with pytest.raises(Killed):
        train(TINY, tmp_path, render_folder, log=kill_at_three, log_every=1, checkpoint_every=2)
    resumed = train(TINY, tmp_path, render_folder, log_every=1, checkpoint_every=2)
    expected, got = load_file(first_run / "zsp-tiny.safetensors"), load_file(resumed)
    assert expected.keys() == got.keys() and all(torch.equal(expected[name], got[name]) for name in expected)
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [1, 2, 3, 4]
    last = json.loads((first_run / "log.jsonl").read_text())
    assert rows[-1] | {"seconds": 0} == last | {"seconds": 0}
    assert "held_out_accuracy" in last and np.isfinite(last["loss"])


def test_a_run_can_start_from_the_average_of_another(render_folder, first_run, tmp_path):
    checkpoint = Path(shutil.copy(first_run / "checkpoint.pt", tmp_path))
    still = replace(TINY, learning_rate=0.0)
    train(still, tmp_path / "second", render_folder, start_from=checkpoint)
    before, after = (read_checkpoint(path)["task"] for path in (checkpoint, tmp_path / "second" / "checkpoint.pt"))
    torch.testing.assert_close(after["model.backbone.pos_embed"], before["average.backbone.pos_embed"])
    with pytest.raises(InputError, match="a network of another shape, expected 2 blocks, 32 wide"):
        train(replace(TINY, embed_dim=32), tmp_path / "third", render_folder, start_from=checkpoint)
    with pytest.raises(InputError, match="no such file"):
        train(TINY, tmp_path / "fourth", render_folder, start_from=tmp_path / "lost.pt")
    assert not (tmp_path / "fourth").exists()
    checkpoint.unlink()  # no longer needed
    train(still, tmp_path / "second", render_folder, start_from=checkpoint)


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


def test_a_run_can_start_from_exported_weights(render_folder, renders, first_run, tmp_path):
    weights = first_run / "zsp-tiny.safetensors"
    still = replace(TINY, learning_rate=0.0)
    second = load_file(train(still, tmp_path / "second", render_folder, start_from=weights))
    first = load_file(weights)
    for name in ("patch_embed.proj.weight", "pos_embed", "blocks.1.mlp.fc2.weight"):
        torch.testing.assert_close(second[name], first[name], atol=1e-3, rtol=2e-3)
    model = Trainee(still)
    model.load_state_dict(starting_weights(still, weights), strict=False)
    fit_heads(model, renders, still.seed)
    kept = read_checkpoint(tmp_path / "second" / "checkpoint.pt")["task"]
    torch.testing.assert_close(kept["average.geometry_of_tokens.weight"], model.geometry_of_tokens.weight.data)
    train(still, tmp_path / "second", render_folder, start_from=weights)
    with pytest.raises(InputError, match="second/checkpoint.pt: run that started from other weights, expected a new"):
        train(still, tmp_path / "second", render_folder, start_from=first_run / "checkpoint.pt")


def test_weights_that_no_run_can_start_from_are_refused_before_a_folder_is_made(tmp_path):
    heads, damaged = tmp_path / "heads.safetensors", tmp_path / "damaged.safetensors"
    with safe_open(SHIPPED, "pt") as file:
        save_file(load_file(SHIPPED), heads, metadata=file.metadata() | dict(num_heads="3", saliency_heads="0"))
    damaged.write_bytes(b"cut off")
    for source, problem in (
        (
            "zsp-tinny",
            "zsp-tinny: no such file, expected a checkpoint of `train`, exported .safetensors, or the name",
        ),
        (tmp_path, "is a folder, expected a checkpoint"),
        (heads, "heads.safetensors: a network of another shape, .*'num_heads': 3.* expected .*'num_heads': 6"),
        (damaged, "damaged.safetensors: damaged"),
    ):
        with pytest.raises(InputError, match=problem):
            train(CONTINUATION, tmp_path / "run", start_from=source)
    with pytest.raises(InputError, match="zsp-tiny: a network of another shape, .*'depth': 12.* expected .*'depth': 2"):
        train(TINY, tmp_path / "run", start_from="zsp-tiny")
    assert not (tmp_path / "run").exists()


def test_heads_of_exported_weights_are_fitted_before_they_are_trained(renders):
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
            # The shipped weights were trained on pictures of another renderer.
            assert (unexplained[:3] < 0.95).all() and unexplained[3] < 1.2
            assert ((found[..., 4] > 0) == on_object).float().mean() > 0.85


def test_the_ablations_do_what_their_rows_say(render_folder, first_run, tmp_path, monkeypatch, capsys):
    few = replace(TINY, objects=1, learning_rate=0.03, stages=(Stage(2, 32, 1, 8, (0.6, 1.0), view=1.0),))
    settings = ("proportions", "deformation", "log_binned")
    variants = {name: replace(few, **{setting: getattr(config, setting) for setting in settings})
                for name, config in ablations.VARIANTS.items() if config.stages == ablations.BASE.stages}  # fmt: skip
    assert len(variants) == 4  # the others differ in their stages, which are cut short here
    for name, value in dict(BASE=few, VARIANTS=variants, SIDE=48, UNSEEN=2).items():
        monkeypatch.setattr(ablations, name, value)
    monkeypatch.setattr(ablations, "keep_freed_memory", lambda: None)  # this process lives on
    weights = first_run / "zsp-tiny.safetensors"
    shutil.copytree(render_folder, tmp_path / "out" / "renders")  # those of two variants
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


def test_a_folder_with_another_configuration_is_refused(render_folder, renders, tmp_path):
    (tmp_path / "config.json").write_text('{"seed": 5}')
    with pytest.raises(InputError, match="another configuration"):
        train(TINY, tmp_path, render_folder)


@pytest.mark.parametrize(
    "images", [np.zeros((2, 8, 8, 3)), np.zeros((2, 8, 8), np.uint8), np.zeros((0, 8, 8, 3), np.uint8)]
)
def test_other_arrays_than_photographs_are_refused_before_a_folder_is_made(images, tmp_path):
    np.savez(tmp_path / "backgrounds.npz", images=images)
    with pytest.raises(InputError, match=r"^backgrounds [^\n]* of shape [^\n]*expected uint8 of \(m, H, W, 3\)[^\n]*$"):
        train(TINY, tmp_path / "run", backgrounds=tmp_path / "backgrounds.npz")
    assert not (tmp_path / "run").exists()


def test_a_run_is_resumed_with_its_own_backgrounds_and_models_only(renders, tmp_path, monkeypatch):
    monkeypatch.setattr("zsp_lite.training.train.training_and_held_out", lambda *_: (renders, renders))
    model = write_quad(tmp_path / "models" / "sign" / "square.obj")
    for name, value in (("ours", 100), ("others", 101)):
        np.savez(tmp_path / name, images=np.full((2, 24, 36, 3), value, np.uint8))
    run, files = tmp_path / "run", {"models": tmp_path / "models", "backgrounds": tmp_path / "ours.npz"}
    train(TINY, run, **files)
    train(TINY, run, **files)
    for changed in ({"backgrounds": tmp_path / "others.npz"}, {"backgrounds": None}, {"models": None}):
        (name,) = changed
        with pytest.raises(InputError, match=f"run with another configuration, {name} is "):
            train(TINY, run, **files | changed)
    model.write_text(model.read_text().replace("v -1 -1 0", "v -1 -2 0"))  # as many bytes
    with pytest.raises(InputError, match="run with another configuration, models is "):
        train(TINY, run, **files)


def test_a_run_that_diverges_says_so(render_folder, renders, tmp_path):
    with pytest.raises(InputError, match="step 2: the gradient has norm nan, expected a lower learning rate"):
        train(replace(TINY, learning_rate=float("inf")), tmp_path, render_folder)


def test_a_damaged_run_and_no_objects_are_refused_in_one_line(render_folder, renders, tmp_path):
    with pytest.raises(InputError, match="expected at least 1"):
        train(replace(TINY, objects=0), tmp_path, render_folder)
    for amount in (-0.1, float("nan")):
        with pytest.raises(InputError, match="proportions: expected a finite number of at least 0"):
            replace(TINY, proportions=amount)
    (tmp_path / "checkpoint.pt").write_bytes(b"cut off")
    with pytest.raises(InputError, match="checkpoint.pt: damaged"):
        train(TINY, tmp_path, render_folder)
    (tmp_path / "config.json").write_text('{"seed": ')
    with pytest.raises(InputError, match="config.json are not valid JSON"):
        train(TINY, tmp_path, render_folder)


def test_the_command_trains_continues_and_distils(render_folder, renders, tmp_path, capsys, caplog, monkeypatch):
    """The command with tiny recipes: one step in each stage."""
    monkeypatch.setattr("zsp_lite.training.loop.keep_freed_memory", lambda: None)  # this process lives on
    monkeypatch.setattr(recipe, "TrainingConfig", lambda: TINY)
    monkeypatch.setattr(recipe, "CONTINUATION", replace(TINY, stages=TINY.stages[1:]))
    short = distillation.DistillationConfig(steps=2000, images=2, local_crops=1, outputs=8, hidden=8, bottleneck=8)
    monkeypatch.setattr(distillation, "LONG_RUN", short)
    common = ["--objects", "4", "--shorten", "0.0005", "--renders", str(render_folder)]

    def run(name, *options):
        cli.main(["train", "--out", str(tmp_path / name), *common, *options])
        rows = [json.loads(line) for line in (tmp_path / name / "log.jsonl").read_text().splitlines()]
        weights = capsys.readouterr().out.rpartition("Written: ")[2].strip()
        assert load_backbone(weights, "cpu").name == Path(weights).stem
        return rows[-1], Path(weights).name

    first, name = run("first")
    assert name == "zsp-tiny.safetensors" and first["step"] == 2 and first["view"] > 0
    assert "step 2  seconds" in caplog.text  # lines of the log are messages of the module's logger
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
