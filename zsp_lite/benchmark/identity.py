"""What someone's own function or object is, as a text: two of the same text can be expected to answer alike."""

import functools
import hashlib
import inspect
import re
import types
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

_ADDRESS = re.compile(r" at 0x[0-9a-fA-F]+")
_TRANSIENT = ("training",)  # a module's mode: turned back and forth by whoever uses it


def digest_of(value: Any) -> str:
    """A hash of `description`."""
    return hashlib.sha256(description(value).encode()).hexdigest()[:16]


def description(value: Any, _within: tuple[int, ...] = ()) -> str:
    """Functions by their source, defaults and what they close over; objects by their class and public attributes.

    Arrays and weights go in as hashes. What a function looks up among its module's globals is not followed, and
    attributes whose names begin with an underscore are taken for caches.
    """
    if id(value) in _within:
        return "(itself)"
    _within = (*_within, id(value))

    def all_of(values: Any) -> list[str]:
        return [description(one, _within) for one in values]

    if isinstance(value, np.ndarray | torch.Tensor):
        array = value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else value
        return f"{array.dtype}{array.shape} {hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()}"
    if isinstance(value, Mapping):
        return f"{{{', '.join(sorted(map(': '.join, zip(all_of(value), all_of(value.values())))))}}}"
    if isinstance(value, list | tuple):
        return f"({', '.join(all_of(value))})"
    if isinstance(value, set | frozenset):
        return f"{{{', '.join(sorted(all_of(value)))}}}"
    if isinstance(value, functools.partial):
        return f"partial{description((value.func, value.args, value.keywords), _within)}"
    if inspect.ismethod(value):
        return f"{description(value.__self__, _within)}.{value.__name__}"
    if inspect.isfunction(value):
        cells = [cell.cell_contents for cell in value.__closure__ or () if cell != types.CellType()]
        return _source(value) + description((value.__defaults__, value.__kwdefaults__, cells), _within)
    if inspect.isclass(value):
        return _source(value)
    attributes = getattr(value, "__dict__", None)
    if attributes is None or inspect.isroutine(value) or inspect.ismodule(value):
        return _ADDRESS.sub("", repr(value))
    known = {name: one for name, one in attributes.items() if name[0] != "_" and name not in _TRANSIENT}
    if isinstance(value, torch.nn.Module):
        known |= {"weights": value.state_dict(), "structure": repr(value)}
    kind = type(value)
    own = [one for one in kind.__mro__ if one.__module__.split(".")[0] == kind.__module__.split(".")[0]]
    return " ".join(map(_source, own)) + description(known, _within)


def _source(known: Any) -> str:
    try:
        return inspect.getsource(known)
    except (OSError, TypeError):  # typed in at a prompt, unpickled in a worker, or compiled
        name = getattr(known, "__qualname__", str(known))
    if inspect.isclass(known):
        members = [one for one in vars(known).values() if inspect.isfunction(one)]
        return f"{name} {' '.join(map(_source, members))}"
    code = getattr(known, "__code__", None)
    return name if code is None else f"{name} {_code(code)}"


def _code(code: types.CodeType) -> str:
    constants = [_code(one) if isinstance(one, types.CodeType) else description(one) for one in code.co_consts]
    return f"{code.co_code.hex()} {code.co_names} {constants}"
