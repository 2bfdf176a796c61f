"""Viewers of a trace in a notebook; tests/browser/test_interactive.py drives the widget."""

from __future__ import annotations

import urllib.request
from urllib.error import URLError

import numpy as np
import pytest

import beliefscope as bs

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def run_() -> bs.Trace:
    return bs.trace("push/crossmodal-ekf", "push", 9)


def test_scene(run_: bs.Trace) -> None:
    scene = bs.show(run_, "push/crossmodal-ekf", viewer="scene")
    assert f'<iframe src="{scene.url}"' in scene._repr_html_()
    with urllib.request.urlopen(scene.url, timeout=10) as answer:
        assert b"<html" in answer.read()
    before = tuple(scene._scene._outline_frames[1].position)
    scene.step = 60
    assert scene.step == 60
    assert tuple(scene._scene._outline_frames[1].position) != before
    scene.close()
    with pytest.raises(URLError):
        urllib.request.urlopen(scene.url, timeout=10)


@pytest.mark.long
def test_widget_starts_at_the_largest_error(run_: bs.Trace) -> None:
    widget = bs.show(run_)
    assert widget.step == int(np.linalg.norm(run_.estimate_mean - run_.episode.states, axis=1).argmax())
    widget.step = -5
    assert widget.step == 0
    assert "export default" in widget._esm


@pytest.mark.long
def test_rerun(run_: bs.Trace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RERUN_NOTEBOOK_ASSET", "https://app.rerun.io/widget.js")  # starts no server
    viewer = bs.show(run_, "push/crossmodal-ekf", viewer="rerun")
    ((event, (recording,)),) = viewer._event_queue
    assert event == {"type": "rrd"}
    assert recording[:3] == b"RRF"


def test_errors(run_: bs.Trace) -> None:
    with pytest.raises(bs.BadInput, match="viewer 'plot' does not exist"):
        bs.show(run_, viewer="plot")  # type: ignore[arg-type]
    with pytest.raises(bs.BadInput, match="scene needs the filter"):
        bs.show(run_, viewer="scene")
