"""The server as a process of its own, as users start it, and what it takes: memory, descriptors, threads, processor."""

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
    """A server that listens. Its figures are read from ``/proc``, so on Linux only."""

    url: str
    process: subprocess.Popen[str]

    @property
    def memory(self) -> float:
        """Resident, MB."""
        return self._status("VmRSS") / 1e3

    @property
    def threads(self) -> int:
        return self._status("Threads")

    @property
    def descriptors(self) -> int:
        return len(os.listdir(f"/proc/{self.process.pid}/fd"))

    @property
    def processor(self) -> float:
        """s of processor time that it has had, its jobs left out."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def _status(self, key: str) -> int:
        lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith(f"{key}:"))


@contextmanager
def serving(*more: str, workspace: Path | None = None) -> Iterator[Served]:
    """The installed command on a free port, until the block ends; what it says on stderr goes to ours.

    Args:
        more: options of ``beliefscope serve``. workspace: a new one that is thrown away, if None.
    """
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "beliefscope", "serve", "--port", "0", "--no-open"]
        command += ["--workspace", str(workspace or folder), *more]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            assert process.stdout is not None
            found = re.search(r"http://\S+", process.stdout.readline())
            if found is None:
                raise RuntimeError("the server ended before it listened")
            yield Served(found[0], process)
        finally:
            process.terminate()
            process.wait(timeout=30)
