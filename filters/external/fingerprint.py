"""Hash of an external filter."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from beliefscope.filters.external.adapter import Adapter


def fingerprint(adapter: Adapter, source: str) -> str:
    """SHA-256 of the adapter's settings, the filter's source files and its parameters.

    Parameters are a module's state dictionary, or the arrays, numbers and text in the attributes of another object.
    """
    digest = hashlib.sha256(repr((source, [*adapter.components], [*adapter.mean], [*adapter.std])).encode())
    digest.update(repr([*adapter.modalities]).encode())
    filter_ = adapter.module
    parts = filter_.modules() if isinstance(filter_, nn.Module) else [filter_]
    names = {getattr(part, "__module__", "") for part in (*parts, adapter.inputs)}
    files = {getattr(sys.modules.get(name), "__file__", None) for name in names}
    for file in sorted(filter(None, files)):
        with suppress(OSError):
            digest.update(Path(file).read_bytes())
    values = filter_.state_dict() if isinstance(filter_, nn.Module) else dict(_leaves(filter_, "", set()))
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
