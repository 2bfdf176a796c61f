"""A running server and a page in Chromium, watched for errors, broken policies and requests to other hosts."""

from __future__ import annotations

import os
import subprocess
import sysconfig
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

sync_api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed: pip install -e '.[dev]'")

FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--webgl-antialiasing-mode=none",  # the processor draws the scene, and nobody judges its edges
]
PATIENCE = 60.0  # s: without a GPU the first picture of a 3D view takes long

# viser's client starts a sorter for Gaussian splats, which we never show, by building a function from a string.
# The policy refuses that, as it should.
TOLERATED = "Evaluating a string as JavaScript violates"


class Served:
    """``beliefscope serve`` as a user starts it."""

    def __init__(self, workspace: Path, port: int = 0, *more: str) -> None:
        self.workspace = workspace
        command = Path(sysconfig.get_path("scripts")) / "beliefscope"
        options = ["serve", "--port", str(port), "--no-open", "--workspace", str(workspace), *more]
        self.process = subprocess.Popen([str(command), *options], stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        self.listening = time.monotonic()
        found = [word for word in line.split() if word.startswith("http://")]
        assert found, f"no address in {line!r}"
        self.url = found[0]

    def stop(self) -> None:
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


@pytest.fixture(scope="session")
def served(tmp_path_factory: pytest.TempPathFactory, chromium: str) -> Iterator[Served]:
    server = Served(tmp_path_factory.mktemp("workspace"))
    yield server
    server.stop()


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., Served]]:
    """Starts servers of the test's own, on one workspace."""
    started: list[Served] = []

    def start(port: int = 0, *more: str) -> Served:
        started.append(Served(tmp_path / "workspace", port, *more))
        return started[-1]

    yield start
    for server in started:
        server.stop()


# Of one file: while Playwright runs, its thread has an event loop, and tests of other files may want one of their own.
@pytest.fixture(scope="module")
def browser(chromium: str) -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        yield browser
        browser.close()


VIOLATIONS = """async () => {
  // Other people's pages are not ours to judge: viser's scene, Rerun's canvas.
  const { violations } = await axe.run({ exclude: ['iframe', '.viewer'] }, { resultTypes: ['violations'] });
  const serious = violations.filter(({ impact }) => impact === 'serious' || impact === 'critical');
  const told = ({ target, failureSummary }) => `${target} ${failureSummary.split('\\n')[1].trim()}`;
  return serious.flatMap(({ id, nodes }) => nodes.map((node) => `${id}: ${told(node)}`));
}"""


class Watched:
    """A page, and everything about it that must not be."""

    def __init__(self, page: Any, url: str, screenshots: Path) -> None:
        self.page = page
        self.url = url
        self._screenshots = screenshots
        self.wrong: list[str] = []
        page.add_init_script(
            "document.addEventListener('securitypolicyviolation', (event) => {"
            "  if (event.blockedURI !== 'eval') console.error('policy', event.violatedDirective, event.blockedURI);"
            "});"
        )
        page.on("console", lambda message: message.type == "error" and self.wrong.append(message.text))
        page.on("pageerror", lambda error: TOLERATED in error.message or self.wrong.append(f"{error.stack or error}"))
        page.on("request", lambda request: self._asked(request.url))

    def _asked(self, url: str) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("data", "blob") and parts.netloc != urlsplit(self.url).netloc:
            self.wrong.append(f"request to another host: {url}")

    def open(self, link: str = "") -> Watched:
        """Opens a link of the page's and waits for the fine maps."""
        self.page.goto(self.url + link, timeout=1000 * PATIENCE)
        self.until("() => window.beliefscope?.stats.maps?.size === 135")
        return self

    def until(self, condition: str, patience: float = PATIENCE) -> None:
        """Waits until a function in the page is true. Playwright's own wait evaluates a string, which is banned."""
        end = time.monotonic() + patience
        while not self.page.evaluate(condition):
            assert time.monotonic() < end, f"not within {patience} s: {condition}; {self.page.evaluate(STATE)}"
            time.sleep(0.05)

    @property
    def state(self) -> dict[str, Any]:
        return self.page.evaluate("() => window.beliefscope.state()")

    @property
    def stats(self) -> dict[str, Any]:
        return self.page.evaluate("() => window.beliefscope.stats")

    def maps(self) -> list[str]:
        """What each map shows."""
        return self.page.evaluate("() => [...document.querySelectorAll('#heatmaps canvas')].map((c) => c.toDataURL())")

    def violations(self) -> list[str]:
        """What of the page as it is shown somebody cannot use or read, as axe finds it."""
        axe = pytest.importorskip("axe_playwright_python", reason="axe is not installed: pip install -e '.[dev]'")
        if not self.page.evaluate("() => Boolean(window.axe)"):
            self.page.evaluate((Path(axe.__file__).parent / "axe.min.js").read_text())
        return self.page.evaluate(VIOLATIONS)

    def settle(self, step: int) -> None:
        """Waits until the step's fine maps are there and the scene has followed."""
        self.until(
            f"() => {{ const {{ maps, drawn }} = beliefscope.stats;"
            f" return maps.step === {step} && maps.size === 135 && drawn?.step === {step}; }}"
        )

    def picture(self, name: str) -> None:
        """Keeps a screenshot, where ``BELIEFSCOPE_SCREENSHOTS`` says or among the tests' own files."""
        self._screenshots.mkdir(parents=True, exist_ok=True)
        self.page.screenshot(path=self._screenshots / f"{name}.png", timeout=1000 * PATIENCE)


STATE = (
    "() => JSON.stringify([window.beliefscope?.state(), window.beliefscope?.stats,"
    " [...document.querySelectorAll('.note, #messages')].map((n) => n.textContent)])"
)
OpenPage = Callable[..., Watched]


@pytest.fixture
def open_page(browser: Any, served: Served, tmp_path_factory: pytest.TempPathFactory) -> Iterator[OpenPage]:
    """Opens pages, and checks at the end that nothing went wrong on any of them."""
    opened: list[Watched] = []
    kept = os.environ.get("BELIEFSCOPE_SCREENSHOTS")
    screenshots = Path(kept) if kept else tmp_path_factory.getbasetemp() / "screenshots"

    def open_(link: str = "", url: str = "", **options: Any) -> Watched:
        options = {"viewport": {"width": 1024, "height": 768}, "color_scheme": "light"} | options
        watched = Watched(browser.new_page(**options), url or served.url, screenshots)
        opened.append(watched)
        return watched.open(link)

    yield open_
    wrong = [line for watched in opened for line in watched.wrong]
    for watched in opened:
        watched.page.close()
    assert not wrong
