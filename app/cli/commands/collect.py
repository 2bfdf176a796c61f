from pathlib import Path

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.text import percent, plural


def collect(
    task: str,
    output: Path = opt.DATASET,
    episodes: int | None = opt.option(
        "N",
        "Number of episodes. Default as in the paper: door 600, push 1000; others 100.",
        None,
        parser=opt.integer(1),
    ),
    steps: int | None = opt.option(
        "T",
        "Number of steps of 0.1 s per episode. Default as in the paper: door 800, push 250; others 200.",
        None,
        parser=opt.integer(2),
    ),
    workers: int | None = opt.option(
        "W", "Number of processes. Default: one per CPU core.", None, parser=opt.integer(1)
    ),
    seed: int = 0,
    split: str | None = opt.option(
        "NAME", "Split of all episodes: train, val or test. Default: by episode number.", None
    ),
    without: list[str] | None = opt.option(
        "INGREDIENT", "Ingredient of a field task to switch off (docs/field_tasks.md). Repeatable.", None
    ),
) -> console.Result:
    """Simulate episodes and write them to an HDF5 file.

    The same seed gives the same data with any number of workers. An interrupted run resumes when the same command is
    run again. Of every ten episodes, eight are for training, one for validation and one for testing, unless --split is
    given. For door and push, the output compares the statistics of the data set with the paper's.

    \b
    Examples:
      beliefscope collect door --episodes 60 --steps 800 --seed 0 -o door.h5
      beliefscope collect door --episodes 50 --steps 100 --seed 2 --split test -o test.h5
      beliefscope collect push-field --episodes 300 --steps 200 --without outages --without nudges -o field.h5
    """
    from beliefscope.datasets.catalog import load_task
    from beliefscope.datasets.dataset_statistics import PAPER_DATA, comparison_table, default_size, statistics
    from beliefscope.datasets.simulation.collect import collect as simulate
    from beliefscope.datasets.store import open_dataset
    from beliefscope.inspect.diagnostics.views import format_table

    name = load_task(task).name
    count, length = (value or default for value, default in zip((episodes, steps), default_size(name), strict=True))
    with console.progress(f"Simulating {name}") as advance:
        simulate(
            task, count, length, seed, workers, output, lambda done, total: advance(done / total), split, without or ()
        )
    with open_dataset(output) as data:
        ours, paper = statistics(data.task, data), PAPER_DATA[name].statistics if name in PAPER_DATA else {}
        document = {
            "task": name,
            "episodes": len(data),
            "steps": length,
            "seed": seed,
            "without": without or [],
            "contact_fraction": ours["contact_fraction"],
            "statistics": ours,
            "authors": paper,
            "data_hash": data.hash,
        }
    contact = ours["contact_fraction"]
    assert isinstance(contact, float)
    summary = f"{plural(count, 'episode')} of {length} steps, {percent(contact)} in contact"
    table = format_table("Statistics over all steps", *comparison_table(ours, paper))
    return console.Result(document, f"{summary}\n\n{table}", output)
