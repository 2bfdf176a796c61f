"""Modules of a filter by their dotted names: the module tree, selection of parameters to train, proof of freezing.

Patterns match dotted names as in a shell, with ``*`` crossing dots: ``weight_model`` matches everything inside it,
``virtual_sensors.*.log_noise`` the noise of every sensor, ``*.encoders`` all encoders. Any torch module works.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from difflib import get_close_matches
from fnmatch import fnmatchcase
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor, nn

from beliefscope.datasets.errors import BadInput
from beliefscope.filters.filter import Filter, modality_shape

MODALITY_PATTERNS = (
    "virtual_sensors.{modality}",
    "measurement_models.{modality}",
    "virtual_sensors.*.encoders.by_modality.{modality}",
    "measurement_models.*.encoders.by_modality.{modality}",
    "encoders.by_modality.{modality}",
)
"""Patterns of the preset ``MODALITY-only``."""

PRESETS: dict[str, tuple[str, ...]] = {
    "weights-only": ("weight_model.trunk", "weight_model.output", "weight_model.encoders.by_modality.{vector}"),
    "noise-only": ("dynamics.log_noise", "virtual_sensors.*.log_noise"),
    "reliability-only": (
        "virtual_sensors.*.log_noise",
        "measurement_models.*.head",
        "weight_model.trunk",
        "weight_model.output",
        "weight_model.encoders.by_modality.{vector}",
    ),
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
"""Name -> patterns; ``{vector}`` stands for each modality that is not an image. ``weights-only`` excludes the weight
model's image encoders, which would make a step many times slower; ``all`` and custom patterns can include them."""

PRESET_HELP = {
    "weights-only": "Trains the weight model; all measurement models stay the same.",
    "noise-only": "Trains the process and measurement noise; everything else stays the same.",
    "reliability-only": "Trains the noise of the measurement models and the fusion weights; everything else stays the "
    "same, so this is the safest choice for sensor faults.",
    "dynamics-only": "Trains the dynamics model; all other modules stay the same.",
    "heads-only": "Trains the output layers; all other layers stay the same.",
    "all": "Trains everything, including image encoders: the largest effect, slow, and likely to regress elsewhere.",
}
"""Preset -> effect. For that of a modality see ``preset_help``."""


def preset_help(name: str) -> str:
    """The effect of a preset in words."""
    modality = name.removesuffix("-only")
    return PRESET_HELP.get(name, f"Trains the measurement model of {modality}; all other modules stay the same.")


DESCRIPTIONS = {
    "": "the whole filter",
    "dynamics": "the next state from state and control, and the process noise",
    "dynamics.log_noise": "log standard deviations of the process noise",
    "log_scale": "log factors on the noise of the virtual sensors",
    "log_bias": "log sizes of the sensor biases",
    "memory": "correlation of the sensor biases over one step, as a logit",
    "log_motion": "log process noise per predicted motion",
    "virtual_sensors": "a virtual sensor for each modality",
    "virtual_sensors.*.state": "output: virtual observation of the state",
    "virtual_sensors.*.log_noise": "output: log standard deviations of the virtual observation",
    "measurement_models": "a likelihood for each modality",
    "measurement_models.*.head": "output: log-likelihood of the observation given the state",
    "weight_model": "the fusion weight of each modality, beta",
    "weight_model.output": "output: logits of beta",
    "statistics": "mean and standard deviation of the training data",
    "*encoders": "an encoder for each modality",
    "*.by_modality.*.*": "",
    "*by_modality.*": "encoder of the observations of this modality",
    "*trunk": "layers on the joined features of all encoders",
    "*.join_*": "one term of the first joint layer, which is a sum of two",
    "*state_encoder": "encoder of the state",
    "*control_encoder": "encoder of the controls",
    "*.shared": "layers on state and controls together",
    "dynamics.output": "output: change of the state and its gate",
}
"""Pattern -> description of a module of our filters; the first match counts."""


