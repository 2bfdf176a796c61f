"""Intermediate results of a training: its state, for resuming it, and modules that several filters share."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from beliefscope.datasets.io.atomic_write import write_atomically


def cache_key(**inputs: Any) -> str:
    """A hash of everything that a result depends on, as JSON values."""
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()


class Partial:
    """The state of one unfinished training, tensors and JSON, in one file next to its checkpoint.

    A damaged file is treated as missing.

    Args:
        path: of the file. key: of the training; a file with another key is ignored.
    """

    def __init__(self, path: Path, key: str) -> None:
        self.path, self.key = path, key

    def load(self) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
        """The saved tensors and progress; None if there is nothing to resume."""
        return _read(self.path, self.key)

    def save(self, tensors: Mapping[str, Tensor], progress: Mapping[str, Any]) -> None:
        _write(self.path, tensors, {**progress, "key": self.key})


class SharedModules:
    """A folder of trained modules that do not depend on the filter they belong to: dynamics, image encoders."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def load(self, key: str) -> dict[str, Tensor] | None:
        content = _read(self._folder / f"{key}.safetensors", key)
        return content and content[0]

    def save(self, key: str, tensors: Mapping[str, Tensor]) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        _write(self._folder / f"{key}.safetensors", tensors, {"key": key})


def _read(path: Path, key: str) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        # Without the digest, damaged weights would go unnoticed.
        if metadata.get("digest") != _digest(metadata["kept"], tensors):
            return None
        header = json.loads(metadata["kept"])
        return (tensors, header) if header["key"] == key else None
    except (SafetensorError, OSError, ValueError, KeyError, TypeError):
        return None


def _digest(header: str, tensors: Mapping[str, Tensor]) -> str:
    total = hashlib.sha256(header.encode())
    for name, tensor in sorted(tensors.items()):
        total.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        total.update(tensor.numpy().tobytes())
    return total.hexdigest()


def _write(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    contiguous = {name: value.detach().cpu().contiguous() for name, value in tensors.items()}
    text = json.dumps(header)
    write_atomically(path, save(contiguous, metadata={"kept": text, "digest": _digest(text, contiguous)}))
