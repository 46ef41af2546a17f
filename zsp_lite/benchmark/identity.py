"""Digests of backbones, functions and objects. Equal digests mean equal results of one version of the library."""

import ast
import dataclasses
import functools
import hashlib
import inspect
import re
import textwrap
import types
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from zsp_lite.backbones.backbone import Backbone

_ADDRESS = re.compile(r"\b0x[0-9a-fA-F]+")


def digest_of(value: Any) -> str:
    """Return a hash of `description(value)`."""
    return hashlib.sha256(description(value).encode()).hexdigest()[:16]


def backbone_digest(backbone: Backbone) -> str:
    """Return a hash of a backbone's weights and settings. The device and the batch size are ignored."""
    chosen = (
        backbone.layer, backbone.facet, backbone.saliency_heads, backbone.image_size, backbone.mean, backbone.std,
        backbone.precision,
    )  # fmt: skip
    digest = hashlib.sha256(repr(chosen).encode())
    weights = backbone.model.state_dict()
    if backbone.position_head is not None:
        weights |= {f"positions.{key}": weight for key, weight in backbone.position_head.state_dict().items()}
    for key, weight in sorted(weights.items()):
        digest.update(key.encode() + _bytes(weight))
    return digest.hexdigest()[:16]


def description(value: Any, _within: tuple[int, ...] = ()) -> str:
    """Describe a value as text.

    A function is described by its source, defaults, closure and attributes, without comments, docstrings and the
    globals it uses; a lambda or a function without source by its bytecode, which depends on the version of Python.
    Functions and classes of the library are described by their names: a run records the library's version. An object is
    described by its `__repr__`, if its class defines one, otherwise by its class and its public attributes except
    cached properties. Arrays and weights are described by hashes.
    """
    value = inspect.unwrap(value) if callable(value) else value
    if id(value) in _within:
        return "(itself)"
    _within = (*_within, id(value))

    def all_of(values: Any) -> list[str]:
        return [description(one, _within) for one in values]

    if isinstance(value, Backbone):
        return backbone_digest(value)
    if isinstance(value, torch.Tensor):
        return f"{value.dtype}{tuple(value.shape)} {hashlib.sha256(_bytes(value)).hexdigest()}"
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{value.shape} {hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()}"
    if isinstance(value, Mapping):
        return f"{{{', '.join(sorted(map(': '.join, zip(all_of(value), all_of(value.values())))))}}}"
    if isinstance(value, list | tuple):
        return f"({', '.join(all_of(value))})"
    if isinstance(value, set | frozenset):
        return f"{{{', '.join(sorted(all_of(value)))}}}"
    if isinstance(value, functools.partial):
        return f"partial{description((value.func, value.args, value.keywords), _within)}"
    if inspect.ismodule(value):
        return value.__name__
    if inspect.ismethod(value):
        return f"{description(value.__self__, _within)}.{value.__name__}"
    if inspect.isfunction(value):
        cells = [cell.cell_contents for cell in value.__closure__ or () if cell != types.CellType()]
        code = _library_name(value) or _source(value) or _code(value.__code__, value.__doc__)
        attributes = description(vars(value), _within) if vars(value) else ""
        return code + description((value.__defaults__, value.__kwdefaults__, cells), _within) + attributes
    if inspect.isclass(value):
        if name := _library_name(value):
            return name
        return f"{value.__qualname__} {description(_members(value), _within)}"
    kind = type(value)
    attributes = _attributes(value)
    if isinstance(value, torch.nn.Module):
        attributes = {name: one for name, one in attributes.items() if name != "training"}
        attributes |= {"weights": value.state_dict(), "structure": repr(value)}
    elif kind.__repr__ is not object.__repr__ and not hasattr(kind, "__dataclass_fields__"):
        return f"{kind.__qualname__} {_ADDRESS.sub('', repr(value))}"
    own = [one for one in kind.__mro__ if one.__module__.split(".")[0] == kind.__module__.split(".")[0]]
    return " ".join(all_of(own)) + description(attributes, _within)


def _attributes(value: Any) -> dict[str, Any]:
    slots = [name for kind in type(value).__mro__ for name in getattr(kind, "__slots__", ()) if hasattr(value, name)]
    found = {name: getattr(value, name) for name in slots} | getattr(value, "__dict__", {})
    cached = (functools.cached_property, property)
    return {
        name: one for name, one in found.items()
        if name[0] != "_" and not isinstance(inspect.getattr_static(type(value), name, None), cached)
    }  # fmt: skip


def _bytes(tensor: torch.Tensor) -> bytes:
    return tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes()


def _members(kind: type) -> dict[str, Any]:
    """Functions and public attributes that a class defines itself, without the functions that `dataclass` generates."""
    unwrapped = {
        name: getattr(one, "__func__", getattr(one, "fget", getattr(one, "func", one)))
        for name, one in vars(kind).items()
    }
    return {
        name: one for name, one in unwrapped.items()
        if not name.startswith("_") or (inspect.isfunction(one) and not _generated(kind, name, one))
    }  # fmt: skip


def _generated(kind: type, name: str, function: types.FunctionType) -> bool:
    if "__dataclass_fields__" not in vars(kind) or not name.startswith("__"):
        return False
    return function.__code__.co_filename in ("<string>", dataclasses.__file__)


def _library_name(value: Any) -> str | None:
    """Name of a function or class of the library, None for others."""
    module = value.__module__ or ""
    return f"{module}.{value.__qualname__}" if module.split(".")[0] == __name__.split(".")[0] else None


def _source(function: types.FunctionType) -> str | None:
    """Source without comments and docstrings. None where it is unknown, and for lambdas: two may share a line."""
    if function.__name__ == "<lambda>" or function.__code__.co_filename == "<string>":
        return None
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    except (OSError, TypeError, SyntaxError):
        return None
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) and ast.get_docstring(node):
            node.body = node.body[1:]
    return ast.unparse(tree)  # unlike ast.dump, equal in all versions of Python


def _code(code: types.CodeType, docstring: str | None = None) -> str:
    """Bytecode and constants, without docstring and line numbers."""
    constants = [_code(one) if isinstance(one, types.CodeType) else description(one)
                 for one in code.co_consts if docstring is None or one != docstring]  # fmt: skip
    return f"{code.co_code.hex()} {code.co_names} {constants}"
