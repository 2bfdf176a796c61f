"""Hash of an external filter."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from beliefscope.filters.external.adapter import Adapter, unchanged
from beliefscope.filters.external.source_files import file_of, files_with_imports, is_own

OF_PROCESS = {"asyncio", "concurrent", "logging", "multiprocessing", "threading"}
"""Modules whose objects lead to the state of the process, such as all loggers."""


def fingerprint(adapter: Adapter) -> str:
    """SHA-256 of the adapter's settings, the filter's class or function, its source code and its parameters.

    Parameters are a module's state dictionary with the numbers and text in its attributes, or the arrays, numbers and
    text in the attributes of another object, or in the variables that a function or a method encloses. Code is that of
    the files of all functions and classes that these lead to, with the files that the user's ones import, or of the
    cells of a notebook. Code of installed packages is covered only for the filter's own class.
    """
    settings = [[*values] for values in (adapter.components, adapter.mean, adapter.std, adapter.modalities)]
    settings += [[*adapter.initial_std, adapter.batched, adapter.absent]]
    filter_ = adapter.module
    digest = hashlib.sha256(repr((getattr(filter_, "__qualname__", type(filter_).__qualname__), settings)).encode())
    parts = [type(part) for part in filter_.modules()] if isinstance(filter_, nn.Module) else [_code_of(filter_)]
    functions = [function for function in (adapter.inputs, adapter.log_likelihood) if function is not unchanged]
    values = dict(_leaves([parts, functions], "code", set()))
    if isinstance(filter_, nn.Module):
        values |= {**filter_.state_dict(), **_attributes(filter_)}
    else:
        values |= dict(_leaves(_variables(filter_), "", set()))
    reached = [value for value in values.values() if isinstance(value, type | FunctionType) and is_own(value)]
    parts = [*dict.fromkeys([*parts, *reached])]
    for content in sorted(filter(None, map(_content, files_with_imports(parts)))):
        digest.update(content)
    for part in parts:
        if file_of(part) is None:
            digest.update(_source(part).encode())
    for key, value in sorted(values.items()):
        digest.update(key.encode())
        if isinstance(value, Tensor):
            value = value.detach().cpu().contiguous()
            digest.update(repr((value.dtype, value.shape)).encode())
            digest.update(value.flatten().view(torch.uint8).numpy().tobytes())
        elif isinstance(value, np.ndarray):
            digest.update(repr((value.dtype, value.shape)).encode() + value.tobytes())
        elif isinstance(value, type | FunctionType):
            digest.update(repr((value.__qualname__, _line(value))).encode())
        else:
            digest.update(repr(value).encode())
    return digest.hexdigest()


def _content(file: Path) -> bytes:
    with suppress(OSError):
        return file.read_bytes()
    return b""


def _line(part: Any) -> int:
    """First line of a function of the user in its file, which distinguishes functions of the same name; else 0."""
    is_stable = isinstance(part, FunctionType) and is_own(part) and file_of(part) is not None
    return part.__code__.co_firstlineno if is_stable else 0


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
    """(path, value) of all arrays, numbers, texts, functions and classes that an object leads to."""
    if isinstance(value, nn.Module):
        value = value.state_dict()
    if isinstance(value, Tensor | str | bytes | int | float | complex | np.generic) or value is None:
        yield path, value
    elif isinstance(value, np.ndarray):
        yield path, value if value.dtype != object else value.tolist()
    elif id(value) not in seen:
        seen.add(id(value))
        if isinstance(value, type | FunctionType):
            yield path, value
        for key, item in _items(value).items():
            yield from _leaves(item, f"{path}/{key}", seen)


def _items(value: Any) -> Mapping[Any, Any]:
    """What an object consists of: elements, attributes, the variables that a function encloses, methods of a class."""
    if isinstance(value, list | tuple):
        return dict(enumerate(value))
    if isinstance(value, Mapping):
        return value
    if isinstance(value, MethodType):
        return {"object": value.__self__, "function": value.__func__}
    if isinstance(value, partial):
        return {"function": value.func, "arguments": value.args, "keywords": value.keywords}
    if isinstance(value, FunctionType):
        defaults = {"defaults": value.__defaults__, "keywords": value.__kwdefaults__}
        return {**inspect.getclosurevars(value).nonlocals, **defaults} if is_own(value) else {}
    if isinstance(value, ModuleType) or type(value).__module__.partition(".")[0] in OF_PROCESS:
        return {"class": type(value), "name": getattr(value, "__name__", "")}
    if isinstance(value, type):
        members = {
            name: member for base in reversed(value.__mro__) if is_own(base) for name, member in vars(base).items()
        }
        return {name: member for name, member in members.items() if isinstance(member, FunctionType)}
    return {"class": type(value), **getattr(value, "__dict__", {})}
