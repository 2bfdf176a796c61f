from collections.abc import Sequence
from pathlib import Path

from beliefscope.app.cli import console, options as opt
from beliefscope.datasets.errors import BadInput


def experiments(
    sweeps: list[Path] = opt.argument("DIR...", "Folders of sweeps; their tables are combined."),
    phase: str = opt.option("NAME", "Steps to compare: all, a group such as contact, or blackout.", "all"),
    sort: str = opt.option("COLUMN", "Column of the overview that ranks the checkpoints, worst first.", "error"),
    top: int = opt.option("N", "Number of rows.", 20, parser=opt.integer(1)),
    sql: str | None = opt.option(
        "QUERY", "Run this SQL query (DuckDB) over the tables results, checkpoints and datasets instead.", None
    ),
    output: Path | None = opt.output_file("FILE", "Write all rows to a file: .csv or .parquet.", ".csv", ".parquet"),
) -> console.Result:
    """Query the results of sweeps.

    Without --sql, compares the checkpoints: pooled RMSE of the position and of each component, NEES/n, NLL, coverage
    and the worst step, by checkpoint and faults, for the steps of one phase. docs/sweep.md lists the columns and ten
    queries.

    \b
    Examples:
      beliefscope experiments sweep --phase contact
      beliefscope experiments sweep --sort nees --top 5 --json -
      beliefscope experiments sweep --sort heading_deg
      beliefscope experiments sweep --sql "SELECT phase, avg(coverage95) FROM results GROUP BY phase"
      beliefscope experiments sweep-a sweep-b -o all.csv
    """
    from beliefscope.recordings.experiments import Experiments, labelled, write_rows

    tables = Experiments(sweeps)
    rows = tables.query(sql) if sql is not None else tables.overview(phase, sort)
    if sql is None and not len(rows):
        raise BadInput(f"no steps in phase {phase!r}. Available: {', '.join(tables.phases())}")
    if output is not None:
        write_rows(rows, output)
    document = {"rows": rows.slice(0, top).to_pylist(), "count": len(rows)}
    if sql is not None:
        return console.Result(document, console.arrow("Results", rows, top), output)
    text = console.arrow(f"Checkpoints, {phase} steps", labelled(rows), top)
    return console.Result(document, text + _provenance_note(tables.provenance_keys()), output)


def _provenance_note(keys: Sequence[str], listed: int = 8) -> str:
    """Line with the entries of the checkpoints' provenance, which the table does not have."""
    if not keys:
        return ""
    names = ", ".join(keys[:listed]) + (f" and {len(keys) - listed} more" if len(keys) > listed else "")
    key = keys[0].replace('"', '""').replace("'", "''")
    example = f"SELECT name, provenance->>'{key}' AS value FROM checkpoints"
    return f'\nNot in this table: {len(keys)} entries of the provenance ({names}). Query: --sql "{example}"'
