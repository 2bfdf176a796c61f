"""Worker processes: they run functions of this project for the server, which stays responsive and survives a crash.

    python -m beliefscope.app.runs.worker MODULE

Standard input carries calls of functions of the module, one JSON array a line; standard output their progress and
outcome. Printed text goes to standard error.
"""

import json
import os
import resource
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from queue import SimpleQueue
from typing import IO, Any, TextIO

from beliefscope.datasets.errors import BadInput

REPORT_INTERVAL = 0.1  # s between progress reports
NICENESS = 5  # lower priority than the server

Report = Callable[[float, str], None]
"""(share done 0..1, current activity) -> None; may be called at every step."""


class WorkerDied(RuntimeError):
    """The process ended before its function did."""


class WorkerProcess(subprocess.Popen[str]):
    """A process that runs functions ``(arguments, report) -> result`` of a module, with JSON arguments and results.

    It ends with the server. It has its own session: Ctrl+C in the terminal stops the server only.
    """

    def __init__(self, module: str, log: IO[bytes] | None = None) -> None:
        """log: file for its printed text; by default the server's standard error."""
        super().__init__(
            [sys.executable, "-P", "-u", "-m", __name__, module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            text=True,
            bufsize=1,
            start_new_session=True,
            env={"OMP_NUM_THREADS": "1"} | os.environ,
        )

    def call(self, function: str, arguments: Mapping[str, Any], report: Report) -> Any:
        """Run a function and return its result. Call it from one thread at a time.

        Raises BadInput if the function does, RuntimeError for any other error of it, and WorkerDied if the
        process ended; it describes how.
        """
        assert self.stdin is not None
        assert self.stdout is not None
        # The process has died in the first case, and in the second, while it wrote a line.
        with suppress(OSError, json.JSONDecodeError):
            self.stdin.write(json.dumps([function, arguments]) + "\n")
            for line in self.stdout:
                kind, *values = json.loads(line)
                if kind == "result":
                    return values[0]
                if kind == "error":
                    message, bad_input = values
                    raise (BadInput if bad_input else RuntimeError)(message)
                report(*values)
        raise WorkerDied(f"its process {exit_description(self.wait())}")

    def signal_group(self, number: signal.Signals) -> None:
        """Signal the process and its subprocesses."""
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, number)


def exit_description(code: int) -> str:
    """Describe the exit code of a process: "was ended by signal 9 (SIGKILL), possibly out of memory"."""
    if code >= 0:
        return f"ended with exit code {code}"
    memory = ", possibly out of memory" if -code == signal.SIGKILL else ""
    return f"was ended by signal {-code} ({signal.Signals(-code).name}){memory}"


def main(module: str) -> None:
    """Run the called functions until standard input ends."""
    os.nice(NICENESS)
    output = os.fdopen(os.dup(sys.stdout.fileno()), "w", buffering=1)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    calls: SimpleQueue[str] = SimpleQueue()
    threading.Thread(target=_read_calls, args=(calls,), daemon=True).start()
    functions = import_module(module)
    while True:
        name, arguments = json.loads(calls.get())
        output.write(json.dumps(_outcome(getattr(functions, name), arguments, output)) + "\n")


def redirect_output(path: Path) -> None:
    """Append the printed text of this process to a file from now on."""
    with path.open("ab") as file:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
            os.dup2(file.fileno(), stream.fileno())


def memory_in_use() -> int:
    """Resident memory of this process, bytes; on other systems than Linux its peak."""
    with suppress(OSError):
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _read_calls(calls: SimpleQueue[str]) -> None:
    for line in sys.stdin:
        calls.put(line)
    os._exit(0)  # the server has ended, or needs no more results


def _outcome(function: Callable[..., Any], arguments: Any, output: TextIO) -> tuple[Any, ...]:
    last_report = 0.0

    def report(progress: float, message: str = "") -> None:
        nonlocal last_report
        now = time.monotonic()
        if now - last_report >= REPORT_INTERVAL:
            last_report = now
            output.write(json.dumps(["report", min(max(float(progress), 0.0), 1.0), message]) + "\n")

    try:
        return "result", function(arguments, report)
    except BadInput as error:
        return "error", str(error), True
    except Exception as error:
        traceback.print_exc()
        # PyTorch raises RuntimeError when memory is exhausted.
        out_of_memory = isinstance(error, MemoryError) or "can't allocate memory" in str(error)
        return "error", f"{'it ran out of memory: ' if out_of_memory else ''}{type(error).__name__}: {error}", False


if __name__ == "__main__":
    main(sys.argv[1])
