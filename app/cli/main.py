"""The ``beliefscope`` command.

Ends with 0, 1 (failed) or 2 (bad input), the last two with one line on standard error. What a command needs is imported
when it runs, so that ``--help`` answers at once.
"""

from __future__ import annotations

import io
import sys
from contextlib import suppress
from typing import Annotated

import typer

from beliefscope import __version__
from beliefscope.app.cli import output
from beliefscope.app.cli.commands.change import change
from beliefscope.app.cli.commands.collect import collect
from beliefscope.app.cli.commands.convert import convert
from beliefscope.app.cli.commands.counterfactual import counterfactual
from beliefscope.app.cli.commands.doctor import doctor
from beliefscope.app.cli.commands.evaluate import evaluate
from beliefscope.app.cli.commands.export import export
from beliefscope.app.cli.commands.failures import failures
from beliefscope.app.cli.commands.faults import faults
from beliefscope.app.cli.commands.figure import figure
from beliefscope.app.cli.commands.finetune import finetune
from beliefscope.app.cli.commands.import_ import restore
from beliefscope.app.cli.commands.inspect import inspect
from beliefscope.app.cli.commands.lineage import lineage
from beliefscope.app.cli.commands.live import live
from beliefscope.app.cli.commands.modules import modules
from beliefscope.app.cli.commands.record import record
from beliefscope.app.cli.commands.report import report
from beliefscope.app.cli.commands.serve import serve
from beliefscope.app.cli.commands.study import study
from beliefscope.app.cli.commands.trace import trace
from beliefscope.app.cli.commands.train import train
from beliefscope.datasets.errors import BadInput

COMMANDS = (
    serve,
    collect,
    convert,
    train,
    finetune,
    modules,
    change,
    lineage,
    evaluate,
    study,
    trace,
    record,
    live,
    restore,
    export,
    inspect,
    report,
    counterfactual,
    figure,
    failures,
    faults,
    doctor,
)

cli = typer.Typer(
    name="beliefscope",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for command in COMMANDS:
    cli.command()(command)


def main() -> None:
    """Runs the command that ``sys.argv`` names and ends the process."""
    debug = "--debug" in sys.argv[1:]
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # as standard error: names of files may be no text
    try:
        code = cli(prog_name="beliefscope", standalone_mode=False)
        output.written()
    except typer.TyperException as error:
        asked = getattr(getattr(error, "ctx", None), "command_path", "beliefscope")
        output.fail(f"{error.format_message().rstrip('.')}. See: {asked} --help", error.exit_code)
    except (typer.Abort, KeyboardInterrupt):
        output.fail("interrupted", 130)
    except Exception as error:
        if debug:
            raise
        if isinstance(error, BadInput):
            output.fail(str(error), 2)
        with suppress(OSError):
            output.written()
        if isinstance(error, BrokenPipeError):  # who reads has read enough, as ``head`` does
            raise SystemExit(1) from None
        output.fail(f"{type(error).__name__}: {error} (beliefscope --debug ... shows where)", 1)
    raise SystemExit(code)


@cli.callback(invoke_without_command=True)
def beliefscope(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show where an error comes from.")] = False,
) -> None:
    """Look inside multimodal differentiable filters: beliefs, fusion weights and likelihood maps.

    \b
    Start here:
      beliefscope serve          the page, with the filters and episodes that ship

    \b
    From a simulator to a recording:
      beliefscope collect door --episodes 60 --steps 800 -o door.h5
      beliefscope train door --filter crossmodal-pf --data door.h5 -o mine.safetensors
      beliefscope evaluate door --filter mine.safetensors --data door.h5
      beliefscope record door --filter mine.safetensors --data door.h5 -o run.rrd

    Each command explains itself with --help. Exit codes: 0 done, 1 failed, 2 bad input.
    """
    if version:
        print(f"beliefscope {__version__}")
    elif context.invoked_subcommand is None:
        print(context.get_help())
