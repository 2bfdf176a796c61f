"""3D scene of one view: its viser server and the drawn run."""

import threading

from beliefscope.app.protocol.messages import SceneLayers, Viewpoint
from beliefscope.app.runs.traced_run import TracedRun
from beliefscope.app.views.embedded_viser import EmbeddedViser
from beliefscope.app.views.scene_belief import BeliefScene, ComparisonEstimate
from beliefscope.inspect.maps.map_engine import LikelihoodMap
from beliefscope.inspect.trace import Trace


class Scene:
    """Draws one run at a time. ``show`` and ``close`` block and may be called from any thread."""

    def __init__(self, dark: bool) -> None:
        self.viser = EmbeddedViser()
        self._server = self.viser.server
        self._lock = threading.Lock()
        self._belief: BeliefScene | None = None
        self._layers = SceneLayers()
        self._position: tuple[int, LikelihoodMap | None] = (0, None)
        self._comparison_trace: Trace | None = None
        self._comparison: ComparisonEstimate | None = None
        self._closed = False
        self._key = self._task = ""
        self.set_dark(dark)

    def set_dark(self, dark: bool) -> None:
        """Use the dark or the light theme."""
        self._server.gui.configure_theme(
            dark_mode=dark, show_logo=False, show_share_button=False, control_width="small"
        )
        self._server.flush()

    def set_layers(self, layers: SceneLayers) -> None:
        """Change the visible layers and their appearance."""
        with self._lock:
            self._layers = layers
            if self._closed or self._belief is None:
                return
            with self._server.atomic():
                self._belief.set_layers(layers)
                self._belief.move(*self._position)
            self._server.flush()

    def set_viewpoint(self, viewpoint: Viewpoint) -> None:
        """Move the browser's camera to a viewpoint, if the scene has it."""
        with self._lock:
            if self._closed or self._belief is None or viewpoint not in self._belief.viewpoints:
                return
            self._move_cameras(self._belief, viewpoint)
            self._server.flush()

    def show(
        self, run: TracedRun, step: int, comparison: Trace | None = None, maps: LikelihoodMap | None = None
    ) -> None:
        """Draw a step of a run and send it to the browser.

        comparison: trace of the comparison run of the same episode. maps: likelihood maps of the step.
        """
        with self._lock:
            if self._closed:
                return
            trace, index = run.at(step)
            if self._key != run.scene_key:
                self._build(run, trace)
            assert self._belief is not None
            with self._server.atomic():
                if run.growing:
                    self._belief.set_trace(trace)
                self._position = index, maps
                self._belief.move(index, maps)
                if comparison is not self._comparison_trace:
                    self._set_comparison(run, comparison)
                if self._comparison is not None:
                    self._comparison.move(step)
            self._server.flush()

    def close(self) -> None:
        """End the scene's connections and threads. Later calls of ``show`` have no effect."""
        with self._lock:
            self._closed = True
        self.viser.close()

    def _build(self, run: TracedRun, trace: Trace) -> None:
        server = self._server
        with server.atomic():
            server.scene.reset()
            self._belief = BeliefScene(server, run, trace, self._layers)
            self._comparison = self._comparison_trace = None
        if run.checkpoint.task.name != self._task:
            self._task = run.checkpoint.task.name
            self._move_cameras(self._belief, "first")
        self._key = run.scene_key

    def _move_cameras(self, belief: BeliefScene, viewpoint: Viewpoint) -> None:
        position, target = belief.viewpoints[viewpoint]
        for client in self._server.get_clients().values():
            with client.atomic():
                client.camera.position, client.camera.look_at = position, target

    def _set_comparison(self, run: TracedRun, trace: Trace | None) -> None:
        if self._comparison is not None:
            self._comparison.remove()
        self._comparison = None if trace is None else ComparisonEstimate(self._server, run.checkpoint.task, trace)
        self._comparison_trace = trace
