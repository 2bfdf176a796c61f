"""What a job's process runs: one function of ours, given JSON, whose result becomes a file (``app/jobs/queue.py``).

    python -m beliefscope.app.jobs.worker MODULE:FUNCTION FOLDER

Standard output carries the reports, one JSON object a line; what the function prints goes to standard error, the log.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_atomically

Report = Callable[[float, str], None]
"""(share done 0..1, what it is doing) -> None; may be called at every step."""

PAUSE = 0.1  # s between reports
NICENESS = 5  # the page goes first


def main(function: str, folder: Path) -> int:
    """Exit code: 0 where the result is written, else 1."""
    os.nice(NICENESS)
    reports = own_output()
    threading.Thread(target=_end_with_the_server, daemon=True).start()
    said = [0.0]

    def tell(**fields: Any) -> None:
        reports.write(json.dumps(fields) + "\n")

    def report(progress: float, message: str) -> None:
        now = time.monotonic()
        if now - said[0] >= PAUSE:
            said[0] = now
            tell(progress=min(max(float(progress), 0.0), 1.0), message=message)

    try:
        tell(message="starting")
        module, _, name = function.partition(":")
        run = getattr(importlib.import_module(module), name)
        result = run(json.loads((folder / "arguments.json").read_bytes()), report)
        write_atomically(folder / "result.json", json.dumps(result, allow_nan=False).encode())
    except BadInput as error:
        tell(error=str(error))
        return 1
    except Exception as error:
        traceback.print_exc()
        wanting = isinstance(error, MemoryError) or "can't allocate memory" in str(error)  # NumPy's, PyTorch's
        tell(error=f"{'it ran out of memory: ' if wanting else ''}{type(error).__name__}: {error}")
        return 1
    return 0


def own_output() -> TextIO:
    """Standard output for ourselves, by lines; what others print from now on goes to standard error."""
    output = os.fdopen(os.dup(sys.stdout.fileno()), "w", buffering=1)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return output


def how_it_ended(code: int) -> str:
    """What the exit code of a process says: "was ended by signal 9 (SIGKILL), perhaps for want of memory"."""
    if code >= 0:
        return f"ended with exit code {code}"
    memory = ", perhaps for want of memory" if -code == signal.SIGKILL else ""
    return f"was ended by signal {-code} ({signal.Signals(-code).name}){memory}"


def _end_with_the_server() -> None:
    # Not sys.stdin: a thread that waits in it when Python ends takes the process down with an abort.
    while os.read(0, 1):
        pass
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], Path(sys.argv[2])))
