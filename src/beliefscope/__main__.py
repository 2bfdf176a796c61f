"""``python -m beliefscope`` is the ``beliefscope`` command."""

from beliefscope.app.cli.main import main

if __name__ == "__main__":
    main()
