"""Features of a backbone on another device; a class of tensors takes the place of the device."""

import pytest
import torch
from numpy.testing import assert_array_equal
from synthetic_views import CoordinateBackbone

from zsp_lite import FeatureMap, ZeroShotPose
from zsp_lite.choices import SOLVERS
from zsp_lite.course.widgets import cycles
from zsp_lite.matching import similarity


class Elsewhere(torch.Tensor):
    """A tensor of a device without float64, which NumPy cannot read; `cpu` returns a plain
    tensor."""

    @classmethod
    def __torch_function__(cls, function, types, args=(), kwargs=None):
        """Refuse what the device lacks, for every function that gets such a tensor."""
        name = function.__name__
        if name in ("numpy", "__array__"):
            raise TypeError("can't convert device tensor to numpy")
        result = super().__torch_function__(function, types, args, kwargs)
        if name == "cpu" or name == "to" and "cpu" in args:
            with torch._C.DisableTorchFunctionSubclass():
                return result.as_subclass(torch.Tensor)
        if isinstance(result, Elsewhere) and result.dtype == torch.float64:
            raise TypeError("the device has no float64")
        return result


class BackboneElsewhere(CoordinateBackbone):
    """A backbone whose features are on the device."""

    def features(self, image):
        maps = super().features(image)
        parts = maps.keys, maps.saliency, maps.global_feature
        return FeatureMap(*(part.as_subclass(Elsewhere) for part in parts))


@pytest.mark.parametrize("solver", SOLVERS["both"])
def test_a_backbone_on_another_device_gives_the_pose_of_the_cpu(frames, solver):
    settings = {"trials": 50, "solver": solver}
    reference, *targets = frames[:3]
    here = ZeroShotPose(CoordinateBackbone(), **settings).estimate(reference, targets)
    there = ZeroShotPose(BackboneElsewhere(), **settings).estimate(reference, targets)
    assert_array_equal(here.sim3.matrix, there.sim3.matrix)


def test_the_widget_of_cycles_takes_features_of_another_device(frames):
    first, second = ZeroShotPose(BackboneElsewhere()).views(frames[:2])
    cycles.cycle(first, second, similarity(first.features, second.features))
