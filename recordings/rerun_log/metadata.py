"""Metadata of a Rerun file. Files may be untrusted, so a server reads them in a separate process.

    python -m beliefscope.recordings.rerun_log.metadata FILE

prints one JSON object: the result of ``describe``, or ``{"error": message}``. Memory and CPU time are limited.
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

MEMORY = 4 * 2**30  # bytes of address space; Rerun's libraries use 1.7 GB
SECONDS = 120  # of CPU time, enough for about 10 GB
TEXT = 200  # maximum length of names from the file
OMITTED = ("definition", "shapes", "episode", "versions", "modalities")  # properties not needed to list a recording


def describe(path: str | Path) -> dict[str, Any]:
    """Describe a recording without its arrays. Reads every chunk once, one at a time; those of other programs fully.

    Returns:
        ``application`` and ``title`` from the file; numbers of ``entities`` and ``rows``; ``properties`` of a
        Beliefscope recording, else empty; ``problem``: the reason why it contains no readable trace, or empty.

    Raises:
        BadInput: not a complete Rerun recording.
    """
    entities: set[str] = set()
    properties: dict[str, Any] = {}
    title, rows = "", 0
    with reading(path) as reader:
        stores = reader.recordings()
        if not stores:
            raise BadInput(f"{path}: a Rerun file without a recording.")
        selected = next((store for store in stores if store.application_id == APPLICATION), stores[0])
        for chunk in (chunk for store in stores for chunk in reader.stream(store=store)):
            entities.add(chunk.entity_path)
            rows += chunk.num_rows
            if selected.application_id != APPLICATION:
                chunk.to_record_batch()  # as the import of logs does; may crash
            if chunk.entity_path == f"/{HEADER}" and selected.application_id == APPLICATION:
                properties |= properties_of(chunk.to_record_batch())
            elif chunk.entity_path == "/__properties":
                batch = chunk.to_record_batch()
                if "RecordingInfo:name" in batch.schema.names:
                    title = str(_first(batch, "RecordingInfo:name"))
    return {
        "application": selected.application_id[:TEXT],
        "title": title[:TEXT],
        "entities": len(entities),
        "rows": rows,
        "properties": {name: value for name, value in properties.items() if name not in OMITTED},
        "problem": _problem(selected.application_id[:TEXT], properties.get("format_version")),
    }


@contextmanager
def reading(path: str | Path) -> Iterator[RrdReader]:
    """Yields Rerun's reader of a file. Its errors within the block are raised as BadInput with one line."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about missing footers of live or truncated files
            yield RrdReader(path)
    except BadInput:
        raise
    except (RuntimeError, ValueError, LookupError, TypeError) as error:
        reason = "".join(str(error).splitlines()[:1]).split(f"{path}: ")[-1]
        raise BadInput(f"{path}: not a complete Rerun recording ({reason}).") from None


def properties_of(batch: pa.RecordBatch) -> dict[str, Any]:
    """Properties of this schema and earlier versions in a chunk of the header."""
    return {name: _first(batch, name) for name in batch.schema.names if name in (*PROPERTIES, *EARLIER_PROPERTIES)}


def _first(batch: pa.RecordBatch, name: str) -> Any:
    return batch.column(name)[0].as_py()[0]


def _problem(application: str, version: Any) -> str:
    if application != APPLICATION or version is None:
        return f"Written by {application!r}, not by {APPLICATION}: viewable in Rerun, but without a trace."
    if version != FORMAT_VERSION:
        return f"Format {version!r}; this version of {APPLICATION} reads {FORMAT_VERSION}."
    return ""


def main(path: str) -> int:
    """Print the metadata or the error. Returns the exit code."""
    for limit, value in ((resource.RLIMIT_AS, MEMORY), (resource.RLIMIT_CPU, SECONDS)):
        _, hard = resource.getrlimit(limit)
        resource.setrlimit(limit, (value if hard == resource.RLIM_INFINITY else min(value, hard), hard))
    try:
        print(json.dumps(describe(path)))
    except BadInput as error:
        print(json.dumps({"error": str(error)}))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
