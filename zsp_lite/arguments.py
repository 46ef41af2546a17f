"""Check of a public function's arguments against its annotations, so that a wrong one raises InputError.

Written here, because checkers of types (beartype, typeguard) refuse what the library converts: lists for arrays,
integers for floats, NumPy's numbers for Python's.
"""

import functools
import inspect
import numbers
import reprlib
import sys
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Literal, TypeVar

import numpy as np
from jaxtyping import AbstractArray, Shaped, jaxtyped
from numpy.typing import ArrayLike

from zsp_lite.errors import InputError

Function = TypeVar("Function", bound=Callable)

_NUMBERS = {int: numbers.Integral, float: numbers.Real}


def checked(function: Function) -> Function:
    """Decorate a function so that each argument is compared with its annotation before the call.

    Arrays may be NumPy arrays, tensors or nested lists, of real numbers (of integers where the annotation has these)
    and of the annotated shape; sizes of the same name must be equal in all arguments. Numbers may be Python's or
    NumPy's; a bool is no number. Annotations that are not understood are not compared.

    Raises:
        InputError: An argument does not fit. (A missing or an unknown argument is Python's TypeError.)
    """
    signature = inspect.signature(function)
    hints = {name: one.annotation for name, one in signature.parameters.items() if one.annotation is not one.empty}

    @functools.wraps(function)
    def call(*args, **kwargs):
        bound = signature.bind(*args, **kwargs)
        with jaxtyped("context"):  # in which sizes of the same name are compared
            for name, value in bound.arguments.items():
                if name in hints and not _fits(value, hints[name]):
                    raise _unfit(function.__name__, name, value, hints[name])
        return function(*args, **kwargs)

    return call


def _fits(value: object, hint: Any) -> bool:
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if hint == ArrayLike:
        return _is_array(value, "biuf")
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, part) for part in _alternatives(parts))
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return _fits_array(value, hint)
    if origin is Literal:
        return any(type(value) is type(part) and value == part for part in parts)
    if hint in (None, types.NoneType):
        return value is None
    if hint in _NUMBERS:
        return isinstance(value, _NUMBERS[hint]) and not isinstance(value, bool | np.bool_)
    if hint is bool:
        return isinstance(value, bool | np.bool_)
    if origin is tuple:
        kinds = None if parts[-1] is Ellipsis else parts
        return _is_sequence(value) and (
            all(_fits(one, parts[0]) for one in value)
            if kinds is None
            else len(value) == len(kinds) and all(map(_fits, value, kinds))
        )
    if origin in (list, Sequence):
        return _is_sequence(value) and all(_fits(one, parts[0]) for one in value)
    if origin is Callable:
        return callable(value)
    if origin in (dict, Mapping, Iterable):
        return isinstance(value, origin)
    if getattr(hint, "_is_protocol", False):
        return callable(value)
    return isinstance(value, hint) if isinstance(hint, type) else True


def _alternatives(parts: tuple) -> list:
    """Return the members of a union, with those of ArrayLike, itself a union, put together again."""
    whole = set(typing.get_args(ArrayLike))
    return [ArrayLike, *(part for part in parts if part not in whole)] if whole and whole <= set(parts) else [*parts]


def _fits_array(value: object, hint: type[AbstractArray]) -> bool:
    kinds = "iu" if all("int" in str(kind) for kind in hint.dtypes) else "biuf"
    if not _is_array(value, kinds):
        return False
    array = value if isinstance(value, np.ndarray) or _is_tensor(value) else np.asarray(value)
    return isinstance(array, _shape(hint))


@functools.cache
def _shape(hint: type[AbstractArray]) -> type[AbstractArray]:
    return Shaped[Any, hint.dim_str]


def _is_tensor(value: object) -> bool:
    torch = sys.modules.get("torch")  # a tensor exists only where torch, which takes seconds to import, is imported
    return torch is not None and isinstance(value, torch.Tensor)


def _is_array(value: object, kinds: str) -> bool:
    """Tell whether a value is an array, a tensor or a nested list of numbers of these kinds (NumPy's letters)."""
    if _is_tensor(value):
        if value.is_complex() or value.is_quantized:
            return False
        return "f" in kinds or not value.is_floating_point()
    if isinstance(value, str | bytes | Mapping):
        return False
    try:
        return np.asarray(value).dtype.kind in kinds
    except (TypeError, ValueError, RuntimeError):  # ragged lists, or tensors that cannot be converted
        return False


def _is_sequence(value: object) -> bool:
    if isinstance(value, str | bytes):
        return False
    return isinstance(value, Sequence) or hasattr(value, "__array__")


def _unfit(function: str, name: str, value: object, hint: Any) -> InputError:
    with jaxtyped("context"):
        alone = _fits(value, hint)
    more = ", with the sizes of the other arguments" if alone else ""
    return InputError(f"{function}: {name} is {_shown(value)}, expected {_expected(hint)}{more}")


def _shown(value: object) -> str:
    if isinstance(value, np.ndarray) or _is_tensor(value):
        return f"an array of {value.dtype} of shape {tuple(value.shape)}"
    try:
        return reprlib.repr(value)
    except Exception:  # a foreign object's own representation may fail
        return f"a {type(value).__name__}"


def _expected(hint: Any) -> str:
    """Describe an annotation."""
    if hint == ArrayLike:
        return "real numbers"
    parts = typing.get_args(hint)
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(_expected, _alternatives(parts))))
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        kind = "integers" if all("int" in str(kind) for kind in hint.dtypes) else "real numbers"
        return f"{kind} of shape ({', '.join(hint.dim_str.split())})"
    if typing.get_origin(hint) is Literal:
        return "one of " + ", ".join(map(repr, parts))
    names = {int: "an integer", float: "a number", bool: "True or False", str: "a text", types.NoneType: "None"}
    if hint in names:
        return names[hint]
    return hint.__name__ if isinstance(hint, type) and not parts else str(hint).replace("typing.", "")
