import tempfile
from contextlib import closing
from pathlib import Path

from beliefscope.app.cli import options as opt
from beliefscope.app.cli.commands.serve import Served
from beliefscope.datasets.errors import BadInput


def mcp(
    served: Served,
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
    if url:
        opt.check_url(url)
    from beliefscope.app.runs.trace_store import TraceStore
    from beliefscope.app.server.assistant import Assistant, build_server

    with tempfile.TemporaryDirectory(prefix="beliefscope-") as workspace:
        settings = served.settings(Path(workspace), seed=seed, particles=particles)
        with closing(TraceStore(settings)) as store:
            if problems := store.problems():
                raise BadInput("; ".join(problems))
            build_server(Assistant(store, url and f"{url.rstrip('/')}/")).run()
