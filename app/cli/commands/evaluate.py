from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.text import plural


def evaluate(
    runs: opt.Runs,
    only: str | None = opt.option(
        "MODALITY", "Run the standalone filter of this modality: the observations of all others are masked.", None
    ),
    start_offset: str = opt.option(
        "OFFSET", "Distance of the first belief from the true state, in a random direction, such as 3cm,20deg.", ""
    ),
    align: bool = False,
    engine: opt.Engine = "local",
    workers: int = 1,
) -> console.Result:
    """Measure the accuracy of a filter on held-out episodes.

    Uses the test episodes; if there are none, the validation episodes or all. Each run starts at the true state with
    covariance 0.1 I in standardised units, or at --start-offset with the covariance of such offsets; runs of field
    tasks start at an offset from the truth. Warns if the data differ from the training data.

    Reports the RMSE without the first 30 steps (field tasks: of all steps; your own task: without Task.warmup steps),
    from step 0, before and after the first contact; NLL, the negative log-likelihood of the truth in nats; NEES/n,
    the normalised estimation error squared per dimension, 1 for a calibrated covariance; 95 % coverage, the fraction of
    steps with the truth inside the 95 % ellipsoid. Two baselines run from the same start: stay keeps the start as its
    estimate; dynamics is the filter with all observations masked, which an external filter does not support.

    Each modality has two errors: of its update, the fused filter's prior of each step updated with this modality only;
    and standalone, of the same filter and random numbers with the observations of all other modalities masked in every
    step.

    \b
    Examples:
      beliefscope evaluate door --filter crossmodal-pf
      beliefscope evaluate door --filter crossmodal-pf --start-offset 3cm,20deg
      beliefscope evaluate door --filter crossmodal-pf --faults blackout=0.8 --json -
      beliefscope evaluate door --filter mine.safetensors --data door.h5 --workers 8
      beliefscope evaluate push-real --filter crossmodal-pf --data mit_push/val
      beliefscope evaluate door --filter crossmodal-pf --faults delay=haptics:steps=5 --only haptics
    """
    opt.prepare_workers(engine, workers, "beliefscope.filters.evaluate")
    from beliefscope.filters.evaluate import evaluate as measure
    from beliefscope.filters.external.load import ExternalFilter
    from beliefscope.filters.start_offset import StartOffset
    from beliefscope.inspect.accuracy_tables import accuracy_tables
    from beliefscope.inspect.standalone import check_standalone, removal_note

    checkpoint, faults = runs.open()
    if only is not None:
        check_standalone(checkpoint, only)
    offset = StartOffset.parse(start_offset, checkpoint.task)
    with runs.episodes(checkpoint.task) as data:
        data_hash, held_out = data.hash, runs.check(checkpoint, [data[i] for i in data.held_out()], align)
    with console.progress("Evaluating") as advance:
        metrics = measure(
            checkpoint if isinstance(checkpoint, ExternalFilter) else checkpoint.filter,
            held_out,
            **runs.settings(faults),
            only=only,
            start_offset=offset,
            baselines=True,
            modalities=only is None,
            engine=engine,
            workers=workers,
            progress=advance,
        ).to_dict()
    document = {
        "task": runs.task,
        "filter": checkpoint.name,
        "checkpoint_hash": checkpoint.hash,
        "data_hash": data_hash,
        "episodes": len(held_out),
        "faults": faults.to_json(),
        "only": only,
        "particles": runs.particles if checkpoint.kind == "pf" else None,
        "seed": runs.seed,
        "start_offset": dict(offset.lengths),
        **metrics,
    }
    title = f"{checkpoint.name} ({checkpoint.hash[:12]}) on {plural(len(held_out), 'episode')}"
    title += (f", start offset {offset}" if offset else "") + (f", with {faults}" if faults else "")
    text = "\n\n".join([*map(str, accuracy_tables(title, metrics)), removal_note(checkpoint)]).strip()
    return console.Result(document, text)
