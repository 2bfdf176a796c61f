"""What a training keeps on the way: finished stages, to go on after a kill, and parts that several filters share."""

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


def key_of(**what: Any) -> str:
    """A hash of JSON values: of all that a result depends on."""
    return hashlib.sha256(json.dumps(what, sort_keys=True).encode()).hexdigest()


class Partial:
    """How far one training has come, tensors and JSON, in one file beside its checkpoint.

    A file that is damaged anywhere is as good as none.

    Args:
        path: of the file. key: of the training; a file with another key is of no use to this one.
    """

    def __init__(self, path: Path, key: str) -> None:
        self.path, self.key = path, key

    def load(self) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
        """Tensors and progress as they were saved; None where there is nothing to go on from."""
        return _read(self.path, self.key)

    def save(self, tensors: Mapping[str, Tensor], progress: Mapping[str, Any]) -> None:
        _write(self.path, tensors, {**progress, "key": self.key})

    def drop(self) -> None:
        self.path.unlink(missing_ok=True)


class Parts:
    """A folder of trained modules that do not depend on the filter they sit in: dynamics, picture encoders."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def load(self, key: str) -> dict[str, Tensor] | None:
        found = _read(self._folder / f"{key}.safetensors", key)
        return found and found[0]

    def save(self, key: str, tensors: Mapping[str, Tensor]) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        _write(self._folder / f"{key}.safetensors", tensors, {"key": key})


def _read(path: Path, key: str) -> tuple[dict[str, Tensor], dict[str, Any]] | None:
    try:
        with safe_open(path, framework="pt") as file:
            said = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
        # Nobody could tell wrong weights from right ones later on.
        if said.get("digest") != _digest(said["kept"], tensors):
            return None
        header = json.loads(said["kept"])
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
    said = json.dumps(header)
    write_atomically(path, save(contiguous, metadata={"kept": said, "digest": _digest(said, contiguous)}))
