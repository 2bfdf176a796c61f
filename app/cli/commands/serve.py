"""``beliefscope serve``"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from beliefscope.app.cli import output
from beliefscope.app.cli.options import Seed, is_code, whole
from beliefscope.datasets.errors import BadInput, one_of


def serve(
    port: Annotated[
        int, typer.Option("--port", parser=whole(0, 65535), metavar="N", help="0 takes any free one.")
    ] = 8000,
    host: Annotated[
        str, typer.Option("--host", help="Address to listen on; one that others can reach demands a token.")
    ] = "127.0.0.1",
    token: Annotated[
        bool, typer.Option("--token", help="Demand a token on this machine too, where others work on it.")
    ] = False,
    read_only: Annotated[
        bool, typer.Option("--read-only", help="Show, but let nobody write, compute, train or delete anything.")
    ] = False,
    allow_host: Annotated[
        list[str] | None,
        typer.Option("--allow-host", metavar="NAME", help="Another name of this machine; may be given again."),
    ] = None,
    workspace: Annotated[
        Path, typer.Option("--workspace", metavar="DIR", help="Folder for recordings and traces; made if missing.")
    ] = Path("workspace"),
    task: Annotated[
        list[str] | None,
        typer.Option("--task", metavar="FILE.py:NAME", help="A task of your own to show; may be given again."),
    ] = None,
    data: Annotated[
        list[Path] | None,
        typer.Option("--data", metavar="FILE|DIR", help="Episodes to show beside those that ship; may be given again."),
    ] = None,
    filter_: Annotated[
        list[str] | None,
        typer.Option(
            "--filter",
            "--checkpoint",
            metavar="CHECKPOINT|MODULE:BUILD",
            help="A filter to show beside those that ship; may be given again. One of your own (docs/own_filter.md) is "
            "for the task that it names, or the one that --task does.",
        ),
    ] = None,
    study: Annotated[
        list[Path] | None,
        typer.Option("--study", metavar="DIR", help="Folder of a study to show; may be given again."),
    ] = None,
    views: Annotated[
        int,
        typer.Option("--views", parser=whole(1, 1024), metavar="N", help="Pages that may be open at a time."),
    ] = 32,
    open_page: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in a browser.")] = False,
    log_level: Annotated[
        str, typer.Option("--log-level", metavar="LEVEL", help="On standard error: debug, info, warning or error.")
    ] = "warning",
    log_format: Annotated[str, typer.Option("--log-format", metavar="NAME", help="text or json.")] = "text",
    seed: Seed = 0,
) -> None:
    """Serve the page: replay, maps and weights.

    Shows the filters and the episodes that ship, and before them those that are given. Prints the page's address on
    one line once it listens; Ctrl-C ends it. For the page of another machine, leave the host as it is and forward
    the port: ssh -L 8000:127.0.0.1:8000 MACHINE. With --host others can reach it too: the address that is printed then
    holds a token, without which nobody is let in. BELIEFSCOPE_TOKEN in the environment is one of your own.
    docs/security.md has what guards against what, docs/operations.md what a server needs that runs for days.

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
    from beliefscope.app.api.studies import SHIPPED, Study
    from beliefscope.app.runs.catalog import SAMPLE, short_names
    from beliefscope.app.runs.trace_store import Settings
    from beliefscope.app.server import logs
    from beliefscope.app.server.auth import LOOPBACK, Access, names_of, token_for
    from beliefscope.app.server.main import serve as serve_until_signal
    from beliefscope.datasets.catalog import TASKS, load_task
    from beliefscope.filters.catalog import filters_of
    from beliefscope.filters.external.load import load_foreign

    check_workspace(workspace)

    for what, value, available in (("log level", log_level, logs.LEVELS), ("log format", log_format, logs.FORMATS)):
        if value not in available:
            raise one_of(what, value, available)
    access = Access(token_for(host, token, os.environ), read_only)
    logs.begin(log_level, log_format, access.token)

    named = [load_task(name).name for name in task or ()]
    code = [name for name in filter_ or () if is_code(name)]
    paths = [Path(name) for name in filter_ or () if not is_code(name)]
    foreign = [load_foreign(name, unsaid=named[0] if len(named) == 1 else "") for name in code]
    shipped = {name for known in TASKS.values() for name in filters_of(known)}
    settings = Settings(
        workspace=workspace,
        data=short_names(data or (), {SAMPLE}),
        checkpoints={**short_names(paths, shipped), **{one.name: one for one in foreign}},
        hosts=(*names_of(host), *(allow_host or ())),
        seed=seed,
        views=views,
        tasks=tuple(task or ()),
        studies=short_names(study or (), {SHIPPED}),
    )
    for name, folder in settings.studies.items():
        Study(name, folder, checkpoints=True).read()  # or it is not served
    with _opening(workspace, bool(access.token)) as open_in_browser:

        def listening(url: str) -> None:
            if host not in LOOPBACK:
                output.say(
                    "warning: others can reach this server: who has its link can use it, and all goes unencrypted"
                )
            print(f"Beliefscope is at {url} (Ctrl-C ends it)", flush=True)
            if open_page:
                open_in_browser(url)

        serve_until_signal(settings, host=host, port=port, listening=listening, access=access)
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # it has ended in peace; Python takes another moment for its own end


@contextmanager
def _opening(workspace: Path, secret: bool) -> Iterator[Callable[[str], None]]:
    """Gives what opens an address in the user's browser.

    Where the address holds a token it goes through a file that only this user can read: every other user of the machine
    sees what a browser is started with.
    """
    import webbrowser

    from beliefscope.app.server.auth import onward_page

    page = workspace / f".open-{os.getpid()}.html"

    def open_(url: str) -> None:
        if not secret:
            webbrowser.open(url)
            return
        with open(os.open(page, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
            file.write(onward_page(url))
        webbrowser.open(page.resolve().as_uri())

    try:
        yield open_
    finally:
        page.unlink(missing_ok=True)


def check_workspace(workspace: Path) -> None:
    """Raises BadInput where it is no folder, and none can be made there."""
    if workspace.exists() and not workspace.is_dir():
        raise BadInput(f"workspace {str(workspace)!r} is a file, not a folder")
    if not workspace.absolute().parent.is_dir():
        raise BadInput(f"folder {str(workspace.parent)!r} does not exist, so {workspace.name!r} cannot be made in it")
