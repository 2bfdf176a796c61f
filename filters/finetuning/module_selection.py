"""The modules inside a filter by their dotted names: what there is, what of it is to be trained, proof of the rest.

A pattern is matched against dotted names as a shell matches files, ``*`` across dots too: ``weight_model`` is all that
is in it, ``virtual_sensors.*.log_noise`` every sensor's noise, ``*.encoders`` all encoders. Any torch module will do.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from fnmatch import fnmatchcase
from itertools import accumulate

import torch
from torch import Tensor, nn

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.filter import Filter, modality_shape

OF_MODALITY = (
    "virtual_sensors.{modality}",
    "measurement_models.{modality}",
    "virtual_sensors.*.encoders.by_modality.{modality}",
    "measurement_models.*.encoders.by_modality.{modality}",
    "encoders.by_modality.{modality}",
)
"""What makes up the preset ``MODALITY-only``."""

PRESETS: dict[str, tuple[str, ...]] = {
    "weights-only": ("weight_model.trunk", "weight_model.output", "weight_model.encoders.by_modality.{vector}"),
    "noise-only": ("dynamics.log_noise", "virtual_sensors.*.log_noise"),
    "dynamics-only": ("dynamics",),
    "heads-only": (
        "virtual_sensors.*.state",
        "virtual_sensors.*.log_noise",
        "measurement_models.*.head",
        "weight_model.output",
        "dynamics.output",
        "output",
    ),
    "all": ("*",),
}
"""Name -> patterns; ``{vector}`` stands for each modality that is no picture. The weights' own picture encoders stay as
they are: with them in the graph a step takes many times as long. Only ``all`` and a pattern of your own train them."""

SAYS = {
    "": "the whole filter",
    "dynamics": "the next state from state and control, and the process noise",
    "dynamics.log_noise": "log standard deviations of the process noise",
    "virtual_sensors": "a virtual sensor for each modality",
    "virtual_sensors.*.state": "features to a virtual observation of the state",
    "virtual_sensors.*.log_noise": "features to the log standard deviations of that observation",
    "measurement_models": "a likelihood for each modality",
    "measurement_models.*.head": "state and observation to the log-likelihood",
    "weight_model": "how much each modality is trusted, beta",
    "weight_model.output": "features to the logits of beta",
    "statistics": "mean and standard deviation of the training data",
    "*encoders": "an encoder for each modality",
    "*.by_modality.*.*": "",
    "*by_modality.*": "observations of this modality to features",
    "*trunk": "the features of all encoders, joined",
    "*.join_*": "one summand of the first layer that sees both state and the rest",
    "*state_encoder": "states to features",
    "*control_encoder": "controls to features",
    "*.shared": "state and control together",
    "dynamics.output": "features to the change of the state and its gate",
}
"""Pattern -> a word on what a part of our filters does; the first that matches counts."""


@dataclass(frozen=True)
class Node:
    """A module, or a parameter that lies beside modules.

    Attributes:
        name: dotted, "" for the whole. kind: its class. says: what it does, in a word.
        parameters, buffers: numbers in it and in all below it. trained: of these parameters, those that are trained.
    """

    name: str
    kind: str
    says: str
    parameters: int
    buffers: int
    trained: int

    @property
    def depth(self) -> int:
        return self.name.count(".") + 1 if self.name else 0

    @property
    def state(self) -> str:
        """``frozen``, ``trained`` or ``in part``; ``-`` where there is nothing to train."""
        if not self.parameters:
            return "-"
        return {0: "frozen", self.parameters: "trained"}.get(self.trained, "in part")


def tree(module: nn.Module, trained: Iterable[str] = ()) -> list[Node]:
    """Every module, each behind the one it is in. trained: names of parameters, as ``chosen`` gives them."""
    names, sizes = set(trained), {name: p.numel() for name, p in module.named_parameters(remove_duplicate=False)}
    held = {name: b.numel() for name, b in module.named_buffers(remove_duplicate=False)}

    def node(name: str, kind: str, says: str) -> Node:
        inside = {key: size for key, size in sizes.items() if within(key, name)}
        buffers = sum(size for key, size in held.items() if within(key, name))
        return Node(name, kind, says, sum(inside.values()), buffers, sum(inside[key] for key in inside.keys() & names))

    ours = isinstance(module, Filter)

    def walk(part: nn.Module, name: str) -> Iterator[Node]:
        yield node(name, type(part).__name__, (_says(name) if ours else "") or _described(part))
        children = dict(part.named_children())
        if children:
            for key, value in part.named_parameters(recurse=False):
                full = f"{name}.{key}" if name else key
                yield node(full, type(value).__name__, _says(full) if ours else str(tuple(value.shape)))
        for key, child in children.items():
            yield from walk(child, f"{name}.{key}" if name else key)

    return list(walk(module, ""))


def within(name: str, part: str) -> bool:
    """Whether a dotted name is ``part``'s or of something in it; everything is in ""."""
    return not part or name == part or name.startswith(f"{part}.")


def _says(name: str) -> str:
    return next((text for pattern, text in SAYS.items() if fnmatchcase(name, pattern)), "")


def _described(part: nn.Module) -> str:
    """The first line of its docstring; for torch's own modules, which are known, their sizes."""
    if type(part).__module__.startswith("torch."):
        return part.extra_repr()
    return ((type(part).__doc__ or "").strip().splitlines() or [""])[0].replace("``", "")


