"""What a recording says of itself: all that lists, finds and opens it. Read in a process of its own."""

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

from beliefscope.inspect.trace import stored_faults
from beliefscope.recordings.schema import GROWING

PATIENCE = 300.0  # s that a file is read for at most


@dataclass(frozen=True)
class About:
    """What a recording says of itself: all that lists, finds and opens it.

    Attributes:
        application, title: as the file has them. entities, rows: how many.
        problem: why no run can be read out of it; empty where one can. Of a file that Rerun cannot read either,
            ``application`` is empty.
        task ... data_hash: of the trace, where it is one of ours; ``faults`` as text, ``steps`` None of a live run.
        edited: whether some steps of the run were changed by hand.
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
    def of(cls, described: Mapping[str, Any], path: Path) -> About:
        """Of what ``recordings.describe`` says. What should be ours and cannot be understood is a problem."""
        if "error" in described:
            return cls(problem=described["error"].removeprefix(f"{path}: "))
        said = {key: described[key] for key in ("application", "title", "entities", "rows", "problem")}
        properties = described["properties"]
        if not properties or said["problem"]:
            return cls(**said)
        try:
            settings = json.loads(properties["settings"])
            stored = properties.get("faults", properties.get("recipe"))
            return cls(
                **said,
                task=str(properties["task"]),
                filter=str(properties["filter"]),
                episode=int(properties["episode_index"]),
                steps=None if properties["steps"] == GROWING else int(properties["steps"]),
                seed=int(properties["seed"]),
                faults=str(stored_faults({"settings": settings, "faults": json.loads(stored or "null")})),
                particles=None if settings.get("particles") is None else int(settings["particles"]),
                edited=bool(settings.get("edits")),
                checkpoint_hash=str(properties["checkpoint_hash"]),
                data_hash=str(properties["data_hash"]),
            )
        except (LookupError, ValueError, TypeError, AttributeError, RecursionError, OverflowError) as error:
            return cls(**said | {"problem": f"It says that it is ours, but not of what: {error}."})


class Reader:
    """Reads files one at a time. A file made to do harm ends its process, by a crash or at its limits, and no more."""

    def __init__(self) -> None:
        self._one = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._closing = False

    def __call__(self, path: Path) -> About:
        """Raises CancelledError where it is closed."""
        command = [sys.executable, "-P", "-m", "beliefscope.recordings.rerun_log.metadata", str(path)]
        with self._one:
            if self._closing:
                raise CancelledError
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
            )
            with self._process as process:
                try:
                    said = process.communicate(timeout=PATIENCE)[0]
                except subprocess.TimeoutExpired:
                    process.kill()
                    said = b""
            self._process = None
        if self._closing:
            raise CancelledError
        if process.returncode or not said:
            return About(problem="Reading it failed, or took more time or memory than a recording may.")
        return About.of(json.loads(said), path)

    def close(self) -> None:
        """Gives up what is being read."""
        self._closing = True
        if process := self._process:
            process.kill()
