"""``beliefscope evaluate``"""

from __future__ import annotations

import json as json_format
from typing import Annotated

import typer

from beliefscope.app.cli import options as opt
from beliefscope.app.cli import output
from beliefscope.datasets.errors import BadInput


def evaluate(
    task: opt.TaskName,
    filter_: opt.FilterName,
    data: opt.DataPath = None,
    skip_bad: opt.SkipBad = False,
    faults_: opt.FaultsText = "",
    only: Annotated[
        str | None, typer.Option(metavar="MODALITY", help="Use only this modality, overriding the fusion weights.")
    ] = None,
    particles: opt.Particles = 300,
    seed: opt.Seed = 0,
    json: opt.Json = None,
) -> None:
    """Measure the accuracy of a filter on held-out episodes.

    Uses the test episodes; if there are none, the validation episodes or all. Each run starts at the true state with
    covariance 0.1 I in standardised units, and its first 30 steps are excluded. Reports the RMSE; nll, the negative
    log-likelihood of the truth in nats; nees, the normalised estimation error squared per dimension, 1 for a
    calibrated covariance; coverage95, the fraction of steps with the truth inside the 95 % ellipsoid.

    \b
    Examples:
      beliefscope evaluate door --filter crossmodal-pf
      beliefscope evaluate door --filter crossmodal-pf --faults blackout=0.8 --json -
      beliefscope evaluate push-real --filter crossmodal-pf --data mit_push/val
      beliefscope evaluate door --filter crossmodal-pf --faults delay=haptics:steps=5 --only haptics
    """
    from beliefscope.filters.evaluate import evaluate as measure
    from beliefscope.filters.external.load import ExternalFilter

    text, modality = _split_only(opt.read_faults(faults_))
    checkpoint = opt.open_checkpoint(task, filter_)
    faults, only = opt.parse_faults(text, checkpoint.task), only or modality
    with opt.open_episodes(checkpoint.task, data, skip_bad) as episodes, output.progress("Evaluating") as advance:
        held_out = episodes.held_out()
        metrics = measure(
            checkpoint if isinstance(checkpoint, ExternalFilter) else checkpoint.filter,
            [episodes[i] for i in held_out],
            faults=faults,
            only=only,
            particles=particles,
            seed=seed,
            progress=advance,
        ).to_dict()
        data_hash = episodes.hash
    document = {
        "task": task,
        "filter": checkpoint.name,
        "checkpoint_hash": checkpoint.hash,
        "data_hash": data_hash,
        "episodes": len(held_out),
        "faults": faults.to_json(),
        "only": only,
        "particles": particles if checkpoint.kind == "pf" else None,
        "seed": seed,
        **metrics,
    }
    values = {f"rmse {name}": value for name, value in metrics["rmse"].items()}
    values |= {name: value for name, value in metrics.items() if name != "rmse"}
    title = f"{checkpoint.name} ({checkpoint.hash[:12]}) on {len(held_out)} episodes"
    rows = [[name, None if value is None else f"{value:8.2f}"] for name, value in values.items()]
    table = output.grid(title + (f" with {faults}" if faults else ""), ["measure", "value"], rows)
    output.result(document, table, json)


def _split_only(text: str) -> tuple[str, str | None]:
    """Faults without, and value of, the former JSON key ``only``, which older scripts use instead of ``--only``."""
    try:
        value = json_format.loads(text)
    except (ValueError, RecursionError):
        return text, None
    if not isinstance(value, dict) or "only" not in value:
        return text, None
    only = value.pop("only")
    if not isinstance(only, str):
        raise BadInput(f"key 'only' of the faults is {only!r}, not the name of a modality")
    return json_format.dumps(value), only
