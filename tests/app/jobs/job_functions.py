"""Functions of the tests' jobs."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from beliefscope.app.runs.worker import Report
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.io.user_code import load_module


def add(arguments: dict[str, Any], report: Report) -> dict[str, Any]:
    print("adding")
    report(0.5, "half done")
    return {"sum": sum(arguments["numbers"]), "threads": os.environ["OMP_NUM_THREADS"]}


def wait(arguments: dict[str, Any], report: Report) -> dict[str, Any]:
    """Wait for a file; the subprocess must end with the job."""
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    Path(arguments["started"]).write_text(f"{os.getpid()} {child.pid}")
    report(0.1, "started")
    while not Path(arguments["until"]).exists():
        report(0.25, "waiting for the file")
        time.sleep(0.01)
    child.kill()
    child.wait()
    return {}


def crash(arguments: dict[str, Any], report: Report) -> dict[str, Any]:
    print("about to divide")
    return {"quotient": 1 / len(arguments["numbers"])}


def vanish(arguments: dict[str, Any], report: Report) -> dict[str, Any]:
    print("exiting without an error")
    sys.stdout.flush()
    os._exit(3)


def refuse(arguments: dict[str, Any], report: Report) -> dict[str, Any]:
    raise BadInput("particles must be at least 1, not 0")


def not_json(arguments: dict[str, Any], report: Report) -> dict[str, Any]:
    return {"value": float("nan")}


def load(arguments: dict[str, Any], report: Report) -> dict[str, Any]:
    """Run a file of user code."""
    print(load_module(arguments["place"]).VALUE)
    return {}


def exhaust_memory(arguments: dict[str, Any], report: Report) -> dict[str, Any]:
    """Allocate more memory than the limit."""
    limit = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + (64 << 20)
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    return {"bytes": len(bytearray(1 << 30))}
