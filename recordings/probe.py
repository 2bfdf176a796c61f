"""Metadata of a recording, read in a subprocess."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Mapping
from concurrent.futures import CancelledError
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beliefscope.inspect.traces.file import stored_faults
from beliefscope.recordings.schema import GROWING

TIMEOUT = 300.0  # s per file


@dataclass(frozen=True)
class RecordingInfo:
    """Metadata of a recording.

    Attributes:
        application, title: stored in the file; ``application`` is empty if Rerun cannot read it.
        entities, rows: their numbers.
        problem: reason why no run can be read from the file; empty if one can.
        task ... data_hash: fields of the trace of a Beliefscope recording; ``steps`` is None for a live run.
        edited: whether the run has interventions.
    """

    application: str = ""
    title: str = ""
    entities: int = 0
    rows: int = 0
    problem: str = ""
    task: str | None = None
    filter: str | None = None
    episode: int | None = None
    steps: int | None = None
    seed: int | None = None
    faults: str = ""
    particles: int | None = None
    edited: bool = False
    checkpoint_hash: str = ""
    data_hash: str = ""

    @classmethod
    def from_json(cls, description: Mapping[str, Any], path: Path) -> RecordingInfo:
        """From the output of ``recordings.rerun_log.metadata``. Invalid properties become a ``problem``."""
        if "error" in description:
            return cls(problem=description["error"].removeprefix(f"{path}: "))
        general = {key: description[key] for key in ("application", "title", "entities", "rows", "problem")}
        properties = description["properties"]
        if not properties or general["problem"]:
            return cls(**general)
        try:
            settings = json.loads(properties["settings"])
            faults = properties.get("faults", properties.get("recipe"))  # earlier versions: recipe
            return cls(
                **general,
                task=str(properties["task"]),
                filter=str(properties["filter"]),
                episode=int(properties["episode_index"]),
                steps=None if properties["steps"] == GROWING else int(properties["steps"]),
                seed=int(properties["seed"]),
                faults=str(stored_faults({"settings": settings, "faults": json.loads(faults or "null")})),
                particles=None if settings.get("particles") is None else int(settings["particles"]),
                edited=bool(settings.get("edits")),
                checkpoint_hash=str(properties["checkpoint_hash"]),
                data_hash=str(properties["data_hash"]),
            )
        except (LookupError, ValueError, TypeError, AttributeError, RecursionError, OverflowError) as error:
            return cls(**general | {"problem": f"The properties of this Beliefscope recording are invalid: {error}."})


class RecordingProbe:
    """Reads one file at a time in a subprocess, which contains crashes and excessive use of time and memory."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._closing = False

    def __call__(self, path: Path) -> RecordingInfo:
        """Read the metadata of a file. Raises CancelledError if the probe is closed."""
        command = [sys.executable, "-P", "-m", "beliefscope.recordings.rerun_log.metadata", str(path)]
        with self._lock:
            if self._closing:
                raise CancelledError
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
            )
            with self._process as process:
                try:
                    output = process.communicate(timeout=TIMEOUT)[0]
                except subprocess.TimeoutExpired:
                    process.kill()
                    output = b""
            self._process = None
        if self._closing:
            raise CancelledError
        if process.returncode or not output:
            return RecordingInfo(problem="Reading the file failed or exceeded the limits of time or memory.")
        return RecordingInfo.from_json(json.loads(output), path)

    def close(self) -> None:
        """Stop reading."""
        self._closing = True
        if process := self._process:
            process.kill()
