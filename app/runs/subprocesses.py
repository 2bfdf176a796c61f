"""Functions shared by the server's worker processes: progress output, exit codes, priority."""

from __future__ import annotations

import os
import signal
import sys
from typing import TextIO

REPORT_INTERVAL = 0.1  # s between progress reports
NICENESS = 5  # lower priority than the server


def redirect_stdout() -> TextIO:
    """Return the original standard output, line-buffered; later prints of the process go to standard error."""
    output = os.fdopen(os.dup(sys.stdout.fileno()), "w", buffering=1)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return output


def exit_description(code: int) -> str:
    """Describe the exit code of a process: "was ended by signal 9 (SIGKILL), possibly out of memory"."""
    if code >= 0:
        return f"ended with exit code {code}"
    memory = ", possibly out of memory" if -code == signal.SIGKILL else ""
    return f"was ended by signal {-code} ({signal.Signals(-code).name}){memory}"
