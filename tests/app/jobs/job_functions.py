"""What the tests' jobs do, each in a process of its own (``test_jobs.py``)."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from beliefscope.app.jobs.worker import Report
from beliefscope.datasets.errors import BadInput


def add(arguments: dict[str, Any], report: Report) -> dict[str, Any]:
    print("adding")
    report(0.5, "half of it")
    return {"sum": sum(arguments["numbers"]), "threads": os.environ["OMP_NUM_THREADS"]}


def wait(arguments: dict[str, Any], report: Report) -> dict[str, Any]:
    """Until a file is there; starts a process of its own, which is to end with it."""
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    Path(arguments["started"]).write_text(f"{os.getpid()} {child.pid}")
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
    print("leaving without a word")
    sys.stdout.flush()
    os._exit(3)


def refuse(arguments: dict[str, Any], report: Report) -> dict[str, Any]:
    raise BadInput("particles must be at least 1, not 0")


def hopeless(arguments: dict[str, Any], report: Report) -> dict[str, Any]:
    return {"value": float("nan")}


def hungry(arguments: dict[str, Any], report: Report) -> dict[str, Any]:
    """Takes more memory than it may."""
    most = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + (64 << 20)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    return {"bytes": len(bytearray(1 << 30))}
