"""``beliefscope serve``"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beliefscope.app import console
from beliefscope.app.commands.given import Seed, whole
from beliefscope.datasets.errors import BadInput

LOOPBACK = ("127.0.0.1", "localhost", "::1")


def serve(
    port: Annotated[
        int, typer.Option("--port", parser=whole(0, 65535), metavar="N", help="0 takes any free one.")
    ] = 8000,
    host: Annotated[str, typer.Option("--host", help="Address to listen on.")] = "127.0.0.1",
    workspace: Annotated[
        Path, typer.Option("--workspace", metavar="DIR", help="Folder for recordings and traces; made if missing.")
    ] = Path("workspace"),
    task: Annotated[
        list[str] | None,
        typer.Option("--task", metavar="FILE.py:NAME", help="A task of your own to show; may be given again."),
    ] = None,
    data: Annotated[
        list[Path] | None,
        typer.Option(
            "--data", metavar="FILE|DIR", help="Episodes to show instead of a task's sample set; may be given again."
        ),
    ] = None,
    filter_: Annotated[
        list[Path] | None,
        typer.Option(
            "--filter", metavar="CHECKPOINT", help="A filter to show beside those that ship; may be given again."
        ),
    ] = None,
    open_page: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in a browser.")] = False,
    seed: Seed = 0,
) -> None:
    """Serve the page: replay, maps and weights.

    Shows the filters and the episodes that ship, and what else it is given. Prints the page's address on one line once
    it listens; Ctrl-C ends it. For the page of another machine, leave the host as it is and forward the port:
    ssh -L 8000:127.0.0.1:8000 MACHINE.

    \b
    Examples:
      beliefscope serve --open
      beliefscope serve --port 0 --workspace ~/beliefscope
      beliefscope serve --data mit_push --filter mine.safetensors
      beliefscope serve --task examples/own_task.py:TASK --data own.h5 --filter own.safetensors
    """
    from beliefscope.app.library import Settings
    from beliefscope.app.server import serve as serve_until_signal

    if workspace.exists() and not workspace.is_dir():
        raise BadInput(f"workspace {str(workspace)!r} is a file, not a folder")
    if not workspace.absolute().parent.is_dir():
        raise BadInput(f"folder {str(workspace.parent)!r} does not exist, so {workspace.name!r} cannot be made in it")

    if host not in LOOPBACK:
        console.say(f"warning: whoever can reach {host} can use this page; it has no password")

    def listening(url: str) -> None:
        print(f"Beliefscope is at {url} (Ctrl-C ends it)", flush=True)
        if open_page:
            import webbrowser

            webbrowser.open(url)

    settings = Settings(
        workspace=workspace,
        data=tasks_of(data or [], task or []),
        checkpoints=named(filter_ or []),
        hosts=(host,),
        seed=seed,
    )
    serve_until_signal(settings, host=host, port=port, listening=listening)


def tasks_of(paths: list[Path], own: list[str]) -> dict[str, Path]:
    """Task -> its data. Raises BadInput for data that cannot be opened, or two of one task."""
    from beliefscope.datasets.catalog import find_task
    from beliefscope.datasets.store import open_dataset

    for name in own:
        find_task(name)
    found: dict[str, Path] = {}
    for path in paths:
        with open_dataset(path) as data:
            if data.task.name in found:
                raise BadInput(f"{str(found[data.task.name])!r} and {str(path)!r} are both of task {data.task.name!r}")
            found[data.task.name] = path
    return found


def named(paths: list[Path]) -> dict[str, Path]:
    """Filter's name, after its file -> file. Raises BadInput for one that is no checkpoint, or two of one name."""
    from beliefscope.filters.checkpoint import load_checkpoint

    found: dict[str, Path] = {}
    for path in paths:
        load_checkpoint(path)
        if path.stem in found:
            raise BadInput(f"{str(found[path.stem])!r} and {str(path)!r} would both be called {path.stem!r}")
        found[path.stem] = path
    return found
