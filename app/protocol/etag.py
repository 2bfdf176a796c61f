"""Answers that a browser keeps: each with a tag that says what is in it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from typing import Any

from starlette.requests import Request
from starlette.responses import Response

ASK_AGAIN = "no-cache"
FOREVER = "public, max-age=31536000, immutable"


def tagged(
    request: Request, tag: str, content: Callable[[], bytes], media_type: str, kept: str = ASK_AGAIN
) -> Response:
    """The content with its ETag, or 304 where the browser has it already. Kept: its ``cache-control``."""
    headers = {"etag": f'"{tag}"', "cache-control": kept}
    if headers["etag"] in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    return Response(content(), media_type=media_type, headers=headers)


def tagged_json(request: Request, shown: Any) -> Response:
    """The same of a JSON value, whose tag is its hash."""
    body = json.dumps(shown).encode()
    return tagged(request, hashlib.sha256(body).hexdigest()[:24], lambda: body, "application/json")
