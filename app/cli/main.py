"""Entry point of the ``beliefscope`` command.

Exit codes: 0 success, 1 failure, 2 invalid input; the last two print one line to standard error. Commands import heavy
modules only when they run, so that ``--help`` is fast.
"""

import io
import os
import signal
import sys
import warnings
from contextlib import suppress
from functools import cache
from importlib import import_module
from typing import Annotated, Any

import typer
import typer.core
import typer.main

from beliefscope import __version__
from beliefscope.app.cli import console
from beliefscope.app.cli.options import with_options
from beliefscope.datasets.errors import BadInput

GROUPS = {
    "Start": ("demo", "serve", "doctor"),
    "Causes of errors": ("diagnose", "inspect", "failures", "slices", "counterfactual"),
    "Data": ("collect", "convert", "import", "faults"),
    "Filters": ("train", "finetune", "modules", "evaluate", "calibrate"),
    "Comparisons": ("change", "lineage", "study", "sweep", "experiments"),
    "Runs": ("trace", "record", "live", "export"),
    "Publication": ("figure", "report"),
    "Assistants": ("mcp",),
}
"""Commands in the order of the help text. Each is a function of a module in ``commands`` with the same name."""

COMMANDS = tuple(name for names in GROUPS.values() for name in names)

INTERRUPTED = 130
"""Exit code after Ctrl-C, of the shell; typer returns it instead of raising the interrupt."""

TERMINATED = 128 + signal.SIGTERM
"""Exit code after SIGTERM, of the shell."""


OF_TRACES = {"inspect", "export"}
"""Commands whose arguments are traces."""

RESUMED = {"collect", "train", "finetune", "study", "sweep"}
"""Commands that continue interrupted work."""


_formatwarning = warnings.formatwarning


class CommandGroup(typer.core.TyperGroup):
    """The commands, which the help text lists by ``GROUPS``."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        width = max(map(len, COMMANDS))
        limit = formatter.width - width - 6
        for title, names in GROUPS.items():
            with formatter.section(title):
                formatter.write_dl(
                    [(name.ljust(width), self.commands[name].get_short_help_str(limit)) for name in names]
                )


class Terminated(BaseException):
    """SIGTERM: commands end as after Ctrl-C and remove their unfinished files."""


cli = typer.Typer(
    name="beliefscope",
    cls=CommandGroup,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for name in COMMANDS:
    function = "import_" if name == "import" else name
    cli.command(name)(with_options(getattr(import_module(f"beliefscope.app.cli.commands.{function}"), function)))


@cache
def command_group() -> Any:
    """The group of all commands. Kept, as building it takes longer than most errors need to be found."""
    group: Any = typer.main.get_command(cli)
    for command in group.commands.values():
        for parameter in command.params:
            if parameter.param_type_name == "argument":
                parameter.display_type_rich = lambda ctx: None  # the name of an argument states what it is
    return group


def short_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """A warning of Python; one for users in the form of a command's own, without the place in the code."""
    if not issubclass(category, UserWarning):
        return _formatwarning(message, category, filename, lineno, line)
    return f"Warning: {' '.join(str(message).split())}\n"


def main() -> None:
    """Run the command in ``sys.argv`` and exit."""
    debug = "--debug" in sys.argv[1:]
    # Waiting for each other, several threads are 20 times slower than one where other programs use the processor.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # like standard error: file names may not be valid text
    signal.signal(signal.SIGTERM, _terminate)
    if not debug:
        warnings.formatwarning = short_warning
    try:
        code = command_group()(prog_name="beliefscope", standalone_mode=False)
        if code == INTERRUPTED:
            raise KeyboardInterrupt
        console.flush()
    except typer.TyperException as error:
        command = getattr(getattr(error, "ctx", None), "command_path", "beliefscope")
        message = error.format_message().rstrip(".").replace("Value error, ", "")
        if getattr(error, "option_name", "") == "--data" and message.startswith("No such"):  # resembles no option
            reason = ": traces contain their episodes" if command.split()[-1] in OF_TRACES else ""
            message = f"No such option: --data{reason}"
        end = "" if message.endswith("?") else "."
        console.fail(f"{message}{end} See: {command} --help", error.exit_code)
    except (typer.Abort, KeyboardInterrupt):
        console.fail(f"interrupted{_resumption()}", INTERRUPTED)
    except Terminated:
        console.fail(f"terminated{_resumption()}", TERMINATED)
    except Exception as error:
        if debug:
            raise
        if isinstance(error, BadInput):
            console.fail(f"{error}; {error.advice}" if error.advice else str(error), 2)
        with suppress(OSError):
            console.flush()
        if isinstance(error, BrokenPipeError):  # the reader has closed the pipe, as ``head`` does
            raise SystemExit(1) from None
        console.fail(f"{type(error).__name__}: {error} (run beliefscope --debug ... for a traceback)", 1)
    raise SystemExit(code)


def _resumption() -> str:
    return "; the same command resumes" if RESUMED.intersection(sys.argv[1:3]) else ""


def _terminate(number: int, frame: object) -> None:
    raise Terminated


@cli.callback(invoke_without_command=True)
def beliefscope(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Print a traceback on errors.")] = False,
) -> None:
    """Inspect multimodal differentiable filters: beliefs, fusion weights and likelihood maps.

    \b
    Start here:
      beliefscope demo           open the dashboard on an example in a browser
      beliefscope serve          serve the pretrained filters, the sample data, and your own

    \b
    From a simulator to a recording:
      beliefscope collect door --episodes 60 --steps 800 -o door.h5
      beliefscope train door --filter crossmodal-pf --data door.h5 -o mine.safetensors
      beliefscope evaluate door --filter mine.safetensors --data door.h5
      beliefscope record door --filter mine.safetensors --data door.h5 -o run.rrd

    Run a command with --help for its options. Exit codes: 0 success, 1 failure, 2 invalid input.

    The paper in help texts: Lee et al., Multimodal Sensor Fusion with Differentiable Filters (IROS 2020).
    """
    if version:
        print(f"beliefscope {__version__}")
    elif context.invoked_subcommand is None:
        print(context.get_help())
