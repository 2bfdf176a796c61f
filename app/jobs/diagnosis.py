"""Job that diagnoses a filter over episodes of a data set."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from typing import Any

from beliefscope.app.runs.settings import Settings
from beliefscope.app.runs.trace_store import TraceStore
from beliefscope.app.runs.worker import Report
from beliefscope.datasets.faults.injection import Faults
from beliefscope.inspect.diagnosis.diagnose import diagnose
from beliefscope.inspect.diagnostics.views import as_json


def run(arguments: Mapping[str, Any], report: Report) -> Any:
    """Compute the diagnosis; no traces are stored."""
    with closing(TraceStore(Settings.from_json(arguments["settings"]))) as store:
        data = store.dataset(arguments["task"], arguments["data"])[1]
        faults, seed = Faults.parse(arguments["faults"]), store.settings.seed
        report(0.0, "reading the episodes")
        result = diagnose(
            store.checkpoint(arguments["task"], arguments["filter"]),
            {index: faults.apply(data[index], seed) for index in arguments["episodes"]},
            seed=seed,
            particles=store.settings.particles,
            progress=lambda share: report(share, "comparing with the healthy record"),
        )
    return as_json(result.to_json())
