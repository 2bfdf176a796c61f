"""The 3D scene in a notebook."""

import io
from contextlib import redirect_stdout
from typing import Any

from viser import ViserServer

from beliefscope.app.protocol.messages import SceneLayers
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.app.views.scene_belief import BeliefScene
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.trace import Trace

HEIGHT = 560  # px


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
