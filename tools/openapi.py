"""Print the server's OpenAPI document: ``python tools/openapi.py [--models]``.

With ``--models``, only the models of requests and responses, from which the page's types are generated.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from beliefscope.app.runs.settings import Settings
from beliefscope.app.server.main import create_app


def document() -> dict[str, Any]:
    """The OpenAPI document; it does not depend on settings."""
    with tempfile.TemporaryDirectory() as folder:
        return create_app(Settings(Path(folder)), warm=False).openapi()


if __name__ == "__main__":
    models: dict[str, Any] = {"paths": {}} if "--models" in sys.argv else {}
    print(json.dumps(document() | models, indent=1))
