"""Rerun's viewer and the 3D scene in a notebook."""

import io
import os
import tempfile
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from viser import ViserServer

from beliefscope.app.protocol.messages import SceneLayers
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.app.views.scene_belief import BeliefScene
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.diagnostics.base import Diagnostic
from beliefscope.inspect.likelihood import MapEngine
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


class SceneViewer:
    """The 3D scene of a trace, with a slider for the step. A notebook shows it in a frame.

    url: address of the scene on this machine. step: the cursor.
    """

    def __init__(self, trace: Trace, checkpoint: Checkpoint, step: int = 0) -> None:
        run = TracedRun("notebook", checkpoint)
        run.future.set_result(trace)
        with redirect_stdout(io.StringIO()):  # viser announces its address
            self._server = ViserServer(host="127.0.0.1", port=0, verbose=False)
        self._scene = BeliefScene(self._server, run, trace, SceneLayers(hidden=frozenset({"map"})), labels=True)
        self._slider: Any = self._server.gui.add_slider("Step", 0, len(trace) - 1, 1, step)
        self._slider.on_update(lambda event: self._draw())
        self.url = f"http://127.0.0.1:{self._server.get_port()}"
        self._draw()

    @property
    def step(self) -> int:
        return int(self._slider.value)

    @step.setter
    def step(self, value: int) -> None:
        self._slider.value = value
        self._draw()  # the slider's listeners run later, in another thread

    def _draw(self) -> None:
        with self._server.atomic():
            self._scene.move(self.step, None)
        self._server.flush()

    def close(self) -> None:
        """End the scene's server."""
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.url}" style="width:100%;height:{HEIGHT}px;border:0"></iframe>'
