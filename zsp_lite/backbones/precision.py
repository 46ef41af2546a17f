"""Choice between float32 and bfloat16 for the matrix products of a network.

A processor without AVX-512 (or, on Arm, without bfloat16 instructions) has no fast bfloat16 product: PyTorch then
multiplies in a plain loop, about ten times slower than in float32.
"""

import logging
import time
from functools import cache
from typing import Literal, get_args

import torch
import torch.nn.functional as F

from zsp_lite.errors import InputError

Precision = Literal["float32", "bfloat16"]

_REPEATS = 7
_MARGIN = 0.95  # bfloat16 must take less than this fraction of the float32 time: at equal speed float32 is more exact

logger = logging.getLogger(__name__)


@cache
def bfloat16_is_fast(device_type: str) -> bool:
    """Tell whether bfloat16 matrix products are faster than float32 ones on a device.

    On a CPU, both are timed once per process on a small linear layer (about 50 ms). The minimum of the CPU time over
    several interleaved repeats is compared, so that other load on the machine does not change the result. (On Windows,
    the clock of the CPU time is too coarse, and the result is False.) On CUDA, native support of bfloat16 decides. On
    other devices the result is False.

    Args:
        device_type: "cpu", "cuda" or another value of `torch.device.type`.
    """
    if device_type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if device_type != "cpu":
        return False
    times = _linear_times()
    return times["bfloat16"] < _MARGIN * times["float32"]


def choose_precision(device_type: str) -> Precision:
    """Return "bfloat16" where it is faster than float32 on this device, otherwise "float32"."""
    return "bfloat16" if bfloat16_is_fast(device_type) else "float32"


def supported_precision(precision: Precision, device_type: str) -> Precision:
    """Return the requested precision, or "float32" with a logged warning where bfloat16 is slow on this device.

    Raises:
        InputError: The precision is unknown.
    """
    if precision not in get_args(Precision):
        raise InputError(f"precision: expected 'float32' or 'bfloat16', got {precision!r}")
    if precision == "bfloat16" and not bfloat16_is_fast(device_type):
        logger.warning("bfloat16 is slow on this device (%s); float32 is used instead", device_type)
        return "float32"
    return precision


def autocast(device_type: str, precision: Precision) -> torch.autocast:
    """Return the context in which a network runs at the given precision; it has no effect for "float32"."""
    return torch.autocast(device_type, torch.bfloat16, enabled=precision == "bfloat16")


@torch.inference_mode()
def _linear_times() -> dict[Precision, float]:
    """Shortest CPU time in seconds of a linear layer of the size of zsp-tiny's MLP on one thread, per precision."""
    layers = {}
    for precision, dtype in (("float32", torch.float32), ("bfloat16", torch.bfloat16)):
        layers[precision] = torch.ones(128, 192, dtype=dtype), torch.ones(768, 192, dtype=dtype)
    shortest = dict.fromkeys(layers, float("inf"))
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # CPU time of several threads includes their waiting for each other
    try:
        for repeat in range(_REPEATS + 1):
            for precision, (x, weight) in layers.items():
                start = time.thread_time()
                F.linear(x, weight)
                if repeat:  # the first call includes one-time initialisation
                    shortest[precision] = min(shortest[precision], time.thread_time() - start)
    finally:
        torch.set_num_threads(threads)
    return shortest
