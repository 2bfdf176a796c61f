"""The ``beliefscope`` command, also as ``python -m beliefscope``."""

import sys


def main() -> None:
    """Run the command, and exit with 130 also if Ctrl-C interrupts its imports, which take half a second."""
    try:
        from beliefscope.app.cli.main import main as run
    except KeyboardInterrupt:
        sys.stderr.write("error: interrupted\n")
        sys.exit(130)
    run()


if __name__ == "__main__":
    main()
