"""Command lines that reproduce a result or open it in the dashboard, as text."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from beliefscope.filters.finetuning.settings import FineTune
    from beliefscope.inspect.trace import Trace


def serve_command(filters: Iterable[str | Path], data: Path | None, seed: int) -> str:
    """The command that serves these filters and data in addition to the pretrained filters and sample data."""
    words = ["beliefscope", "serve", *_options("--data", [data] if data else []), *_options("--filter", filters)]
    return shlex.join([*words, *_options("--seed", [seed] if seed else [])])


def report_command(files: Sequence[str], events: Sequence[object], slow: bool, title: str, *options: str) -> str:
    """The command that reproduces the report of some traces. slow: whether it includes slow diagnostics."""
    words = ["beliefscope", "report", *files, *(f"--event={event}" for event in events), *(["--all"] if slow else [])]
    return shlex.join([*words, *_options("--title", [title] if title else []), *options, "-o", "report"])


def trace_command(trace: Trace, file: str, filter_: str, data: Path | None) -> str:
    """The command that reproduces a trace, or a comment. filter_: as given on a command line; default: its name."""
    if trace.settings.get("edits"):
        return f"# {file} contains interventions: see its settings in manifest.json"
    source = str(trace.settings.get("source", ""))
    if not trace.checkpoint_hash:  # of a log, or of a loop of the user
        imported = ["beliefscope", "import", source, "--map", "MAP.toml", "--episode", str(trace.episode_index)]
        return shlex.join([*imported, "-o", file]) if source else f"# {file} was recorded while its filter ran"
    particles = trace.settings.get("particles", 300)
    words = ["beliefscope", "trace", trace.task.name, "--filter", filter_ or trace.filter]
    words += ["--episode", str(trace.episode_index), *_options("--data", [data] if data else [])]
    words += _options("--faults", [trace.faults] if trace.faults else [])
    words += _options("--particles", [particles] if particles != 300 else [])
    return shlex.join([*words, "--seed", str(trace.seed), "-o", file])


def finetune_command(target: str, filter_: str | None, data: Path | None, settings: FineTune) -> str:
    """The command that reproduces a fine-tuning run, without default values and without the folders of files."""
    from beliefscope.filters.finetuning.settings import FineTune

    names = [Path(text).name if text.endswith(".safetensors") else text for text in (target, filter_ or "")]
    words = ["beliefscope", "finetune", names[0], *_options("--filter", names[1:] if filter_ else [])]
    words += _options("--train", settings.train or ("all",)) + _options("--freeze", settings.freeze)
    words += _options("--slice", (slice_ for slice_, _ in settings.mix))
    words += _options("--event", settings.events)
    words += _options("--data", [data.name] if data else [])
    words += _options("--rate", (f"{pattern}={rate:g}" for pattern, rate in settings.rates))
    for field in ("clean_weight", "steps", "length", "rate", "l2_sp", "patience"):
        if (value := getattr(settings, field)) != getattr(FineTune(), field):
            words += [f"--{field.replace('_', '-')}", f"{value:g}"]
    words += ["--calibrate"] if settings.calibrate else []
    words += ["--success", str(settings.success)] if settings.success else []
    return shlex.join([*words, "--seed", str(settings.seed)])


def _options(name: str, values: Iterable[object]) -> list[str]:
    return [word for value in values for word in (name, str(value))]
