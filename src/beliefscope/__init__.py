"""Beliefscope: diagnostics and interpretability for multimodal differentiable filters.

The names in ``__all__`` are the public Python interface (docs/python.md); all others may change. They are imported
when they are first used, so that ``import beliefscope`` takes a few milliseconds.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from beliefscope._interface import (
        compare,
        diagnose,
        evaluate,
        experiments,
        export_page,
        find_failures,
        finetune,
        healthy_record,
        inspect_run,
        load_filter,
        maps,
        open_dataset,
        record,
        save_dataset,
        serve,
        sweep,
        trace,
    )
    from beliefscope._notebook import show
    from beliefscope.datasets.covariate import Covariate
    from beliefscope.datasets.dataset import Dataset
    from beliefscope.datasets.episode import Episode
    from beliefscope.datasets.errors import BadInput
    from beliefscope.datasets.faults.injection import Faults
    from beliefscope.datasets.task import Component, Task, rotation
    from beliefscope.filters.checkpoint import Checkpoint
    from beliefscope.filters.evaluate import Metrics
    from beliefscope.filters.external.adapter import Adapter
    from beliefscope.inspect.compare.checkpoints import CheckpointComparison
    from beliefscope.inspect.diagnosis.cause import Diagnosis
    from beliefscope.inspect.diagnostics.base import Diagnostic
    from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile
    from beliefscope.inspect.failures.events import Failures
    from beliefscope.inspect.maps.likelihood_map import LikelihoodMap
    from beliefscope.inspect.trace import Trace, load_trace, save_trace
    from beliefscope.recordings.experiments import Experiments
    from beliefscope.recordings.live import LiveRecorder
    from beliefscope.recordings.recorded_diagnosis import diagnose_runs

__version__ = "0.2.0"

_SOURCES = {
    "_interface": (
        *("load_filter", "open_dataset", "save_dataset", "trace", "maps", "inspect_run", "evaluate"),
        *("diagnose", "healthy_record", "find_failures", "finetune", "compare"),
        *("sweep", "experiments", "record", "export_page", "serve"),
    ),
    "_notebook": ("show",),
    "datasets.covariate": ("Covariate",),
    "datasets.dataset": ("Dataset",),
    "datasets.episode": ("Episode",),
    "datasets.errors": ("BadInput",),
    "datasets.faults.injection": ("Faults",),
    "datasets.task": ("Component", "Task", "rotation"),
    "filters.checkpoint": ("Checkpoint",),
    "filters.evaluate": ("Metrics",),
    "filters.external.adapter": ("Adapter",),
    "inspect.compare.checkpoints": ("CheckpointComparison",),
    "inspect.diagnosis.cause": ("Diagnosis",),
    "inspect.diagnostics.base": ("Diagnostic",),
    "inspect.diagnostics.healthy_profile": ("HealthyProfile",),
    "inspect.failures.events": ("Failures",),
    "inspect.maps.likelihood_map": ("LikelihoodMap",),
    "inspect.trace": ("Trace", "load_trace", "save_trace"),
    "recordings.live": ("LiveRecorder",),
    "recordings.recorded_diagnosis": ("diagnose_runs",),
    "recordings.experiments": ("Experiments",),
}
"""Module -> its public names."""

_MODULES = {name: module for module, names in _SOURCES.items() for name in names}

__all__ = [
    "Adapter",
    "BadInput",
    "Checkpoint",
    "CheckpointComparison",
    "Component",
    "Covariate",
    "Dataset",
    "Diagnosis",
    "Diagnostic",
    "Episode",
    "Experiments",
    "Failures",
    "Faults",
    "HealthyProfile",
    "LikelihoodMap",
    "LiveRecorder",
    "Metrics",
    "Task",
    "Trace",
    "__version__",
    "compare",
    "diagnose",
    "diagnose_runs",
    "evaluate",
    "experiments",
    "export_page",
    "find_failures",
    "finetune",
    "healthy_record",
    "inspect_run",
    "load_filter",
    "load_trace",
    "maps",
    "open_dataset",
    "record",
    "rotation",
    "save_dataset",
    "save_trace",
    "serve",
    "show",
    "sweep",
    "trace",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'beliefscope' has no attribute {name!r}")
    value = getattr(import_module(f"beliefscope.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
