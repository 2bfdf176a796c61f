"""Hash of an external filter."""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from beliefscope.filters.external.adapter import Adapter, unchanged


def fingerprint(adapter: Adapter) -> str:
    """SHA-256 of the adapter's settings, the filter's class or function, its source code and its parameters.

    Parameters are a module's state dictionary with the numbers and text in its attributes, or the arrays, numbers and
    text in the attributes of another object, or in the variables that a function encloses. Code is that of the files of
    its classes, or of the cells of a notebook.
    """
    settings = [[*values] for values in (adapter.components, adapter.mean, adapter.std, adapter.modalities)]
    filter_ = adapter.module
    digest = hashlib.sha256(repr((getattr(filter_, "__qualname__", type(filter_).__qualname__), settings)).encode())
    parts = [type(part) for part in filter_.modules()] if isinstance(filter_, nn.Module) else [_code_of(filter_)]
    parts = [*dict.fromkeys([*parts, *([] if adapter.inputs is unchanged else [_code_of(adapter.inputs)])])]
    for file in sorted(set(filter(None, map(_file_of, parts)))):
        with suppress(OSError):
            digest.update(Path(file).read_bytes())
    for part in parts:
        if _file_of(part) is None:
            digest.update(_source(part).encode())
    if isinstance(filter_, nn.Module):
        values = {**filter_.state_dict(), **_attributes(filter_)}
    else:
        values = dict(_leaves(_variables(filter_), "", set()))
    for key, value in sorted(values.items()):
        digest.update(key.encode())
        if isinstance(value, Tensor):
            value = value.detach().cpu().contiguous()
            digest.update(repr((value.dtype, value.shape)).encode())
            digest.update(value.flatten().view(torch.uint8).numpy().tobytes())
        elif isinstance(value, np.ndarray):
            digest.update(repr((value.dtype, value.shape)).encode() + value.tobytes())
        else:
            digest.update(repr(value).encode())
    return digest.hexdigest()


def _attributes(module: nn.Module) -> dict[str, Any]:
    """Numbers and text in the public attributes of a module and its submodules; its arrays may change in every step."""
    return {
        f"attribute {path}": value
        for name, part in module.named_modules()
        for key, attribute in vars(part).items()
        if not key.startswith("_") and key != "training"
        for path, value in _leaves(attribute, f"{name}.{key}", set())
        if not isinstance(value, Tensor | np.ndarray)
    }


def _code_of(filter_: object) -> Any:
    """The function, or the class of an object."""
    filter_ = getattr(filter_, "__func__", filter_)
    return filter_ if isinstance(filter_, FunctionType) else type(filter_)


def _file_of(part: Any) -> str | None:
    """File of the module of a function or class; None in a notebook."""
    return getattr(sys.modules.get(part.__module__), "__file__", None)


def _variables(filter_: object) -> object:
    """The variables that a function encloses; the object of a method; any other object itself."""
    if isinstance(filter_, FunctionType):
        return inspect.getclosurevars(filter_).nonlocals
    return getattr(filter_, "__self__", filter_)


def _source(part: Any) -> str:
    """Source code of a function, or of the functions of a class and its base classes."""
    if isinstance(part, FunctionType):
        with suppress(OSError, TypeError):
            return inspect.getsource(part)
        code = part.__code__
        return repr((code.co_code, code.co_names, [c for c in code.co_consts if not isinstance(c, CodeType)]))
    members = [member for base in getattr(part, "__mro__", ())[:-1] for member in vars(base).values()]
    return "".join(_source(member) for member in members if isinstance(member, FunctionType))


def _leaves(value: Any, path: str, seen: set[int]) -> Iterator[tuple[str, Any]]:
    """(path, value) of all arrays, numbers and texts that attributes, sequences and dictionaries lead to."""
    if isinstance(value, nn.Module):
        value = value.state_dict()
    if isinstance(value, Tensor | str | bytes | int | float | complex | np.generic) or value is None:
        yield path, value
    elif isinstance(value, np.ndarray):
        yield path, value if value.dtype != object else value.tolist()
    elif id(value) not in seen:
        seen.add(id(value))
        if isinstance(value, list | tuple):
            items: Mapping[Any, Any] = dict(enumerate(value))
        else:
            items = value if isinstance(value, Mapping) else getattr(value, "__dict__", {})
        for key, item in items.items():
            yield from _leaves(item, f"{path}/{key}", seen)
