"""Weights of an external filter's torch module in a safetensors file, and units of a task's pretrained filters."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from textwrap import shorten

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn

from beliefscope.datasets.errors import BadInput, reason_unreadable, type_name
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.task import Task
from beliefscope.filters.catalog import filters_of
from beliefscope.filters.checkpoint import load_checkpoint, partial_path, pretrained_path


def save_weights(tensors: Mapping[str, Tensor], path: Path) -> None:
    """Write the tensors of a module, for ``FILE.py:FUNCTION@PATH``, and delete the ``partial_path`` of the file."""
    write_atomically(path, save({name: tensor.cpu().contiguous() for name, tensor in tensors.items()}))
    partial_path(path).unlink(missing_ok=True)


def load_weights(module: object, path: Path, place: str) -> None:
    """Load weights into the module that ``place`` builds.

    Raises BadInput for a file that cannot be read or whose tensors are not those of the module.
    """
    if not isinstance(module, nn.Module):
        raise BadInput(f"{place} builds {type_name(module)}, weights need a torch module")
    try:
        module.load_state_dict(load_file(path))
    except (OSError, SafetensorError) as error:
        raise BadInput(f"weights {str(path)!r} cannot be read: {reason_unreadable(path, error)}") from None
    except RuntimeError as error:
        lines = str(error).splitlines() or ["no message"]
        reasons = lines[1:] or lines  # after a heading
        reason = shorten(reasons[0].strip().rstrip("."), 200, placeholder=" ...")
        more = f", and {len(reasons) - 1} more" if len(reasons) > 1 else ""
        raise BadInput(f"weights {str(path)!r} do not fit {place}: {reason}{more}") from None


@lru_cache(maxsize=16)
def pretrained_std(task: Task) -> Tensor:
    """(n,) m and rad: standard deviations of the pretrained filters' training states; NaN if there are none."""
    for name in filters_of(task):
        with suppress(BadInput):  # not every filter is pretrained
            return load_checkpoint(pretrained_path(task, name)).filter.statistics.mean_std("state")[1]
    return torch.full((len(task.components),), torch.nan)