@dataclass(frozen=True)
class Node:
    """A module, or a parameter next to modules.

    Attributes:
        name: dotted, "" for the whole. kind: its class. description: its purpose.
        parameters, buffers: number of values, including submodules. trained: number of trained parameters.
    """

    name: str
    kind: str
    description: str
    parameters: int
    buffers: int
    trained: int

    def to_json(self) -> dict[str, Any]:
        """All attributes; the kind is named ``class``."""
        values = asdict(self)
        return {"name": values.pop("name"), "class": values.pop("kind"), **values, "state": self.state}

    @property
    def depth(self) -> int:
        return self.name.count(".") + 1 if self.name else 0

    @property
    def state(self) -> str:
        """``frozen``, ``trained`` or ``partly trained``; ``-`` without parameters."""
        if not self.parameters:
            return "-"
        return {0: "frozen", self.parameters: "trained"}.get(self.trained, "partly trained")


def module_tree(module: nn.Module, trained: Iterable[str] = ()) -> list[Node]:
    """Every module, after the one that contains it. trained: names of parameters, as from ``select_parameters``."""
    names, sizes = set(trained), {name: p.numel() for name, p in module.named_parameters(remove_duplicate=False)}
    buffer_sizes = {name: b.numel() for name, b in module.named_buffers(remove_duplicate=False)}

    def node(name: str, kind: str, description: str) -> Node:
        inside = {key: size for key, size in sizes.items() if within(key, name)}
        buffers = sum(size for key, size in buffer_sizes.items() if within(key, name))
        trained_size = sum(inside[key] for key in inside.keys() & names)
        return Node(name, kind, description, sum(inside.values()), buffers, trained_size)

    ours = isinstance(module, Filter)

    def walk(part: nn.Module, name: str) -> Iterator[Node]:
        yield node(name, type(part).__name__, (_description(name) if ours else "") or _docstring(part))
        children = dict(part.named_children())
        if children:
            for key, value in part.named_parameters(recurse=False):
                full = f"{name}.{key}" if name else key
                yield node(full, type(value).__name__, _description(full) if ours else str(tuple(value.shape)))
        for key, child in children.items():
            yield from walk(child, f"{name}.{key}" if name else key)

    return list(walk(module, ""))


def within(name: str, part: str) -> bool:
    """Whether a dotted name equals ``part`` or lies inside it; every name lies inside ""."""
    return not part or name == part or name.startswith(f"{part}.")


def _description(name: str) -> str:
    return next((text for pattern, text in DESCRIPTIONS.items() if fnmatchcase(name, pattern)), "")


def _docstring(part: nn.Module) -> str:
    """The first line of the class's docstring; for torch's own modules their sizes."""
    if type(part).__module__.startswith("torch."):
        return part.extra_repr()
    return ((type(part).__doc__ or "").strip().splitlines() or [""])[0].replace("``", "").removesuffix(".")


def presets(module: nn.Module) -> dict[str, tuple[str, ...]]:
    """Name -> patterns, of the presets that apply to this module; an external one has only ``all``."""
    if not isinstance(module, Filter):
        return {"all": PRESETS["all"]}
    task = module.task
    named = {
        f"{modality}-only": [p.format(modality=modality) for p in MODALITY_PATTERNS] for modality in task.modalities
    }
    vectors = [modality for modality in task.modalities if len(modality_shape(task, modality)) == 1]
    for name, patterns in PRESETS.items():
        named[name] = list(dict.fromkeys(p.format(vector=vector) for p in patterns for vector in vectors or [""]))
    matched = {name: _without_redundant(named_tensors(module), patterns) for name, patterns in named.items()}
    return {name: patterns for name, patterns in matched.items() if patterns}


def _without_redundant(names: Iterable[str], patterns: Iterable[str]) -> tuple[str, ...]:
    """The patterns that match a name which no earlier one matches."""
    matched: set[str] = set()
    useful = []
    for pattern in patterns:
        if new := set(matching(names, pattern)) - matched:
            useful.append(pattern)
            matched |= new
    return tuple(useful)


def named_tensors(module: nn.Module) -> dict[str, Tensor]:
    """Parameters and buffers by dotted name; a shared one appears under each of its names."""
    return {
        **dict(module.named_parameters(remove_duplicate=False)),
        **dict(module.named_buffers(remove_duplicate=False)),
    }


def matching(names: Iterable[str], pattern: str) -> list[str]:
    """Names that the pattern matches, directly or through a module that contains them."""
    return [name for name in names if any(fnmatchcase(prefix, pattern) for prefix in _prefixes(name))]


