from pathlib import Path

from beliefscope.app.cli import options as opt
from beliefscope.datasets.errors import BadInput


def mcp(
    task: list[str] | None = opt.option("FILE.py:NAME", "Custom task. Repeatable.", None),
    data: list[Path] | None = opt.option("FILE|DIR", "Additional episodes. Repeatable.", None),
    filter: list[str] | None = opt.option("CHECKPOINT|MODULE:BUILD", "Additional filter. Repeatable.", None),
    url: str = opt.option("URL", "Address of a running dashboard, for the links in answers.", ""),
    particles: int = 300,
    seed: int = 0,
) -> None:
    """Answer an assistant's questions about runs.

    A server of the Model Context Protocol on standard input and output, started by the assistant. Its tools explain a
    run, list the worst events, diagnose faults, read values and draw figures, for the pretrained filters, the sample
    data and those given here. It only reads, and opens no network connection. Needs: pip install 'beliefscope[mcp]'.

    \b
    Examples:
      beliefscope mcp
      beliefscope mcp --data door.h5 --filter mine.safetensors --url http://127.0.0.1:8000
    """
    from beliefscope.app.cli.commands.serve import filters_of_command_line
    from beliefscope.app.runs.catalog import SAMPLE, short_names, task_catalogs
    from beliefscope.app.server.assistant import Assistant, build_server
    from beliefscope.datasets.catalog import load_task

    checkpoints = filters_of_command_line(filter or (), task or (), data or ())
    own = opt.own_definitions(data or ())
    tasks = [own.get(name) or load_task(name) for name in task or ()]
    catalogs, problems = task_catalogs(checkpoints, short_names(data or (), {SAMPLE}), tasks)
    if problems:
        raise BadInput("; ".join(problems))
    base = url and f"{url.rstrip('/')}/"
    build_server(Assistant(catalogs, base, seed, particles)).run()
