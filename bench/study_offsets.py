"""Evaluate the pretrained filters of a study from offset starts, without training, and write its tables and figures.

    python bench/study_offsets.py

Reads ``filters/pretrained/study.json``, evaluates those of its checkpoints that are in that folder (seed 0) on the test
episodes of the sample sets, from starts 3 cm and 20 deg off, and writes the rows into the file, and tables and figures
into ``docs/study``. Finished evaluations are kept in ``build/study_offsets``, from which an interrupted run resumes.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from beliefscope.app.workspace.studies import BUILT_IN, FILE, Results, Study
from beliefscope.datasets.catalog import find_task
from beliefscope.datasets.io.atomic_write import write_atomically
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.datasets.task import Task
from beliefscope.filters.checkpoint import PRETRAINED, load_checkpoint
from beliefscope.filters.training.study import offset_metrics
from beliefscope.filters.training.study_table import (
    OFFSET,
    TRIVIAL,
    TRUTH,
    Document,
    Row,
    rows_of,
    to_csv,
    to_markdown,
)
from beliefscope.recordings.study_figures import write_results

ROOT = Path(__file__).resolve().parent.parent
PARTIAL = ROOT / "build" / "study_offsets"
TABLES = ROOT / "docs" / "study"
DATA = "the {} test episodes of the sample set"


@dataclass(frozen=True)
class PretrainedCell:
    """A cell of the built-in study (``study_table.Condition``)."""

    task: str
    filter: str
    seed: int

    @property
    def definition(self) -> Task:
        return find_task(self.task)


def offset_rows(results: Results) -> tuple[list[Row], dict[str, str]]:
    """Rows of the offset starts, and the data of each task: their description."""
    documents: dict[PretrainedCell, Document | None] = {}
    data: dict[str, str] = {}
    for name in results.cells:
        task, filter_, seed = name.split("/")
        cell = PretrainedCell(task, filter_, int(seed.removeprefix("seed")))
        documents[cell] = _document(cell, results.checkpoints.get(name))
        if (document := documents[cell]) is not None:
            data[task] = DATA.format(document["episodes"]["test"])
    return [row for row in rows_of(documents) if row.filter != TRIVIAL], data


def _document(cell: PretrainedCell, checkpoint_hash: str | None) -> Document | None:
    """The evaluation of a pretrained checkpoint in the form of a cell's document; None if there is none."""
    path = PRETRAINED / f"{cell.task}-{cell.filter}.safetensors"
    if not path.is_file() or (checkpoint := load_checkpoint(path)).hash != checkpoint_hash:
        return None
    partial = PARTIAL / f"{checkpoint_hash}.json"
    if partial.is_file():
        return dict(json.loads(partial.read_text()))
    with open_dataset(sample_path(cell.task)) as dataset:
        episodes = [dataset[index] for index in dataset.held_out()]
    document = {
        "seed": cell.seed,
        "seconds": checkpoint.record["seconds"],
        "trivial": {},
        "episodes": {"test": len(episodes)},
        TRUTH: {},
        OFFSET: offset_metrics(checkpoint.filter, episodes),
    }
    PARTIAL.mkdir(parents=True, exist_ok=True)
    write_atomically(partial, json.dumps(document).encode())
    print(f"{cell.task}/{cell.filter}", flush=True)
    return document


def main() -> None:
    study = Study(BUILT_IN, PRETRAINED, False)
    results = study.read()
    offsets, data = offset_rows(results)
    at_truth = [row for row in results.rows if not row.start]
    rows = [row for task in results.tasks for part in (offsets, at_truth) for row in part if row.task == task]
    document = json.loads((study.folder / FILE).read_text()) | {"rows": [asdict(row) for row in rows]}
    for task, description in data.items():
        document["tasks"][task]["offset_data"] = description
    write_atomically(study.folder / FILE, json.dumps(document, indent=1).encode())
    write_atomically(TABLES / "table.md", to_markdown(rows).encode())
    write_atomically(TABLES / "table.csv", to_csv(rows).encode())
    write_results(rows, TABLES)


if __name__ == "__main__":
    main()
