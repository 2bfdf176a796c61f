"""The server in a separate process, with its memory, descriptors, threads and CPU time."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Served:
    """A listening server. Its resources are read from ``/proc``, on Linux only."""

    url: str
    process: subprocess.Popen[str]

    @property
    def memory(self) -> float:
        """Resident memory, MB."""
        return self._status("VmRSS") / 1e3

    @property
    def threads(self) -> int:
        return self._status("Threads")

    @property
    def descriptors(self) -> int:
        return len(os.listdir(f"/proc/{self.process.pid}/fd"))

    @property
    def cpu(self) -> float:
        """CPU time of the server without its other processes, s."""
        return _seconds(self.process.pid, 11)

    @property
    def children_cpu(self) -> float:
        """CPU time of the server's other processes, which run jobs and filters, s."""
        tasks = Path(f"/proc/{self.process.pid}/task").glob("*/children")
        running = [pid for path in tasks for pid in path.read_text().split()]
        return _seconds(self.process.pid, 13) + sum(_seconds(pid, field) for pid in running for field in (11, 13))

    def _status(self, key: str) -> int:
        lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith(f"{key}:"))


def _seconds(pid: int | str, field: int) -> float:
    """User and system time from two fields of ``stat``, counted after the name of the process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[field]) + int(fields[field + 1])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def serving(*options: str, workspace: Path | None = None) -> Iterator[Served]:
    """Run the installed command on a free port; stderr is inherited.

    Args:
        options: of ``beliefscope serve``. workspace: default: a temporary one.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "beliefscope", "serve", "--port", "0", "--no-open"]
        command += ["--workspace", str(workspace or folder), *options]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            assert process.stdout is not None
            match = re.search(r"http://\S+", process.stdout.readline())
            if match is None:
                raise RuntimeError("the server ended before it listened")
            yield Served(match[0], process)
        finally:
            process.terminate()
            process.wait(timeout=30)
