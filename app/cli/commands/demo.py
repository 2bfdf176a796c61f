import tempfile
from pathlib import Path

from beliefscope.app.cli import options as opt


def demo(
    port: int = opt.option("N", "Port; 0 selects a free one.", 0, parser=opt.integer(0, 65535)),
    open_page: bool = opt.flag("Open the dashboard in a browser.", "--open/--no-open", default=True),
) -> None:
    """Open the dashboard on an example.

    Serves the pretrained filters and the sample data from a temporary workspace, which is deleted at the end, and opens
    the page in a browser: the camera goes dark while a robot pushes a puck. Stop it with Ctrl-C. For your own filters
    and data, use beliefscope serve.

    \b
    Example:
      beliefscope demo --no-open --port 8000
    """
    from beliefscope.app.cli.commands.serve import serve_page
    from beliefscope.app.runs.settings import Settings
    from beliefscope.app.server import logs

    logs.configure()
    with tempfile.TemporaryDirectory(prefix="beliefscope-") as workspace:
        serve_page(Settings(Path(workspace)), port=port, open_page=open_page)
