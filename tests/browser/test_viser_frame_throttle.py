"""Throttling of viser's animation frames in the scene (app/page/scene/viser_frame_throttle.js)."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest

pytestmark = pytest.mark.browser

# Draws without end, as viser does while something moves; each drawing takes `cost` ms.
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
    """A page of the server's own with our script in it and a drawing that costs what a test wants."""

    def __init__(self, page: Any, url: str) -> None:
        self.page = page
        page.goto(url + "healthz")
        page.add_script_tag(url=url + "static/scene/viser_frame_throttle.js")

    def draw(self, cost: int) -> None:
        self.page.evaluate(DRAWING, cost)
        self.page.wait_for_timeout(1000)
        assert self.count() > 2

    def count(self) -> int:
        return self.page.evaluate("() => drawn.length")

    def drawn_within(self, milliseconds: int) -> int:
        before = self.count()
        self.page.wait_for_timeout(milliseconds)
        return self.count() - before

    def pause(self, times: str) -> bool:
        return self.page.evaluate(f"() => frameThrottle.pause({times})")


@pytest.fixture
def frame(browser: Any, served: Any) -> Iterator[Frame]:
    page = browser.new_page(bypass_csp=True)  # an answer of JSON may run no script
    yield Frame(page, served.url)
    page.close()


def test_what_is_drawn_fast_is_never_held(frame: Frame) -> None:
    frame.draw(1)
    assert frame.pause("Infinity")
    assert frame.drawn_within(500) > 5
    assert not frame.page.evaluate("() => document.hidden")


def test_what_is_drawn_slowly_waits_for_the_hand(frame: Frame) -> None:
    frame.draw(100)
    assert not frame.pause("Infinity")
    assert frame.drawn_within(800) <= 1  # one may have been under way
    assert not frame.pause("Infinity")
    assert frame.drawn_within(800) == 0
    assert frame.page.evaluate("() => document.hidden")
    assert frame.pause("0")
    assert frame.drawn_within(800) > 2


def test_a_forgotten_pause_ends(frame: Frame) -> None:
    frame.draw(100)
    frame.pause("Infinity")
    frame.page.wait_for_function("(before) => drawn.length > before + 3", arg=frame.count(), timeout=10_000)


def test_a_replay_leaves_the_page_its_share(frame: Frame) -> None:
    frame.draw(100)
    frame.pause("3")
    frame.page.evaluate("() => void (drawn.length = 0)")
    frame.page.wait_for_timeout(3000)
    ends = frame.page.evaluate("() => drawn")
    assert len(ends) > 2
    assert min(b - a for a, b in pairwise(ends)) > 350


def test_a_cancelled_callback_is_not_called_and_a_failing_one_stops_no_other(frame: Frame) -> None:
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
