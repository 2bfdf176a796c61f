"""What a Rerun file says of itself. It may come from anywhere, so a server has it read in a process of its own.

    python -m beliefscope.recordings.rerun_log.metadata FILE

prints one JSON object: what ``describe`` gives, or ``{"error": one line}``. No memory and no time beyond its limits.
"""

from __future__ import annotations

import json
import resource
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
from rerun.chunk import RrdReader

from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.schema import APPLICATION, EARLIER_PROPERTIES, FORMAT_VERSION, HEADER, PROPERTIES

MEMORY = 4 * 2**30  # bytes of addresses, of which Rerun's libraries alone take 1.7 GB
SECONDS = 120  # of CPU: some 10 GB
TEXT = 200  # characters that are kept of a stranger's names
LEFT_OUT = ("shapes", "episode", "versions", "modalities")  # properties that nobody has to know to list a recording


def describe(path: str | Path) -> dict[str, Any]:
    """What there is to know about a recording without its numbers. Every chunk is read once, one at a time.

    Returns:
        ``application`` and ``title`` as the file names them, ``entities``, ``rows``; ``properties`` of ours, empty for
        a stranger's; ``problem``: why no trace can be read out of it, empty where one can.

    Raises:
        BadInput: not a whole Rerun recording.
    """
    entities: set[str] = set()
    properties: dict[str, Any] = {}
    title, rows = "", 0
    with reading(path) as reader:
        stores = reader.recordings()
        if not stores:
            raise BadInput(f"{path}: a Rerun file without a recording in it.")
        ours = next((store for store in stores if store.application_id == APPLICATION), stores[0])
        for chunk in (chunk for store in stores for chunk in reader.stream(store=store)):
            entities.add(chunk.entity_path)
            rows += chunk.num_rows
            if chunk.entity_path == f"/{HEADER}" and ours.application_id == APPLICATION:
                properties |= properties_of(chunk.to_record_batch())
            elif chunk.entity_path == "/__properties":
                batch = chunk.to_record_batch()
                if "RecordingInfo:name" in batch.schema.names:
                    title = str(_first(batch, "RecordingInfo:name"))
    return {
        "application": ours.application_id[:TEXT],
        "title": title[:TEXT],
        "entities": len(entities),
        "rows": rows,
        "properties": {name: value for name, value in properties.items() if name not in LEFT_OUT},
        "problem": _problem(ours.application_id[:TEXT], properties.get("format_version")),
    }


@contextmanager
def reading(path: str | Path) -> Iterator[RrdReader]:
    """Rerun's reader of a file. What it cannot read within the block is BadInput, in one line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a file without a footer: a live run's, or one that was cut off
            yield RrdReader(path)
    except BadInput:
        raise
    except (RuntimeError, ValueError, LookupError, TypeError) as error:
        reason = "".join(str(error).splitlines()[:1]).split(f"{path}: ")[-1]
        raise BadInput(f"{path}: not a whole Rerun recording ({reason}).") from None


def properties_of(batch: pa.RecordBatch) -> dict[str, Any]:
    """Properties of this schema, and of earlier ones, in a chunk of a recording's header."""
    return {name: _first(batch, name) for name in batch.schema.names if name in (*PROPERTIES, *EARLIER_PROPERTIES)}


def _first(batch: pa.RecordBatch, name: str) -> Any:
    return batch.column(name)[0].as_py()[0]


def _problem(application: str, version: Any) -> str:
    if application != APPLICATION or version is None:
        return f"It was written by {application!r}, not by {APPLICATION}: Rerun shows it, but it holds no run."
    if version != FORMAT_VERSION:
        return f"Its format is {version!r}; this version of {APPLICATION} reads {FORMAT_VERSION}."
    return ""


def main(path: str) -> int:
    """Exit code: 0 where the file could be described or refused in a line."""
    for limit, value in ((resource.RLIMIT_AS, MEMORY), (resource.RLIMIT_CPU, SECONDS)):
        _, most = resource.getrlimit(limit)
        resource.setrlimit(limit, (value if most == resource.RLIM_INFINITY else min(value, most), most))
    try:
        print(json.dumps(describe(path)))
    except BadInput as error:
        print(json.dumps({"error": str(error)}))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