def presets(module: nn.Module) -> dict[str, tuple[str, ...]]:
    """Name -> patterns, for what this module has. One from outside has only ``all``."""
    if not isinstance(module, Filter):
        return {"all": PRESETS["all"]}
    task = module.task
    named = {f"{modality}-only": [p.format(modality=modality) for p in OF_MODALITY] for modality in task.modalities}
    vectors = [modality for modality in task.modalities if len(modality_shape(task, modality)) == 1]
    for name, patterns in PRESETS.items():
        named[name] = list(dict.fromkeys(p.format(vector=vector) for p in patterns for vector in vectors or [""]))
    found = {name: _telling(tensors_of(module), patterns) for name, patterns in named.items()}
    return {name: patterns for name, patterns in found.items() if patterns}


def _telling(names: Iterable[str], patterns: Iterable[str]) -> tuple[str, ...]:
    """The patterns that match something which those before them do not."""
    seen: set[str] = set()
    telling = []
    for pattern in patterns:
        if new := set(matching(names, pattern)) - seen:
            telling.append(pattern)
            seen |= new
    return tuple(telling)


def tensors_of(module: nn.Module) -> dict[str, Tensor]:
    """Parameters and buffers by dotted name; what is shared has several."""
    return {
        **dict(module.named_parameters(remove_duplicate=False)),
        **dict(module.named_buffers(remove_duplicate=False)),
    }


def matching(names: Iterable[str], pattern: str) -> list[str]:
    """Names that the pattern matches, themselves or by a module they are in."""
    return [name for name in names if any(fnmatchcase(part, pattern) for part in _parts(name))]


def _parts(name: str) -> Iterator[str]:
    """``a``, ``a.b``, ``a.b.c`` of ``a.b.c``."""
    return accumulate(name.split("."), "{}.{}".format)


def chosen(module: nn.Module, train: Sequence[str] = (), freeze: Sequence[str] = ()) -> dict[str, nn.Parameter]:
    """The parameters to train by name, each once: of ``train``, presets or patterns, all without any, less ``freeze``.

    Raises BadInput for a pattern that matches nothing, and where nothing is left to train.
    """
    tensors, known = tensors_of(module), presets(module)
    wanted = {name for one in train or ("*",) for name in _of(module, known, one)}
    kept = {id(tensors[name]) for one in freeze for name in _of(module, known, one)}
    found = {
        name: p for name, p in module.named_parameters() if id(p) not in kept and name in _named_by(tensors, wanted)
    }
    if not found:
        what = " ".join([*(f"--train {one}" for one in train), *(f"--freeze {one}" for one in freeze)])
        raise BadInput(f"{what} leaves nothing to train. {_available(module, known)}")
    return found


def _named_by(tensors: Mapping[str, Tensor], names: set[str]) -> set[str]:
    """The names, and all others of the same tensors."""
    same = {id(tensors[name]) for name in names}
    return {name for name, tensor in tensors.items() if id(tensor) in same}


def _of(module: nn.Module, known: Mapping[str, tuple[str, ...]], wanted: str) -> list[str]:
    """Names of a preset or pattern. Raises BadInput, with what is written alike first, where there are none."""
    tensors = tensors_of(module)
    found = [name for pattern in known.get(wanted, (wanted,)) for name in matching(tensors, pattern)]
    if not found:
        every = dict.fromkeys([*known, *(part for name in tensors for part in _parts(name))])
        close = get_close_matches(wanted, every, n=3, cutoff=0.6)
        hint = f" Did you mean {' or '.join(close)}?" if close else ""
        raise BadInput(f"pattern {wanted!r} matches no part of this filter.{hint} {_available(module, known)}")
    return found


def _available(module: nn.Module, known: Iterable[str]) -> str:
    shallow = dict.fromkeys(part for name, _ in module.named_parameters() for part in list(_parts(name))[:2])
    return f"Available: {', '.join(known)}; {', '.join(shallow)}; and all that lies deeper."


def freeze(module: nn.Module, trained: Mapping[str, nn.Parameter]) -> list[str]:
    """Only ``trained`` requires a gradient; what holds none of it is in evaluation mode, so that no buffer moves.

    Returns the names of all that stays as it is, buffers included.
    """
    module.requires_grad_(False)
    for parameter in trained.values():
        parameter.requires_grad_(True)
    _set_mode(module, False)
    moving = {id(buffer) for part in module.modules() if part.training for buffer in part.buffers(recurse=False)}
    moving |= {id(parameter) for parameter in trained.values()}
    return [name for name, tensor in tensors_of(module).items() if id(tensor) not in moving]


def _set_mode(part: nn.Module, whole: bool) -> None:
    """Training mode where something trains. What has no parameters, as dropout, goes with a parent that all trains."""
    moves = [parameter.requires_grad for parameter in part.parameters()]
    part.training = any(moves) if moves else whole
    for child in part.children():
        _set_mode(child, all(moves) if moves else whole)


def digest(module: nn.Module, names: Iterable[str]) -> str:
    """SHA-256 over these parameters and buffers: names, types, shapes and every bit."""
    tensors, total = tensors_of(module), hashlib.sha256()
    for name in sorted(names):
        tensor = tensors[name].detach().cpu().contiguous()
        total.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        total.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return total.hexdigest()


def moved(name: str, ran: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """What a training did to a module: its gradient's size, and how far its weights went, relative to their norm.

    Args:
        ran: parameter -> norm of the gradient (root mean square over the steps), of the change, and of the parent's
            weights; as a fine-tuned checkpoint's record holds them under ``parts``.
    """
    gradient, change, norm = (
        sum(values[i] ** 2 for key, values in ran.items() if within(key, name)) ** 0.5 for i in range(3)
    )
    return {"gradient": gradient, "change": change / norm if norm else 0.0}
