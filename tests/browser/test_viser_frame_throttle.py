"""Throttling of viser's animation frames in the scene (app/page/scene/viser_frame_throttle.js)."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest

# Draws continuously, as viser does during motion; each frame takes `cost` ms.
DRAWING = """(cost) => {
  const gl = document.createElement('canvas').getContext('webgl2');
  window.drawn = [];
  const draw = () => {
    gl.clear(gl.COLOR_BUFFER_BIT);
    for (const end = performance.now() + cost; performance.now() < end; );
    window.drawn.push(performance.now());
    requestAnimationFrame(draw);
  };
  requestAnimationFrame(draw);
}"""


class Frame:
    """A page with the script and a drawing of adjustable cost."""

    def __init__(self, page: Any, url: str) -> None:
        self.page = page
        page.goto(url + "healthz")
        page.add_script_tag(url=url + "static/scene/viser_frame_throttle.js")

    def draw(self, cost: int) -> None:
        self.page.evaluate(DRAWING, cost)
        self.page.wait_for_function("() => drawn.length > 4")  # two frames have been timed

    def count(self) -> int:
        return self.page.evaluate("() => drawn.length")

    def drawn_within(self, milliseconds: int) -> int:
        before = self.count()
        self.page.wait_for_timeout(milliseconds)
        return self.count() - before

    def pause(self, times: str) -> bool:
        return self.page.evaluate(f"() => frameThrottle.pause({times})")


@pytest.fixture(scope="module")
def without_policy(browser: Any) -> Iterator[Any]:
    """A context in which scripts run on every page; the policy of JSON answers forbids them."""
    context = browser.new_context(bypass_csp=True)
    context.new_page()  # the others are tabs of its window
    yield context
    context.close()


@pytest.fixture
def frame(without_policy: Any, server: Any) -> Iterator[Frame]:
    page = without_policy.new_page()
    yield Frame(page, server.url)
    page.close()


def test_fast_drawing_is_not_paused(frame: Frame) -> None:
    frame.draw(1)
    assert frame.pause("Infinity")
    assert frame.drawn_within(300) > 5
    assert not frame.page.evaluate("() => document.hidden")


def test_slow_drawing_is_paused_while_scrubbing(frame: Frame) -> None:
    frame.draw(100)
    assert not frame.pause("Infinity")
    assert frame.drawn_within(500) <= 1  # a frame may have been in progress
    assert not frame.pause("Infinity")
    assert frame.drawn_within(500) == 0
    assert frame.page.evaluate("() => document.hidden")
    assert frame.pause("0")
    assert frame.drawn_within(800) > 2


@pytest.mark.long
def test_pause_expires(frame: Frame) -> None:
    frame.draw(100)
    frame.pause("Infinity")
    frame.page.wait_for_function("(before) => drawn.length > before + 3", arg=frame.count(), timeout=10_000)


def test_playback_leaves_time_for_the_page(frame: Frame) -> None:
    frame.draw(100)
    frame.pause("3")
    frame.page.evaluate("() => void (drawn.length = 0)")
    frame.page.wait_for_timeout(2000)
    ends = frame.page.evaluate("() => drawn")
    assert len(ends) > 2
    assert min(b - a for a, b in pairwise(ends)) > 350


def test_cancelled_and_failing_callbacks(frame: Frame) -> None:
    called = frame.page.evaluate(
        """async () => {
          const called = [];
          addEventListener('error', (event) => { called.push(event.message); event.preventDefault(); });
          const cancelled = requestAnimationFrame(() => called.push('cancelled'));
          requestAnimationFrame(() => { throw new Error('broken'); });
          requestAnimationFrame(() => cancelAnimationFrame(later));
          const later = requestAnimationFrame(() => called.push('later'));
          cancelAnimationFrame(cancelled);
          await new Promise((resolve) => requestAnimationFrame(resolve));
          return called;
        }"""
    )
    assert called == ["Uncaught Error: broken"]
