"""Poses of both solvers on sample pairs against stored ones: `sample_poses.json`, the first pairs of five target views.

Last digits of features depend on the processor, and a tie may fall the other way: one pair of a solver may differ.
"""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import zsp_lite
from zsp_lite.data.pairs import shipped_pairs
from zsp_lite.samples import REPOSITORY

STORED = json.loads(Path(__file__).with_name("sample_poses.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def estimates():
    """For each stored pair and solver, the stored values and the estimate."""
    dataset, method = zsp_lite.Co3D(REPOSITORY / "data_samples"), zsp_lite.ZeroShotPose(zsp_lite.load_backbone())
    found = {"paper": [], "verified": []}
    for category, stored in STORED.items():
        for pair, values in zip(shipped_pairs(dataset, category, 5), stored):
            reference, targets = dataset.load_pair(pair)
            views = method.views([reference, *targets])
            for solver, expected in values.items():
                estimate = replace(method, solver=solver).estimate_from_views(views[0], views[1:])
                found[solver].append((expected, estimate))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["paper", "verified"])
def test_views_and_poses_are_the_stored_ones(estimates, solver):
    same = [
        estimate.view == expected["view"] and np.allclose(estimate.sim3.matrix[:3], expected["matrix"], atol=1e-4)
        for expected, estimate in estimates[solver]
    ]
    assert len(same) == 12 and sum(same) >= 11


@pytest.mark.slow
def test_matches_of_the_papers_solver_are_the_stored_ones(estimates):
    same = []
    for expected, estimate in estimates["paper"]:
        patches = np.concatenate([estimate.matches.reference, estimate.matches.target], axis=1).astype(np.int64)
        same.append(hashlib.sha256(patches.tobytes()).hexdigest()[:16] == expected["matches"])
    assert sum(same) >= 11
