"""Wrong arguments of public functions raise InputError; what the library converts is accepted."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import pytest
import torch
from jaxtyping import Bool, Float, UInt8
from numpy.typing import ArrayLike

import zsp_lite
from zsp_lite.arguments import checked
from zsp_lite.errors import InputError

POINTS = np.zeros((4, 3))


@checked
def example(
    points: Float[np.ndarray, "n 3"],
    weights: Float[np.ndarray, " n"] | None = None,
    colours: UInt8[np.ndarray, "n 3"] | None = None,
    k: int = 1,
    scale: float = 1.0,
    exact: bool = False,
    mode: Literal["a", "b"] = "a",
    size: tuple[int, int] = (1, 1),
    names: Sequence[str] = (),
    errors: ArrayLike | None = None,
    mask: Bool[torch.Tensor, " n"] | Bool[np.ndarray, " n"] | None = None,
) -> int:
    return len(points)


@pytest.mark.parametrize(
    "given",
    [
        {}, {"weights": [1, 2, 3, 4]}, {"weights": None}, {"colours": np.zeros((4, 3), np.int64)}, {"k": np.int64(3)},
        {"scale": 2}, {"scale": np.float32(2)}, {"exact": np.True_}, {"mode": "b"}, {"size": [2, 3]},
        {"size": torch.Size((2, 3))}, {"names": ["x"]}, {"errors": [1.0]}, {"errors": torch.ones(2)},
        {"mask": torch.ones(4, dtype=torch.bool)}, {"mask": [True] * 4},
    ],
)  # fmt: skip
def test_what_the_library_converts_is_accepted(given):
    assert example(POINTS, **given) == 4
    assert example(POINTS.tolist(), **given) == 4


@pytest.mark.parametrize(
    "given, told",
    [
        ({"points": POINTS[:, :2]}, r"points is an array of float64 of shape \(4, 2\), expected real .*shape \(n, 3\)"),
        ({"points": POINTS * 1j}, "points is an array of complex128"),
        ({"points": POINTS.astype(str)}, "points is an array of <U"),
        ({"points": "points"}, "points is 'points', expected real numbers"),
        ({"points": None}, "points is None"),
        ({"points": [[1, 2, 3], [1, 2]]}, r"points is \[\[1, 2, 3\], \[1, 2\]\]"),
        ({"weights": np.ones(5)}, r"weights .*expected .*\(n\) or None, with the sizes of the other arguments"),
        ({"colours": np.zeros((4, 3))}, "colours is .*expected integers of shape"),
        ({"k": 1.5}, "k is 1.5, expected an integer"),
        ({"k": True}, "k is True, expected an integer"),
        ({"scale": "1"}, "scale is '1', expected a number"),
        ({"exact": 1}, "exact is 1, expected True or False"),
        ({"mode": "c"}, "mode is 'c', expected one of 'a', 'b'"),
        ({"size": (1,)}, "size is "),
        ({"size": (1.5, 2)}, "size is "),
        ({"size": "ab"}, "size is 'ab'"),
        ({"names": "x"}, "names is 'x'"),
        ({"names": [5]}, "names is "),
        ({"errors": "x"}, "errors is 'x', expected real numbers or None"),
        ({"errors": [1j]}, "errors is "),
        ({"mask": np.ones(3, bool)}, "mask .*with the sizes of the other arguments"),
    ],
)  # fmt: skip
def test_anything_else_is_refused_in_one_line_that_names_the_argument(given, told):
    with pytest.raises(InputError, match=f"^example: {told}") as caught:
        example(**{"points": POINTS} | given)
    assert "\n" not in str(caught.value)


def test_a_missing_argument_is_pythons_own_error():
    with pytest.raises(TypeError, match="points"):
        example()


def test_sizes_of_one_call_do_not_bind_the_next():
    assert example(np.zeros((2, 3)), np.ones(2)) == 2 and example(np.zeros((5, 3)), np.ones(5)) == 5


KEYS, NAN = torch.rand(4, 4, 8), float("nan")
ROTATION = np.eye(3)


@pytest.mark.parametrize(
    "call",
    [
        lambda: zsp_lite.matching.similarity(KEYS * NAN, KEYS),
        lambda: zsp_lite.features.log_bin(KEYS[None] * NAN),
        lambda: zsp_lite.matching.cyclical_distances(torch.full((16, 16), NAN), (4, 4), (4, 4)),
        lambda: zsp_lite.matching.cyclical_distances(torch.zeros(16, 16), (-4, -4), (4, 4)),
        lambda: zsp_lite.metrics.rotation_error(0 * ROTATION, ROTATION),
        lambda: zsp_lite.metrics.rotation_error(np.diag([1, 1, -1.0]), ROTATION),
        lambda: zsp_lite.metrics.rotation_error(1e200 * ROTATION, ROTATION),
        lambda: zsp_lite.metrics.rotation_error(ROTATION * 1j, ROTATION),
        lambda: zsp_lite.metrics.rotation_error(np.stack([ROTATION] * 2), np.stack([ROTATION] * 3)),
        lambda: zsp_lite.metrics.summarise([-5.0]),
        lambda: zsp_lite.metrics.median([1e6]),
        lambda: zsp_lite.Camera(ROTATION, np.zeros(3), np.ones(2), np.ones(2), (1.5, 5)),
        lambda: zsp_lite.Camera(ROTATION, np.zeros(3), np.ones(2), np.ones(2), (10**30, 5)),
        lambda: zsp_lite.load_backbone("x" * 10_000),
        lambda: zsp_lite.load_backbone("zsp-tiny", image_size=10**6),
        lambda: zsp_lite.load_backbone("zsp-tiny")(5),
        lambda: zsp_lite.ZeroShotPose(None).estimate("a", ["b"]),
    ],
)
def test_values_that_would_give_a_wrong_answer_are_refused(call):
    with pytest.raises(InputError):
        call()
