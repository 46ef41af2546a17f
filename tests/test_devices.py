"""Features of a backbone on another device, and matchers that get its tensors, without such a
device."""

import numpy as np
import pytest
import torch
from synthetic_views import CoordinateBackbone

from zsp_lite import FeatureMap, ZeroShotPose
from zsp_lite.choices import SOLVERS
from zsp_lite.course.widgets import cycles
from zsp_lite.matchers import MATCHERS
from zsp_lite.matching import similarity


class Elsewhere(torch.Tensor):
    """A tensor of a device without float64, which NumPy cannot read; `cpu` returns a plain
    tensor."""

    @classmethod
    def __torch_function__(cls, function, types, args=(), kwargs=None):
        name = function.__name__
        if name in ("numpy", "__array__"):
            raise TypeError("can't convert device tensor to numpy")
        found = super().__torch_function__(function, types, args, kwargs)
        if name == "cpu" or name == "to" and "cpu" in args:
            with torch._C.DisableTorchFunctionSubclass():
                return found.as_subclass(torch.Tensor)
        if isinstance(found, Elsewhere) and found.dtype == torch.float64:
            raise TypeError("the device has no float64")
        return found


class BackboneElsewhere(CoordinateBackbone):
    def __call__(self, images):
        parts = [(one.keys, one.saliency, one.global_feature) for one in super().__call__(images)]
        return [FeatureMap(*(values.as_subclass(Elsewhere) for values in some)) for some in parts]


@pytest.mark.parametrize("solver", SOLVERS["both"])
def test_a_backbone_on_another_device_gives_the_pose_of_the_cpu(ellipsoids, solver):
    frames = [
        ellipsoids.load(ellipsoids.frame("ellipsoid", *end))
        for end in (("a", 0), ("b", 0), ("b", 1))
    ]
    first, second = (
        ZeroShotPose(backbone, trials=50, solver=solver).estimate(frames[0], frames[1:])
        for backbone in (CoordinateBackbone(), BackboneElsewhere())
    )
    np.testing.assert_array_equal(first.sim3.matrix, second.sim3.matrix)
    pair = second.reference_view, second.target_views[0]
    cycles.cycle(*pair, similarity(*(view.features for view in pair)))


@pytest.mark.parametrize("name", MATCHERS)
def test_a_matcher_does_not_ask_another_device_for_float64(name):
    arguments = torch.rand(12, 15), torch.arange(12) % 4 > 0, torch.arange(15) % 3 > 0
    expected, found = (
        MATCHERS[name](*some) for some in (arguments, [x.as_subclass(Elsewhere) for x in arguments])
    )
    assert torch.equal(found[0], expected[0])
    assert torch.equal(found[1], expected[1])
