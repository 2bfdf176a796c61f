from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from beliefscope.app.cli import console, options as opt

if TYPE_CHECKING:
    from beliefscope.app.runs.settings import Settings
    from beliefscope.app.server.auth import Access
    from beliefscope.filters.checkpoint import Checkpoint


@dataclass(frozen=True)
class Served:
    """Options for tasks, data sets and filters in addition to the included ones."""

    task: list[str] | None = opt.option("FILE.py:NAME", "Custom task. Repeatable.", None)
    data: list[Path] | None = opt.option("FILE|DIR", "Additional episodes. Repeatable.", None)
    filter: list[str] | None = opt.option(
        "CHECKPOINT|FILE.py:FUNCTION",
        "Additional filter. Repeatable. An external filter (docs/own_filter.md) is for its own task or, if it has "
        "none, for that of --task or --data.",
        None,
    )

    def settings(self, workspace: Path, **others: Any) -> Settings:
        """Settings with tasks (names, definitions in files, or names that the data define), data sets and filters.

        The page opens the first filter. others: further settings.
        """
        from beliefscope.app.runs.catalog import PRETRAINED, SAMPLE, short_names
        from beliefscope.app.runs.settings import Settings
        from beliefscope.datasets.catalog import load_task
        from beliefscope.filters.external.load import load_external
        from beliefscope.filters.names import is_code

        tasks, data, filters = self.task or (), self.data or (), self.filter or ()
        own = opt.own_definitions(data) if tasks or any(map(is_code, filters)) else {}
        given = [own.get(name) or load_task(name) for name in tasks]
        files = short_names((Path(name) for name in filters if not is_code(name)), PRETRAINED)
        names = {path.resolve(): name for name, path in files.items()}
        checkpoints: dict[str, Path | Checkpoint] = {}
        for text in filters:
            if is_code(text):
                external = load_external(text, given=given or list(own.values()), named=list(own.values()))
                checkpoints[external.name] = external
            else:
                name = names[Path(text).resolve()]
                checkpoints[name] = files[name]
        named = tuple(name for name in tasks if name not in own)
        return Settings(workspace, short_names(data, {SAMPLE}), checkpoints, tasks=named, **others)


def serve(
    *,
    port: int = opt.option("N", "Port; 0 selects a free one.", 8000, parser=opt.integer(0, 65535)),
    host: str = opt.option(
        "ADDRESS", "Address to listen on. Any but the loopback address requires a token.", "127.0.0.1"
    ),
    token: bool = opt.flag("Require a token on the loopback address too (shared machines).", "--token"),
    read_only: bool = opt.flag(
        "Read-only server: disable recording, computation, training and deletion.", "--read-only"
    ),
    allow_host: list[str] | None = opt.option("NAME", "Additional host name of this machine. Repeatable.", None),
    workspace: Path = Path("workspace"),
    served: Served,
    study: list[Path] | None = opt.option("DIR", "Folder of a study to serve. Repeatable.", None),
    sweep: list[Path] | None = opt.option("DIR", "Folder of a sweep to serve (docs/sweep.md). Repeatable.", None),
    views: int = opt.option("N", "Maximum number of open pages.", 32, parser=opt.integer(1, 1024)),
    open_page: bool = opt.flag("Open the dashboard in a browser.", "--open/--no-open"),
    log_level: Literal["debug", "info", "warning", "error"] = opt.option(
        "LEVEL", "Log level on standard error: debug, info, warning or error.", "warning"
    ),
    log_format: Literal["text", "json"] = opt.option("NAME", "Log format: text or json.", "text"),
    seed: int = 0,
) -> None:
    """Serve the dashboard: replay, maps and weights.

    Serves the pretrained filters, the sample data, and your own (--filter, --data). Prints the address once the server
    listens; stop it with Ctrl-C. To use the dashboard from another machine, keep the default host and forward the port:
    ssh -L 8000:127.0.0.1:8000 MACHINE. Alternatively, --host makes the server reachable directly; the printed address
    then contains the required token. Set BELIEFSCOPE_TOKEN in the environment to choose the token. Security:
    docs/security.md; long-running servers: docs/operations.md.

    \b
    Examples:
      beliefscope serve --open
      beliefscope serve --port 0 --workspace ~/beliefscope
      beliefscope serve --data mit_push --filter mine.safetensors
      beliefscope serve --study study
      beliefscope serve --host 0.0.0.0 --read-only --log-level info --log-format json
      beliefscope serve --task door --filter examples/04_own_filter.py:build
      beliefscope serve --task examples/own_task.py:TASK --data own.h5 --filter own.safetensors
    """
    from beliefscope.app.runs.catalog import short_names
    from beliefscope.app.server import logs
    from beliefscope.app.server.auth import Access, host_names, token_for
    from beliefscope.app.workspace.studies import BUILT_IN, Study

    opt.check_workspace(workspace)
    access = Access(token_for(host, token, os.environ), read_only)
    logs.configure(log_level, log_format, access.token)
    settings = served.settings(
        workspace,
        hosts=(*host_names(host), *(allow_host or ())),
        seed=seed,
        views=views,
        studies=short_names(study or (), {BUILT_IN}),
        sweeps=short_names(sweep or ()),
    )
    for name, folder in settings.studies.items():
        Study(name, folder, has_checkpoints=True).read()  # raises BadInput early
    if sweep:
        from beliefscope.recordings.experiments import Experiments  # DuckDB is slow to import

        Experiments(settings.sweeps.values())
    serve_page(settings, port, open_page, host, access)


def serve_page(
    settings: Settings, port: int, open_page: bool, host: str = "127.0.0.1", access: Access | None = None
) -> None:
    """Serve until a signal; opens the printed address in a browser if requested."""
    from beliefscope.app.server.auth import LOOPBACK, OPEN
    from beliefscope.app.server.main import serve as serve_until_signal

    access = access or OPEN
    with _browser_opener(settings.workspace, bool(access.token)) as open_in_browser:

        def listening(url: str) -> None:
            if host not in LOOPBACK:
                console.note("warning: anyone with the link can use this server, and the connection is not encrypted")
            if open_page:
                open_in_browser(url)

        serve_until_signal(settings, host=host, port=port, on_start=listening, access=access)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the server has stopped; do not interrupt interpreter shutdown


@contextmanager
def _browser_opener(workspace: Path, secret: bool) -> Iterator[Callable[[str], None]]:
    """Yields a function that opens an address in the user's browser.

    An address with a token is passed in a file that only this user can read, because other users of the machine can
    see the browser's command line.
    """
    import webbrowser

    from beliefscope.app.server.auth import redirect_page

    page = workspace / f".open-{os.getpid()}.html"

    def open_(url: str) -> None:
        if not secret:
            webbrowser.open(url)
            return
        with open(os.open(page, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
            file.write(redirect_page(url))
        webbrowser.open(page.resolve().as_uri())

    try:
        yield open_
    finally:
        page.unlink(missing_ok=True)
