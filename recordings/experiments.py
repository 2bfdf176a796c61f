"""Queries of the tables of sweeps, and their results as files."""

from __future__ import annotations

import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa
from pyarrow import csv

from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.faults.injection import read_faults
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.notebook_html import html_paragraph, html_table
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.checkpoint import load_checkpoint
from beliefscope.filters.names import is_code
from beliefscope.inspect.trace import Trace, trace
from beliefscope.recordings.sweep_table import CHECKPOINTS, DATASETS, INTEGERS, RESULTS, TABLES, TEXTS, write_table

OVERVIEW = {
    "name": "any_value(c.name)",
    "filter": "any_value(c.filter)",
    "task": "any_value(r.task)",
    "faults": "r.faults",
    "episodes": "count(DISTINCT r.episode)",
    "steps": "sum(r.steps)::BIGINT",
    "error": "sqrt(sum(r.steps * r.error ** 2) / sum(r.steps))",
    "unit": "any_value(r.unit)",
    "nees": "sum(r.steps * r.nees) / sum(r.steps)",
    "nll": "sum(r.steps * r.nll) / sum(r.steps)",
    "coverage95": "sum(r.steps * r.coverage95) / sum(r.steps)",
    "worst": "max(r.worst)",
    "worst_episode": "arg_max(r.episode, r.worst)",
    "worst_step": "arg_max(r.worst_step, r.worst)",
    "worst_time": "arg_max_null(r.worst_time, r.worst)",
    "checkpoint": "r.checkpoint",
    "data": "r.data",
    "training": "any_value(json_object('data', c.training->>'data_hash', 'plan', c.training->'plan', 'blackouts', "
    "c.training->'blackouts', 'faults', c.training->'faults', 'finetuned', c.training->'base'->'settings'))",
    "provenance": "any_value(c.provenance)",
}
"""Column of the overview -> its expression; those of the components of the states follow ``unit``."""

MEASURES = frozenset({"error", "worst", "worst_time", "nees", "nll", "coverage95", "ess"})
"""Columns of the results with numbers of each step that are no errors of components."""

DOCUMENTS = ["training", "provenance"]
"""Columns of the overview with JSON documents, which a table for reading leaves out."""

SHOWN = 20
"""Rows of the overview in a notebook and after a sweep."""

KEYS = {
    RESULTS: "checkpoint, data, faults, seed, particles, episode, phase",
    CHECKPOINTS: "checkpoint",
    DATASETS: "data",
}
"""Columns that identify a row of a table."""

ASCENDING = ("name", "filter", "task", "faults", "unit", "coverage95")
"""Columns of the overview that are sorted in ascending order: texts, and one whose low values are bad."""


def as_csv(rows: pa.Table) -> bytes:
    """A table as CSV with a header."""
    data = io.BytesIO()
    csv.write_csv(rows, data)
    return data.getvalue()


def write_rows(rows: pa.Table, path: Path) -> None:
    """Write a table as ``.csv`` or ``.parquet``. Raises BadInput for columns that such a file cannot have."""
    try:
        if path.suffix == ".csv":
            write_atomically(path, as_csv(rows))
        else:
            write_table(rows, path)
    except pa.ArrowException as error:
        raise BadInput(f"cannot write {str(path)!r}: {error}; cast the columns in the query") from None


