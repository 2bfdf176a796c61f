"""Filters run in a process of its own: the server answers meanwhile, and outlives whatever becomes of it.

    python -m beliefscope.app.runs.trace_worker

Standard input has one run to be made a line, JSON; standard output tells how far each one is, and how it ended.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import wait
from pathlib import Path
from typing import Any

from beliefscope.app.jobs.worker import NICENESS, PAUSE, how_it_ended, own_output
from beliefscope.datasets.errors import BadInput


class Tracer:
    """The process, kept between runs: reading PyTorch takes it seconds. Another takes its place when it has died.

    ``run`` is for one thread at a time; ``close`` may be called from any other.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._closed = False
        self._process: subprocess.Popen[str] | None = None

    @property
    def started(self) -> bool:
        """Whether there is the process, or was."""
        return self._process is not None

    def start(self) -> None:
        """Starts the process if there is none; it gets itself ready while others work."""
        with self._lock:
            if self._closed:
                raise RuntimeError("the server is stopping")
            if self._process is None or self._process.poll() is not None:
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", __name__],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    text=True,
                    bufsize=1,
                    start_new_session=True,  # Ctrl-C in the terminal is for the server
                )

    def run(
        self, settings: Mapping[str, Any], selection: Mapping[str, Any], path: Path, progress: Callable[[float], None]
    ) -> None:
        """Runs a filter; its trace is the file then.

        Args:
            settings, selection: as ``to_json`` gives them. progress: called with the share done; what it raises ends
                the run.

        Raises BadInput as tracing does, and RuntimeError for anything else that came between, also the process's end.
        """
        self.start()
        process = self._process
        assert process is not None
        assert process.stdin is not None
        assert process.stdout is not None
        ended = None
        try:
            process.stdin.write(json.dumps({"settings": settings, "selection": selection, "path": str(path)}) + "\n")
            for line in process.stdout:
                said = json.loads(line)
                if "progress" not in said:
                    ended = said
                    break
                progress(said["progress"])
        except OSError:
            pass  # it has died
        except BaseException:
            process.kill()
            raise
        if ended is None:
            raise RuntimeError(f"the filter could not be run: its process {how_it_ended(process.wait())}")
        if ended["error"] is not None:
            raise (BadInput if ended["bad"] else RuntimeError)(ended["error"])

    def close(self) -> None:
        """Ends the process, also in the midst of a run."""
        with self._lock:
            self._closed = True
            if self._process is not None:
                self._process.kill()
                self._process.wait()


def main() -> None:
    """Makes runs until standard input ends."""
    from beliefscope.app.runs.trace_store import Library, Selection, Settings
    from beliefscope.inspect.trace import save_trace

    os.nice(NICENESS)
    told = own_output()
    library, shown = None, None
    for line in sys.stdin:
        order = json.loads(line)
        error, bad = None, False
        try:
            if library is None or order["settings"] != shown:
                if library is not None:
                    library.close()
                library, shown = Library(Settings.of_json(order["settings"])), order["settings"]
            traced = library.traced(Selection.of_json(order["selection"]))
            while wait([traced.done], PAUSE).not_done:
                told.write(json.dumps({"progress": traced.progress}) + "\n")
            path = Path(order["path"])
            trace = traced.trace
            if not path.exists():  # of an edit, or of a run that was in memory when somebody deleted its file
                path.parent.mkdir(parents=True, exist_ok=True)
                save_trace(trace, path)
        except BadInput as problem:
            error, bad = str(problem), True
        except Exception as problem:
            error = f"{type(problem).__name__}: {problem}"
        told.write(json.dumps({"error": error, "bad": bad}) + "\n")
    os._exit(0)  # nothing is left to be done, and nobody to wait for it


if __name__ == "__main__":
    main()
