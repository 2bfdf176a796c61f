"""Process of a job: runs one function with JSON arguments and writes its JSON result (see ``app/jobs/queue.py``).

    python -m beliefscope.app.jobs.worker MODULE:FUNCTION FOLDER

Reports go to standard output, one JSON object of job fields a line; printed text goes to standard error, the log.
"""

from __future__ import annotations

import importlib
import json
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from beliefscope.app.runs.subprocesses import NICENESS, REPORT_INTERVAL, redirect_stdout
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.atomic_write import write_atomically

Report = Callable[[float, str], None]
"""(share done 0..1, current activity) -> None; may be called at every step."""


def main(function: str, folder: Path) -> int:
    """Run the function. Returns the exit code: 0 if the result is written, else 1."""
    os.nice(NICENESS)
    output = redirect_stdout()
    threading.Thread(target=_exit_with_server, daemon=True).start()
    last_report = 0.0

    def send(**fields: Any) -> None:
        output.write(json.dumps(fields) + "\n")

    def report(progress: float, message: str) -> None:
        nonlocal last_report
        now = time.monotonic()
        if now - last_report >= REPORT_INTERVAL:
            last_report = now
            send(progress=min(max(float(progress), 0.0), 1.0), message=message)

    try:
        send(message="starting")
        module, _, name = function.partition(":")
        run = getattr(importlib.import_module(module), name)
        result = run(json.loads((folder / "arguments.json").read_bytes()), report)
        write_atomically(folder / "result.json", json.dumps(result, allow_nan=False).encode())
    except BadInput as error:
        send(error=str(error))
        return 1
    except Exception as error:
        traceback.print_exc()
        # PyTorch raises RuntimeError when memory is exhausted.
        out_of_memory = isinstance(error, MemoryError) or "can't allocate memory" in str(error)
        send(error=f"{'it ran out of memory: ' if out_of_memory else ''}{type(error).__name__}: {error}")
        return 1
    return 0


def _exit_with_server() -> None:
    # Not sys.stdin: a thread blocked in it at interpreter exit aborts the process.
    while os.read(0, 1):
        pass
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], Path(sys.argv[2])))
