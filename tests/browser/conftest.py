"""A running server and its page in Chromium, monitored for errors, policy violations and requests to other hosts."""

from __future__ import annotations

import os
import subprocess
import sysconfig
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--webgl-antialiasing-mode=none",  # software rendering is slow
]
TIMEOUT = 60.0  # s: without a GPU the first image of a 3D view takes long


class Server:
    """``beliefscope serve`` in its own process."""

    def __init__(self, workspace: Path, *options: str) -> None:
        self.workspace = workspace
        command = [Path(sysconfig.get_path("scripts")) / "beliefscope", "serve", "--port", "0", "--no-open"]
        command += ["--workspace", workspace, *options]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        urls = [word for word in line.split() if word.startswith("http://")]
        assert urls, f"no address in {line!r}"
        self.url = urls[0]

    def stop(self) -> None:
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory, chromium: str) -> Iterator[Server]:
    server = Server(tmp_path_factory.mktemp("workspace"))
    yield server
    server.stop()


@pytest.fixture
def start_server(tmp_path: Path) -> Iterator[Callable[..., Server]]:
    """Starts servers of a single test, all on the same workspace."""
    servers: list[Server] = []

    def start(*options: str) -> Server:
        servers.append(Server(tmp_path / "workspace", *options))
        return servers[-1]

    yield start
    for server in servers:
        server.stop()


class SharedBrowser:
    """Chromium and a context of it, started when they are first used, for the tests of all files in this folder."""

    def __init__(self) -> None:
        self._open = ExitStack()

    def browser(self, path: str) -> Any:
        reason = "Playwright is not installed: pip install -e '.[test]'"
        sync_api = pytest.importorskip("playwright.sync_api", reason=reason)
        playwright = self._open.enter_context(sync_api.sync_playwright())
        return self._open.enter_context(playwright.chromium.launch(executable_path=path, args=FLAGS))

    def context(self, browser: Any, **options: Any) -> Any:
        """A context whose pages are tabs of one window. Each window has a process for the browser's own controls."""
        context = self._open.enter_context(browser.new_context(**options))
        context.new_page()
        return context

    def close(self) -> None:
        self._open.close()


SHARED = SharedBrowser()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[None]:
    """Closes the browser after the last test of this folder.

    Playwright keeps an event loop running in its thread, which tests of other folders may need to themselves.
    """
    yield
    if nextitem is None or nextitem.path.parent != item.path.parent:
        SHARED.close()


@pytest.fixture(scope="session")
def browser(chromium: str) -> Any:
    return SHARED.browser(chromium)


@pytest.fixture(scope="session")
def context(browser: Any) -> Any:
    """All pages share a browser context: with an empty cache, each would load and compile all scripts.

    A pixel of the screen is 2 by 2 of the page, which halves the time of the 3D views; kept screenshots are sharp.
    """
    scale = 1.0 if os.environ.get("BELIEFSCOPE_SCREENSHOTS") else 0.5
    return SHARED.context(browser, device_scale_factor=scale)


# Embedded pages of other projects are excluded: viser's scene and Rerun's canvas.
VIOLATIONS = """async (part) => {
  const checked = { include: [part], exclude: ['iframe', '.viewer'] };
  const { violations } = await axe.run(checked, { resultTypes: ['violations'] });
  const serious = violations.filter(({ impact }) => impact === 'serious' || impact === 'critical');
  const describe = ({ target, failureSummary }) => `${target} ${failureSummary.split('\\n')[1].trim()}`;
  return serious.flatMap(({ id, nodes }) => nodes.map((node) => `${id}: ${describe(node)}`));
}"""

STATE = (
    "() => JSON.stringify([window.beliefscope?.state(), window.beliefscope?.stats,"
    " [...document.querySelectorAll('.note, #messages')].map((n) => n.textContent)])"
)


WAIT = """async () => {
  const condition = CONDITION;
  for (const end = performance.now() + 1000; performance.now() < end; ) {
    if (await condition()) return true;
    await new Promise((resolve) => setTimeout(resolve, 50));
  }
  return false;
}"""


