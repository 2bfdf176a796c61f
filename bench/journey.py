"""From the diagnosis of a failing filter to a promoted, better checkpoint: clicks and seconds, in headless Chromium.

python bench/journey.py
python bench/journey.py door-field/information-ekf:image_noise=40 --screens FOLDER

The page is opened at a run with a sensor fault. Every click is a click of the mouse on a button that is on the
screen; a button that has to be scrolled to is reported. The time starts with the first click and includes the
diagnosis, the simulation of training episodes, the training and the comparison with the base checkpoint.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from page import browsing, usable
from server_process import serving

RUNS = ("push-field/information-ekf:image_noise=40", "door-field/information-ekf:image_noise=40")
CLICKS, SECONDS = 5, 180.0  # bars
TIMEOUT = 900_000  # ms
STAGES = {"simulation": "simulating", "training": "step", "comparison": "comparing"}
"""Stage of a run -> part of its message."""
SIZE = {"width": 1280, "height": 720}


class Journey:
    """A user of a page: clicks buttons, counts and times them."""

    def __init__(self, page: Any, screens: Path | None, title: str) -> None:
        self.page, self.screens, self.title = page, screens, title
        self.clicks, self.scrolled = 0, list[str]()
        self.start = time.perf_counter()
        self.stages = list[tuple[str, float]]()

    def click(self, name: str, role: str = "button") -> None:
        """Clicks a button with the mouse, where it is on the screen."""
        button = self.page.get_by_role(role, name=name, exact=True).first
        button.wait_for(timeout=TIMEOUT)
        box = button.bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        hit = "([node, x, y]) => node.contains(document.elementFromPoint(x, y))"
        if not button.evaluate(f"(node) => ({hit})([node, {x}, {y}])"):
            self.scrolled.append(name)
            button.scroll_into_view_if_needed()
        if not self.clicks:
            self.start = time.perf_counter()
        button.click()
        self.clicks += 1

    def until(self, stage: str, condition: str) -> None:
        """Waits for a condition, notes the seconds and takes a screenshot."""
        self.page.wait_for_function(f"() => {condition}", timeout=TIMEOUT)
        self.stages.append((stage, time.perf_counter() - self.start))
        if self.screens:
            self.page.wait_for_timeout(500)
            self.page.screenshot(path=self.screens / f"{self.title}-{len(self.stages)}-{stage.split()[-1]}.png")


def travel(page: Any, url: str, run: str, screens: Path | None) -> Journey:
    """Goes from the first screen of a run to the page with the promoted checkpoint."""
    subject, _, faults = run.partition(":")
    task, filter_ = subject.split("/")
    page.set_viewport_size(SIZE)
    page.goto(f"{url}?" + urlencode({"task": task, "filter": filter_, "faults": faults}))
    usable(page)
    journey = Journey(page, screens, task)
    journey.click("Diagnosis", "tab")
    journey.until("headline", "diagnosis.dataset.finding")
    journey.until("confirmed diagnosis", "diagnosis.dataset.state === 'ready'")
    journey.click("Fine-tune the filter …")
    journey.until("settings", "document.querySelector('#finetune').dataset.state === 'ready'")
    journey.click("Fine-tune")
    for stage, text in STAGES.items():
        journey.until(stage, f"document.querySelector('#finetune .verdict').textContent.includes('{text}')")
    state = "document.querySelector('#finetune article').dataset.state"
    journey.until("verdict", f"['measuring', 'ready'].includes({state})")
    print(f"{run}: {page.locator('#finetune .verdict').text_content()}", flush=True)
    journey.until("healthy record", f"{state} === 'ready'")
    journey.click("Promote to default")
    journey.until("promoted", f"window.beliefscope?.state?.().filter.startsWith('{filter_}-')")
    return journey


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", default=RUNS, metavar="TASK/FILTER:FAULTS")
    parser.add_argument("--screens", type=Path, metavar="FOLDER", help="screenshots of every stage")
    args = parser.parse_args()
    if args.screens:
        args.screens.mkdir(parents=True, exist_ok=True)
    for run in args.runs:
        with browsing() as page, serving() as served:  # without simulated episodes of a previous run
            journey = travel(page, served.url, run, args.screens)
            cpu = served.children_cpu
        seconds = journey.stages[-1][1]
        print(f"  {', '.join(f'{stage} {time:.0f} s' for stage, time in journey.stages)}")
        print(f"  clicks: {journey.clicks} (bar: <= {CLICKS}); scrolled to: {', '.join(journey.scrolled) or 'none'}")
        print(
            f"  time to the promoted checkpoint: {seconds:.0f} s (bar: <= {SECONDS:.0f} s), "
            f"{cpu:.0f} s of CPU time of jobs and filters, load {os.getloadavg()[0]:.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
