"""Rerun's viewer in a notebook."""

from __future__ import annotations

import io
import os
import tempfile
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.base import Diagnostic
from beliefscope.inspect.maps.map_engine import MapEngine
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.write import write_recording

MAP_STRIDE = 5
HEIGHT = 560  # px


def rerun_viewer(trace: Trace, checkpoint: Checkpoint | None, diagnostics: dict[str, Diagnostic]) -> Any:
    """Rerun's notebook widget with the recording of a trace.

    Its files come from the installed package, through a server of this process, unless the environment variable
    RERUN_NOTEBOOK_ASSET selects another source.
    """
    os.environ.setdefault("RERUN_NOTEBOOK_ASSET", "serve-local")  # read when the module is imported
    with redirect_stdout(io.StringIO()):
        from rerun_notebook import Viewer

    maps = None if checkpoint is None else MapEngine(checkpoint, trace).maps(range(0, len(trace), MAP_STRIDE))
    with tempfile.TemporaryDirectory() as folder:
        path = write_recording(trace, Path(folder) / "run.rrd", maps=maps, diagnostics=diagnostics)
        viewer = Viewer(width="auto", height=HEIGHT)
        viewer.send_rrd(path.read_bytes())
    return viewer