class Experiments:
    """SQL queries over the ``TABLES`` of one or several sweeps.

    The queries can read the tables of the sweeps, and no other file.
    """

    def __init__(self, folders: Iterable[Path]) -> None:
        """Rows that several sweeps have are counted once.

        Raises BadInput for a folder without results, and for damaged ones.
        """
        self.folders = tuple(dict.fromkeys(Path(folder).resolve() for folder in folders))
        self._check_files()
        self._database = duckdb.connect(config={"autoinstall_known_extensions": False})
        for table in TABLES:
            files = [str(folder / f"{table}.parquet") for folder in self.folders]
            try:
                rows = self._database.read_parquet(files, union_by_name=True)
                if table == RESULTS and "worst_time" not in rows.columns:  # of earlier versions
                    rows = rows.project("*, NULL::DOUBLE AS worst_time")
                if len(self.folders) > 1 or table != RESULTS:  # costs time in a large table
                    rows = self._database.sql(f"SELECT DISTINCT ON ({KEYS[table]}) * FROM rows")
                rows.create_view(table)
            except duckdb.Error as error:
                raise BadInput(
                    f"damaged results of a sweep: {error}; delete this file and run the sweep again, which keeps the "
                    "finished cells"
                ) from None
        paths = [str(folder) for folder in self.folders]
        self._database.execute(f"SET allowed_directories={paths}")
        self._database.execute("SET enable_external_access=false")
        self._database.execute("SET lock_configuration=true")

    def _check_files(self) -> None:
        """Raise BadInput with the first missing file and the next step."""
        for folder in self.folders:
            command = f"beliefscope sweep --checkpoints ... -o {folder}"
            for table in TABLES:
                if (folder / f"{table}.parquet").is_file():
                    continue
                if table == RESULTS:
                    missing = f"{table}.parquet is missing" if folder.is_dir() else "there is no such folder"
                    raise BadInput(f"{folder} has no results of a sweep: {missing}; write them: {command}")
                raise BadInput(
                    f"{folder} has results of a sweep, but {table}.parquet is missing; run the sweep again, which "
                    f"keeps the finished cells: {command}"
                )

    def _rows(self, sql: str, parameters: Sequence[Any] = ()) -> list[tuple[Any, ...]]:
        """The rows of a query of this class. Raises BadInput for a file that was deleted since they were opened."""
        try:
            return self._database.execute(sql, parameters).fetchall()
        except duckdb.Error:
            self._check_files()
            raise

    def __repr__(self) -> str:
        """One line: size of the table of results, number of checkpoints and data sets, and folders."""
        ((rows, checkpoints, sets),) = self._rows(f"SELECT {', '.join(f'(SELECT count() FROM {t})' for t in TABLES)}")
        columns = len(self._database.table(RESULTS).columns)
        counts = f"{rows} rows of {columns} columns, checkpoints: {checkpoints}, data sets: {sets}"
        return f"<Experiments: {counts}, in {', '.join(map(str, self.folders))}>"

    def _repr_html_(self) -> str:
        """That line and the first ``SHOWN`` rows of the overview, in a notebook."""
        rows = labelled(self.overview()).drop_columns(["checkpoint", "data"]).slice(0, SHOWN)
        return html_paragraph(repr(self)[1:-1], strong=True) + html_table(
            f"Largest errors, at most {SHOWN} rows", rows.column_names, [row.values() for row in rows.to_pylist()]
        )

    def query(self, sql: str, parameters: Sequence[Any] = ()) -> pa.Table:
        """The result of a query. Raises BadInput with the message of the database, or with a deleted file."""
        try:
            if len(self._database.extract_statements(sql)) > 1:
                raise BadInput(f"query {sql!r} has several statements, expected one SELECT.")
            relation = self._database.sql(sql, params=list(parameters))
        except duckdb.Error as error:
            self._check_files()
            raise BadInput(f"query {sql!r}: {str(error).strip()}") from None
        if relation is None:  # no statement, or one without a result
            raise BadInput(f"query {sql!r} has no result; write one that starts with SELECT")
        if equal := sorted({name for name in relation.columns if relation.columns.count(name) > 1}):
            raise BadInput(f"query {sql!r}: several columns are named {', '.join(equal)}; rename them with AS")
        return relation.to_arrow_table()

    def overview(self, phase: str = "all", sort: str = "error") -> pa.Table:
        """Results of each checkpoint, data set and faults in a phase, the worst values of the column ``sort`` first.

        Errors, also of the components of the states, are pooled over steps: ``sqrt(sum(steps error^2) / sum(steps))``;
        NEES, NLL and coverage are averages over steps. Raises BadInput for an unknown column.
        """
        columns: dict[str, str] = {}
        for name, expression in OVERVIEW.items():
            columns[name] = expression
            if name == "unit":
                columns |= {
                    key: f"sqrt(sum(r.steps * r.{_quoted(key)} ** 2) / sum(r.steps))" for key in self.components()
                }
        check_name("column of the overview", sort, columns)
        direction = "ASC" if sort in ASCENDING else "DESC"
        return self.query(
            f"SELECT {', '.join(f'{expression} AS {_quoted(name)}' for name, expression in columns.items())} "
            f"FROM {RESULTS} r JOIN {CHECKPOINTS} c USING (checkpoint) "
            "WHERE r.phase = ? GROUP BY r.checkpoint, r.data, r.faults "
            f"ORDER BY {_quoted(sort)} {direction} NULLS LAST, name, checkpoint, data, faults",
            [phase],
        )

    def components(self) -> list[str]:
        """Columns of the results with the errors of components of the states, such as ``hinge_x_cm``."""
        columns = self._database.table(RESULTS).columns
        other = TEXTS | INTEGERS | MEASURES
        return [name for name in columns if name not in other and not name.startswith(("beta_", "weight_"))]

    def phases(self) -> list[str]:
        """Names of the phases of all results."""
        return [name for (name,) in self._rows(f"SELECT DISTINCT phase FROM {RESULTS} ORDER BY 1")]

    def provenance_keys(self) -> list[str]:
        """Keys of the provenance of all checkpoints, in alphabetical order."""
        keys = f"SELECT DISTINCT unnest(json_keys(provenance)) FROM {CHECKPOINTS} ORDER BY 1"
        return [name for (name,) in self._rows(keys)]

    def episodes(self, checkpoint: str, data: str, faults: str = "", phase: str = "all") -> pa.Table:
        """The results of one checkpoint by episode and seed, largest error first."""
        return self.query(
            f"SELECT episode, seed, policy, steps, error, unit, worst, worst_step, worst_time, nees FROM {RESULTS} "
            "WHERE checkpoint = ? AND data = ? AND faults = ? AND phase = ? ORDER BY error DESC, episode, seed",
            [checkpoint, data, faults, phase],
        )

    def trace(self, row: Mapping[str, Any]) -> Trace:
        """Run the filter of a row of the results again.

        Args:
            row: at least ``checkpoint`` and ``data`` (hashes), ``episode``, ``faults`` and ``seed``.

        Raises BadInput if a file is missing or was changed.
        """
        checkpoint = load_checkpoint(self.path(CHECKPOINTS, "checkpoint", row["checkpoint"]))
        if checkpoint.hash != row["checkpoint"]:
            raise BadInput(f"the checkpoint with hash {row['checkpoint'][:12]} was changed after the sweep")
        path = self.path(DATASETS, "data", row["data"])
        with open_dataset(path, checkpoint.task) as data:
            if data.hash != row["data"]:
                raise BadInput(f"{path} was changed after the sweep")
            faults, particles = read_faults(row["faults"], data.task), row.get("particles") or 300
            return trace(checkpoint, data[row["episode"]], row["episode"], row["seed"], particles, faults)

    def path(self, table: str, column: str, value: str) -> Path:
        """File of a checkpoint or data set with this hash.

        Raises BadInput for an unknown hash, a missing file and an external filter: tables cannot name code to run.
        """
        rows = self._rows(f"SELECT path FROM {table} WHERE {column} = ?", [value])
        if not rows:
            raise BadInput(f"no {column} with hash {value[:12]} in these sweeps")
        path = Path(rows[0][0])
        if is_code(str(path)):
            raise BadInput(
                f"{path} is an external filter, which a table cannot run; name it yourself: beliefscope serve --filter "
                f"{path}, or beliefscope trace TASK --filter {path}"
            )
        if not path.exists():
            raise BadInput(f"{column} {str(path)!r} was deleted or moved after the sweep; move it back")
        return path


def _quoted(column: str) -> str:
    return '"' + column.replace('"', '""') + '"'


def labelled(overview: pa.Table) -> pa.Table:
    """The overview as a table for reading: without JSON documents, and with NEES/n and NLL in their usual spelling."""
    rows = overview.drop_columns(DOCUMENTS)
    titles = {"nees": "NEES/n", "nll": "NLL"}
    return rows.rename_columns([titles.get(name, name) for name in rows.column_names])
