"""``show`` of the public interface."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any, Literal

from beliefscope._interface import Filter, load_filter
from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.inspect.catalog import quick
from beliefscope.inspect.trace import Trace


def show(run: Trace, filter_: Filter | None = None, *, viewer: Literal["run", "rerun", "scene"] = "run") -> Any:
    """Show a trace in a notebook, without network.

    Args:
        filter_: that of the trace; maps need it.
        viewer: ``run`` is a widget with timeline, maps and scene under one cursor (its attribute ``step``), ``rerun``
            Rerun's viewer, and ``scene`` the 3D scene, which needs the filter.

    Raises BadInput for an unknown viewer, and if anywidget is not installed.
    """
    check_name("viewer", viewer, ("run", "rerun", "scene"))
    checkpoint = None if filter_ is None else load_filter(filter_)
    if find_spec("anywidget") is None:
        raise BadInput("notebooks need anywidget: pip install 'beliefscope[notebook]'")
    if viewer == "run":
        from beliefscope.recordings.interactive.widget import RunWidget

        return RunWidget(run, checkpoint)
    if viewer == "rerun":
        from beliefscope.recordings.interactive.rerun_viewer import rerun_viewer

        return rerun_viewer(run, checkpoint, quick(run, checkpoint))
    if checkpoint is None:
        raise BadInput("the scene needs the filter: show(run, filter, viewer='scene')")
    from beliefscope.app.views.notebook import SceneViewer

    return SceneViewer(run, checkpoint)
