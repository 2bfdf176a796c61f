"""``beliefscope serve``"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beliefscope.app import console
from beliefscope.app.commands.given import Seed, is_code, whole
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
    open_page: Annotated[bool, typer.Option("--open/--no-open", help="Open the page in a browser.")] = False,
    seed: Seed = 0,
) -> None:
    """Serve the page: replay, maps and weights.

    Shows the filters and the episodes that ship, and before them those that are given. Prints the page's address on
    one line once it listens; Ctrl-C ends it. For the page of another machine, leave the host as it is and forward
    the port: ssh -L 8000:127.0.0.1:8000 MACHINE.

    \b
    Examples:
      beliefscope serve --open
      beliefscope serve --port 0 --workspace ~/beliefscope
      beliefscope serve --data mit_push --filter mine.safetensors
      beliefscope serve --study study
      beliefscope serve --task door --filter examples/04_own_filter.py:build
      beliefscope serve --task examples/own_task.py:TASK --data own.h5 --filter own.safetensors
    """
    from beliefscope.app.library import Settings
    from beliefscope.app.server import serve as serve_until_signal
    from beliefscope.app.shelf import SAMPLE, short_names
    from beliefscope.app.study import SHIPPED, Study
    from beliefscope.datasets.catalog import TASKS, load_task
    from beliefscope.filters.catalog import filters_of
    from beliefscope.filters.foreign import load_foreign

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

    named = [load_task(name).name for name in task or ()]
    code = [name for name in filter_ or () if is_code(name)]
    paths = [Path(name) for name in filter_ or () if not is_code(name)]
    foreign = [load_foreign(name, unsaid=named[0] if len(named) == 1 else "") for name in code]
    shipped = {name for known in TASKS.values() for name in filters_of(known)}
    settings = Settings(
        workspace=workspace,
        data=short_names(data or (), {SAMPLE}),
        checkpoints={**short_names(paths, shipped), **{one.name: one for one in foreign}},
        hosts=(host,),
        seed=seed,
        tasks=tuple(task or ()),
        studies=short_names(study or (), {SHIPPED}),
    )
    for name, folder in settings.studies.items():
        Study(name, folder, checkpoints=True).read()  # or it is not served
    serve_until_signal(settings, host=host, port=port, listening=listening)