class MonitoredPage:
    """The dashboard in a Playwright page (``page``), with a list of its errors."""

    def __init__(self, page: Any, url: str, screenshots: Path) -> None:
        self.page = page
        self.url = url
        self._screenshots = screenshots
        self.errors: list[str] = []
        page.add_init_script(
            "document.addEventListener('securitypolicyviolation', (event) => {"
            "  if (event.blockedURI !== 'eval') console.error('policy', event.violatedDirective, event.blockedURI);"
            "});"
        )
        page.on("console", lambda message: message.type == "error" and self.errors.append(message.text))
        page.on("pageerror", lambda error: self.errors.append(f"{error.stack or error}"))
        page.on("request", lambda request: self._check_host(request.url))

    def _check_host(self, url: str) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("data", "blob") and parts.netloc != urlsplit(self.url).netloc:
            self.errors.append(f"request to another host: {url}")

    def open(self, link: str = "", scene: bool = False) -> MonitoredPage:
        """Opens a permalink and waits for the maps in full resolution.

        Args:
            scene: whether a link without a tab opens the 3D scene, whose first images take seconds of software
                rendering.
        """
        if not scene and "tab=" not in link:
            link = f"{link or '?'}&tab=compare"
        self.page.goto(self.url + link, timeout=1000 * TIMEOUT)
        self.until("() => window.beliefscope?.stats.maps?.size === 135")
        self.until("() => document.documentElement.classList.contains('with-tabs')")
        return self

    def until(self, condition: str, timeout: float = TIMEOUT) -> None:
        """Waits until a JavaScript function is true. Playwright's ``wait_for_function`` is blocked by the policy."""
        end = time.monotonic() + timeout
        while not self._becomes(condition):
            assert time.monotonic() < end, f"not within {timeout} s: {condition}; {self.page.evaluate(STATE)}"

    def _becomes(self, condition: str) -> bool:
        """Whether the function is true within a second. The page checks it: calls from here take 3 ms of CPU time."""
        from playwright.sync_api import Error

        try:
            return self.page.evaluate(WAIT.replace("CONDITION", condition))
        except Error as error:
            if "context was destroyed" in str(error):  # the page is loaded again
                return False
            raise

    @property
    def state(self) -> dict[str, Any]:
        return self.page.evaluate("() => window.beliefscope.state()")

    @property
    def stats(self) -> dict[str, Any]:
        return self.page.evaluate("() => window.beliefscope.stats")

    def maps(self) -> list[str]:
        """Data URL of each map's image."""
        return self.page.evaluate("() => [...document.querySelectorAll('#heatmaps canvas')].map((c) => c.toDataURL())")

    def violations(self, part: str = "html") -> list[str]:
        """Serious accessibility violations of a part of the page in its current state, according to axe."""
        axe = pytest.importorskip("axe_playwright_python", reason="axe is not installed: pip install -e '.[test]'")
        if not self.page.evaluate("() => Boolean(window.axe)"):
            self.page.evaluate((Path(axe.__file__).parent / "axe.min.js").read_text())
        return self.page.evaluate(VIOLATIONS, part)

    def settle(self, step: int) -> None:
        """Waits until maps in full resolution and the scene, if it is open, show the step."""
        self.until(
            f"() => {{ const {{ maps, drawn }} = beliefscope.stats;"
            f" const scene = beliefscope.state().tab !== 'scene' || drawn?.step === {step};"
            f" return maps.step === {step} && maps.size === 135 && scene; }}"
        )

    def screenshot(self, name: str) -> None:
        """Saves a screenshot in ``BELIEFSCOPE_SCREENSHOTS`` or in pytest's temporary folder."""
        self._screenshots.mkdir(parents=True, exist_ok=True)
        self.page.screenshot(path=self._screenshots / f"{name}.png", timeout=1000 * TIMEOUT)


OpenPage = Callable[..., MonitoredPage]


@pytest.fixture
def open_page(context: Any, server: Server, tmp_path_factory: pytest.TempPathFactory) -> Iterator[OpenPage]:
    """Opens pages. The test fails if any of them has errors at its end."""
    pages: list[MonitoredPage] = []
    folder = os.environ.get("BELIEFSCOPE_SCREENSHOTS")
    screenshots = Path(folder) if folder else tmp_path_factory.getbasetemp() / "screenshots"

    def open_(
        link: str = "",
        url: str = "",
        size: tuple[int, int] = (1024, 768),
        theme: str = "light",
        clipboard: bool = False,
        scene: bool = False,
    ) -> MonitoredPage:
        if clipboard:
            context.grant_permissions(["clipboard-read", "clipboard-write"])
        if not url and "task=" not in link and (link or not scene):
            link = f"{link or '?'}&task=door"  # other links open the first example
        page = MonitoredPage(context.new_page(), url or server.url, screenshots)
        page.page.set_viewport_size({"width": size[0], "height": size[1]})
        page.page.emulate_media(color_scheme=theme)
        pages.append(page)
        return page.open(link, scene)

    yield open_
    errors = [error for page in pages for error in page.errors]
    for page in pages:
        page.page.evaluate("() => localStorage.clear()")  # the theme
        page.page.close()
    context.clear_permissions()
    context.clear_cookies()
    assert not errors
