"""``python -m beliefscope`` is the ``beliefscope`` command."""

from beliefscope.app.cli import main

if __name__ == "__main__":
    main()
