"""The 3D scene of one view: viser's server for it, the drawing in it, and the step that a hand may move there."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from viser import GuiEvent, GuiSliderHandle

from beliefscope.app.protocol.messages import Look
from beliefscope.app.runs.trace_store import Traced
from beliefscope.app.views.embedded_viser import EmbeddedViser
from beliefscope.app.views.scene_belief import Drawing
from beliefscope.app.views.scene_comparison import Shadow
from beliefscope.inspect.likelihood import LikelihoodMap
from beliefscope.inspect.trace import Trace

PANEL_WIDTH = 180  # pixels
USER_HOLDS = 0.5  # s after the step was moved in the scene in which an echo does not move the slider under the hand


class Scene:
    """Draws one trace at a time; ``show`` and ``close`` block and may be called from any thread.

    Args:
        moved: called in another thread with the step that somebody chose in the scene itself.
        dark: whether the background is dark.
    """

    def __init__(self, moved: Callable[[int], None], dark: bool) -> None:
        self.viser = EmbeddedViser()
        self._server = self.viser.server
        self._moved = moved
        self._lock = threading.Lock()
        self._drawing: Drawing | None = None
        self._look = Look()
        self._shown: tuple[int, LikelihoodMap | None] = (0, None)
        self._other: Trace | None = None
        self._shadow: Shadow | None = None
        self._closed = False
        self._key = ""
        self._slider: GuiSliderHandle[int] | None = None
        self._user_moved = -USER_HOLDS
        self._server.gui.set_panel_label("Step")  # all that is in it
        self.set_dark(dark)
        self._fold_panel()

    def set_dark(self, dark: bool) -> None:
        """Follow the page's colours."""
        self._server.gui.configure_theme(
            dark_mode=dark, show_logo=False, show_share_button=False, control_width="small"
        )
        self._server.flush()

    def look(self, look: Look) -> None:
        """Draw what is shown as it is wanted, now and from now on."""
        with self._lock:
            self._look = look
            if self._closed or self._drawing is None:
                return
            with self._server.atomic():
                self._drawing.look(look)
                self._drawing.move(*self._shown)
            self._server.flush()

    def stand(self, at: str) -> None:
        """Move the browser's eye to one of ``VIEWPOINTS``."""
        with self._lock:
            if self._closed or self._drawing is None or at not in self._drawing.viewpoints:
                return
            position, target = self._drawing.viewpoints[at]
            for client in self._server.get_clients().values():
                with client.atomic():
                    client.camera.position, client.camera.look_at = position, target
            self._server.flush()

    def show(self, traced: Traced, step: int, other: Trace | None = None, maps: LikelihoodMap | None = None) -> None:
        """Draw a step of a trace and send it to the browser.

        Other: the run of its episode that it is compared with. Maps: of the step, where it has any.
        """
        with self._lock:
            if self._closed:
                return
            trace, index = traced.at(step)
            if self._key != traced.shown:
                self._build(traced, trace)
            assert self._drawing is not None
            with self._server.atomic():
                if traced.grows:
                    assert self._slider is not None
                    self._drawing.turn_to(trace)
                    self._slider.max = max(1, len(traced) - 1)
                self._shown = index, maps
                self._drawing.move(index, maps)
                if other is not self._other:
                    self._shade(traced, other)
                if self._shadow is not None:
                    self._shadow.move(step)
                if self._slider is not None and time.monotonic() - self._user_moved > USER_HOLDS:
                    self._slider.value = step  # type: ignore[misc]
            self._server.flush()

    def close(self) -> None:
        """End the scene's connections and threads; ``show`` does nothing from now on."""
        with self._lock:
            self._closed = True
        self.viser.close()

    def _build(self, traced: Traced, trace: Trace) -> None:
        server = self._server
        with server.atomic():
            server.scene.reset()
            server.gui.reset()
            self._drawing, self._shadow, self._other = Drawing(server, traced, trace, self._look), None, None
            self._slider = server.gui.add_slider("step", 0, max(1, len(traced) - 1), 1, 0)
            self._slider.on_update(self._on_slider)
            self._fold_panel()
        self._key = traced.shown

    def _shade(self, traced: Traced, other: Trace | None) -> None:
        if self._shadow is not None:
            self._shadow.remove()
        self._shadow = None if other is None else Shadow(self._server, traced.checkpoint.task, other)
        self._other = other

    def _fold_panel(self) -> None:
        panel = self._server.gui.main_panel
        panel.set_width(PANEL_WIDTH)
        panel.minimize()

    def _on_slider(self, event: GuiEvent[GuiSliderHandle[int]]) -> None:
        # Without a client it was we who moved it, following the page: that must not go back there.
        if event.client_id is not None:
            self._user_moved = time.monotonic()
            self._moved(int(event.target.value))
