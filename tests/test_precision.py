"""The choice between float32 and bfloat16."""

import logging
import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from zsp_lite.backbones import precision
from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.precision import bfloat16_is_fast, choose_precision, supported_precision
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.training.recipe import TrainingConfig
from zsp_lite.training.trainee import Trainee


@pytest.fixture()
def no_cached_result():
    bfloat16_is_fast.cache_clear()
    yield
    bfloat16_is_fast.cache_clear()


@pytest.mark.parametrize("bfloat16_time, expected", [(0.5, "bfloat16"), (1.0, "float32"), (9.0, "float32")])
def test_a_cpu_uses_bfloat16_only_if_it_is_faster(bfloat16_time, expected, monkeypatch, no_cached_result):
    monkeypatch.setattr(precision, "_linear_times", lambda: {"float32": 1.0, "bfloat16": bfloat16_time})
    assert choose_precision("cpu") == expected


def test_the_measurement_is_made_once(monkeypatch, no_cached_result):
    calls = []
    monkeypatch.setattr(precision, "_linear_times", lambda: calls.append(1) or {"float32": 1.0, "bfloat16": 2.0})
    assert [choose_precision("cpu") for _ in range(3)] == ["float32"] * 3
    assert len(calls) == 1


@pytest.mark.parametrize("native", [True, False])
def test_cuda_uses_bfloat16_where_it_is_native(native, monkeypatch, no_cached_result):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: native or including_emulation)
    assert choose_precision("cuda") == ("bfloat16" if native else "float32")
    assert choose_precision("mps") == "float32"


def test_a_request_for_bfloat16_falls_back_to_float32_with_a_warning_where_it_is_slow(monkeypatch, caplog):
    vit = VisionTransformer(32, 8, embed_dim=24, depth=2, num_heads=2)
    image = np.random.default_rng(0).integers(0, 256, (32, 32, 3), dtype=np.uint8)
    monkeypatch.setattr(precision, "bfloat16_is_fast", lambda device_type: False)
    with caplog.at_level(logging.WARNING):
        slow = Backbone(vit, "small", device="cpu", precision="bfloat16")
    assert slow.precision == "float32" and "bfloat16 is slow" in caplog.text
    assert torch.equal(slow([image])[0].keys, Backbone(vit, "small", device="cpu")([image])[0].keys)
    monkeypatch.setattr(precision, "bfloat16_is_fast", lambda device_type: True)
    assert Backbone(vit, "small", device="cpu", precision="bfloat16").precision == "bfloat16"
    assert supported_precision("float32", "cpu") == "float32"


@pytest.mark.parametrize("fast", [True, False])
def test_training_runs_at_the_precision_that_is_fast(fast, monkeypatch):
    monkeypatch.setattr(precision, "bfloat16_is_fast", lambda device_type: fast)
    model = Trainee(TrainingConfig(embed_dim=24, depth=2, num_heads=2, layer=0))
    assert model(torch.zeros(1, 3, 32, 32)).keys.dtype == (torch.bfloat16 if fast else torch.float32)


def test_without_avx512_no_bfloat16_is_chosen():
    """Checked in a process that is restricted to AVX2, whatever this processor has."""
    restricted = os.environ | {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2"}
    code = "from zsp_lite.backbones import precision as p; t = p._linear_times(); print(p.choose_precision('cpu'), t)"
    done = subprocess.run([sys.executable, "-c", code], env=restricted, capture_output=True, text=True, check=True)
    chosen, _, times = done.stdout.partition(" ")
    if chosen == "bfloat16" and not torch.backends.cpu.get_cpu_capability().startswith("AVX"):
        pytest.skip(f"the two variables restrict x86 processors only; measured here: {times}")
    assert chosen == "float32", times
