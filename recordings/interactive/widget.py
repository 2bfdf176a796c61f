"""A run as a notebook widget: the interactive page in a cell, with its cursor as an attribute."""

from __future__ import annotations

import re

import anywidget
import traitlets

from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.maps.map_engine import COARSE
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.interactive.export import FOLDER, as_text, body, run_document, style


def _module() -> str:
    """``viewer.js`` and ``widget.js`` as one module: a notebook cannot import files."""
    widget = re.sub(r"^import .*$", "", (FOLDER / "widget.js").read_text(), flags=re.MULTILINE)
    return f"{(FOLDER / 'viewer.js').read_text()}\n{widget}"


class RunWidget(anywidget.AnyWidget):
    """Timeline, maps, scene, images and diagnosis of a trace. Everything is in the widget: it needs no network.

    Attributes:
        step: the cursor, in both directions.
    """

    _esm = _module()
    _run = traitlets.Unicode().tag(sync=True)
    _body = traitlets.Unicode().tag(sync=True)
    _style = traitlets.Unicode().tag(sync=True)
    step = traitlets.Int(0).tag(sync=True)

    def __init__(self, trace: Trace, checkpoint: Checkpoint | None = None, size: int = COARSE) -> None:
        """Maps and diagnosis need the checkpoint. size: cells per side of a map."""
        run = run_document(trace, checkpoint, size, lambda fraction: None)
        moments = run["moments"]
        super().__init__(
            _run=as_text(run),
            _body=body(trace, checkpoint),
            _style=style(),
            step=moments[0]["step"] if moments else 0,
        )

    @traitlets.validate("step")
    def _valid_step(self, proposal: traitlets.Bunch) -> int:
        return max(0, int(proposal["value"]))
