"""``beliefscope doctor``"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from beliefscope.app.cli import output
from beliefscope.app.cli.options import Json, check, whole


def doctor(
    workspace: Annotated[
        Path, typer.Option("--workspace", metavar="DIR", help="Folder that a server would keep things in.")
    ] = Path("workspace"),
    host: Annotated[str, typer.Option("--host", help="Address that a server would listen on.")] = "127.0.0.1",
    port: Annotated[
        int, typer.Option("--port", parser=whole(0, 65535), metavar="N", help="Port that a server would listen on.")
    ] = 8000,
    json: Json = None,
) -> None:
    """Check this installation, and say what to do.

    Each part is tried: packages and their versions, PyTorch, the simulation and its camera, the hashes of what ships,
    the page's files, the port, the workspace and its disk. Ends with 1 where something fails that is needed. The JSON
    goes into a bug report; it holds no names of users.

    \b
    Examples:
      beliefscope doctor
      beliefscope doctor --workspace runs --port 9000
      beliefscope doctor --json -
    """
    from beliefscope.app.cli.checks import Place, examined, report

    check(None, json)
    found = examined(Place(workspace, host, port))
    lines = []
    for name, one in found.items():
        lines.append(f"{one.state:<8}{name:<11}{one.says}")
        lines += [f"{'':<19}-> {one.do}"] if one.do else []
    failed = sum(one.state == "failed" for one in found.values())
    lines += ["", f"{failed} of {len(found)} failed" if failed else "All that is needed is there."]
    output.result(report(found), "\n".join(lines), json)
    if failed:
        raise typer.Exit(1)
