"""``beliefscope evaluate``"""

from __future__ import annotations

import json as json_format
from pathlib import Path
from typing import Annotated, Any

import typer

from beliefscope.app import console
from beliefscope.app.commands.given import (
    DataPath,
    FilterName,
    Json,
    Particles,
    Seed,
    TaskName,
    check,
    checkpoint,
    dataset,
)
from beliefscope.datasets.errors import BadInput

RECIPE = {"blackout": "number", "only": "string"}
"""Key of a recipe -> what JSON calls its value."""


def evaluate(
    task: TaskName,
    filter_: FilterName,
    data: DataPath = None,
    recipe: Annotated[
        str,
        typer.Option(
            "--recipe",
            metavar="JSON",
            help='What the filter is put through; JSON or a file of it. {"blackout": 0.4} blacks out that share of '
            'the pictures, {"only": "image"} lets one modality decide alone.',
        ),
    ] = "{}",
    particles: Particles = 300,
    seed: Seed = 0,
    json: Json = None,
) -> None:
    """Measure a filter on held-out episodes.

    On the episodes that are kept for tests; on all, where none are. Each starts at the true state with covariance
    0.1 I in standardised units, and its first 30 steps do not count. Over all other steps: RMSE; nll, the negative
    log-likelihood of the truth in nats; nees, the normalised squared error, 1 where the covariance is right;
    coverage95, the share of steps whose truth lies within the 95 % ellipsoid.

    \b
    Examples:
      beliefscope evaluate door --filter crossmodal-pf
      beliefscope evaluate door --filter crossmodal-pf --recipe '{"blackout": 0.8}' --json -
    """
    from beliefscope.filters.evaluate import evaluate as measure

    check(None, json)
    options = read_recipe(recipe)
    tested = checkpoint(task, filter_)
    with dataset(tested.task, data) as episodes, console.progress("Evaluating") as advance:
        held_out = [s.index for s in episodes.summaries if s.split == "test"] or list(range(len(episodes)))
        metrics = measure(
            tested.filter,
            [episodes[i] for i in held_out],
            **options,
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
        "recipe": options,
        "particles": particles if tested.kind == "pf" else None,
        "seed": seed,
        **metrics,
    }
    rows = {f"rmse {name}": value for name, value in metrics["rmse"].items()}
    rows |= {name: value for name, value in metrics.items() if name != "rmse"}
    text = console.table({name: f"{value:.2f}" for name, value in rows.items()})
    console.result(document, f"{tested.name} ({tested.hash[:12]}) on {len(held_out)} episodes\n{text}", json)


def read_recipe(text: str) -> dict[str, Any]:
    """The keyword arguments of ``filters.evaluate.evaluate`` that a recipe, or a file of one, stands for."""
    if not text.lstrip().startswith("{"):
        try:
            text = Path(text).read_text()
        except (OSError, UnicodeDecodeError):
            raise BadInput(f"recipe {text!r} is neither a JSON object nor a file of one") from None
    try:
        recipe = json_format.loads(text)
    except json_format.JSONDecodeError as error:
        raise BadInput(f"recipe is not JSON: {error}") from None
    if not isinstance(recipe, dict):
        raise BadInput(f"recipe is {recipe!r}, not a JSON object")
    for key, value in recipe.items():
        if key not in RECIPE:
            raise BadInput(f"recipe has the key {key!r}. Available: {', '.join(RECIPE)}.")
        fits = isinstance(value, str) if RECIPE[key] == "string" else type(value) in (int, float)
        if not fits:
            raise BadInput(f"recipe's {key!r} is {value!r}, not a {RECIPE[key]}")
    if not 0.0 <= recipe.get("blackout", 0.0) <= 1.0:
        raise BadInput(f"recipe's 'blackout' is {recipe['blackout']}, not a share between 0 and 1")
    return recipe
