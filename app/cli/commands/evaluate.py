"""``beliefscope evaluate``"""

from __future__ import annotations

import json as json_format
from typing import Annotated

import typer

from beliefscope.app.cli import output
from beliefscope.app.cli.options import (
    DataPath,
    FaultsText,
    FilterName,
    Json,
    Particles,
    Seed,
    SkipBad,
    TaskName,
    check,
    checkpoint,
    dataset,
    faults,
    faults_text,
)
from beliefscope.datasets.errors import BadInput


def evaluate(
    task: TaskName,
    filter_: FilterName,
    data: DataPath = None,
    skip_bad: SkipBad = False,
    faults_: FaultsText = "",
    only: Annotated[
        str | None,
        typer.Option("--only", metavar="MODALITY", help="Let one modality decide alone, whatever the weights say."),
    ] = None,
    particles: Particles = 300,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Measure a filter on held-out episodes.

    On the episodes kept for tests; on those for validation, or all, where there are none. Each starts at the true state
    with covariance 0.1 I in standardised units, and its first 30 steps do not count. Over all other steps: RMSE; nll,
    the negative log-likelihood of the truth in nats; nees, the normalised squared error, 1 where the covariance is
    right; coverage95, the share of steps whose truth lies within the 95 % ellipsoid.

    \b
    Examples:
      beliefscope evaluate door --filter crossmodal-pf
      beliefscope evaluate door --filter crossmodal-pf --faults blackout=0.8 --json -
      beliefscope evaluate push-real --filter crossmodal-pf --data mit_push/val
      beliefscope evaluate door --filter crossmodal-pf --faults delay=haptics:steps=5 --only haptics
    """
    from beliefscope.filters.evaluate import evaluate as measure
    from beliefscope.filters.external.load import Foreign

    check(None, json)
    text, alone = without_only(faults_text(faults_))
    tested = checkpoint(task, filter_)
    broken, only = faults(text, tested.task), only or alone
    with dataset(tested.task, data, skip_bad) as episodes, output.progress("Evaluating") as advance:
        held_out = episodes.held_out()
        metrics = measure(
            tested if isinstance(tested, Foreign) else tested.filter,
            [episodes[i] for i in held_out],
            faults=broken,
            only=only,
            particles=particles,
            seed=seed,
            progress=advance,
        ).to_dict()
        data_hash = episodes.hash
    document = {
        "task": task,
        "filter": tested.name,
        "checkpoint_hash": tested.hash,
        "data_hash": data_hash,
        "episodes": len(held_out),
        "faults": broken.to_json(),
        "only": only,
        "particles": particles if tested.kind == "pf" else None,
        "seed": seed,
        **metrics,
    }
    rows = {f"rmse {name}": value for name, value in metrics["rmse"].items()}
    rows |= {name: value for name, value in metrics.items() if name != "rmse"}
    table = output.table({name: "none" if value is None else f"{value:.2f}" for name, value in rows.items()})
    what = f"{tested.name} ({tested.hash[:12]}) on {len(held_out)} episodes" + (f" with {broken}" if broken else "")
    output.result(document, f"{what}\n{table}", json)


def without_only(text: str) -> tuple[str, str | None]:
    """A faults, and the modality of ``--only``, which older scripts name in the faults: ``{"only": "image"}``."""
    try:
        value = json_format.loads(text)
    except (ValueError, RecursionError):
        return text, None
    if not isinstance(value, dict) or "only" not in value:
        return text, None
    only = value.pop("only")
    if not isinstance(only, str):
        raise BadInput(f"faults's 'only' is {only!r}, not a modality's name")
    return json_format.dumps(value), only