def _prefixes(name: str) -> Iterator[str]:
    """``a``, ``a.b``, ``a.b.c`` of ``a.b.c``."""
    return accumulate(name.split("."), "{}.{}".format)


def select_parameters(
    module: nn.Module, train: Sequence[str] = (), freeze: Sequence[str] = ()
) -> dict[str, nn.Parameter]:
    """The parameters to train by name, each once: ``train`` (presets or patterns; default all) less ``freeze``.

    Raises BadInput for a pattern without a match, and if nothing is left to train.
    """
    tensors, available = named_tensors(module), presets(module)
    trained = {name for pattern in train or ("*",) for name in _matches(module, available, pattern)}
    frozen = {id(tensors[name]) for pattern in freeze for name in _matches(module, available, pattern)}
    trained_ids = {id(tensors[name]) for name in trained}  # a shared tensor counts under any of its names
    selected = {name: p for name, p in module.named_parameters() if id(p) in trained_ids and id(p) not in frozen}
    if not selected:
        options = " ".join(
            [*(f"--train {pattern}" for pattern in train), *(f"--freeze {pattern}" for pattern in freeze)]
        )
        raise BadInput(f"{options} leaves nothing to train. {_available(module, available)}")
    return selected


def _matches(module: nn.Module, available: Mapping[str, tuple[str, ...]], pattern: str) -> list[str]:
    """Names that a preset or pattern matches. Raises BadInput with similar names if there are none."""
    tensors = named_tensors(module)
    names = [name for each in available.get(pattern, (pattern,)) for name in matching(tensors, each)]
    if not names:
        candidates = dict.fromkeys([*available, *(prefix for name in tensors for prefix in _prefixes(name))])
        close = get_close_matches(pattern, candidates, n=3, cutoff=0.6)
        hint = f" Did you mean {' or '.join(close)}?" if close else ""
        raise BadInput(f"pattern {pattern!r} matches no module of this filter.{hint} {_available(module, available)}")
    return names


def _available(module: nn.Module, available: Iterable[str]) -> str:
    shallow = dict.fromkeys(prefix for name, _ in module.named_parameters() for prefix in list(_prefixes(name))[:2])
    return f"Available: {', '.join(available)}; {', '.join(shallow)}; and deeper names."


def freeze(module: nn.Module, trained: Mapping[str, nn.Parameter]) -> list[str]:
    """Freezes all but ``trained``. Modules without a trained parameter enter evaluation mode: their buffers are fixed.

    Returns the names of all frozen parameters and buffers.
    """
    module.requires_grad_(False)
    for parameter in trained.values():
        parameter.requires_grad_(True)
    _set_mode(module, False)
    variable = {id(buffer) for part in module.modules() if part.training for buffer in part.buffers(recurse=False)}
    variable |= {id(parameter) for parameter in trained.values()}
    return [name for name, tensor in named_tensors(module).items() if id(tensor) not in variable]


def _set_mode(part: nn.Module, all_trained: bool) -> None:
    """Training mode for modules with a trained parameter. One without parameters, such as dropout, is in training mode
    if all of its container is trained."""
    trained = [parameter.requires_grad for parameter in part.parameters()]
    part.training = any(trained) if trained else all_trained
    for child in part.children():
        _set_mode(child, all(trained) if trained else all_trained)


def digest(module: nn.Module, names: Iterable[str]) -> str:
    """SHA-256 of these parameters and buffers: names, types, shapes and values."""
    tensors, total = named_tensors(module), hashlib.sha256()
    for name in sorted(names):
        tensor = tensors[name].detach().cpu().contiguous()
        total.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        total.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return total.hexdigest()


def module_change(name: str, changes: Mapping[str, Sequence[float]]) -> dict[str, float]:
    """The size of a module's gradient, and the change of its weights relative to their norm.

    Args:
        changes: parameter -> norm of the gradient (root mean square over the steps), of the change, and of the base
            weights; ``parts`` in the record of a fine-tuned checkpoint.
    """
    gradient, change, norm = (
        sum(values[i] ** 2 for key, values in changes.items() if within(key, name)) ** 0.5 for i in range(3)
    )
    return {"gradient": gradient, "change": change / norm if norm else 0.0}
