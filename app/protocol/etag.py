"""Responses with an ETag, for browser caches."""

from collections.abc import Callable

from starlette.requests import Request
from starlette.responses import Response

REVALIDATE = "no-cache"
IMMUTABLE = "public, max-age=31536000, immutable"


def tagged(
    request: Request, tag: str, content: Callable[[], bytes], media_type: str, cache_control: str = REVALIDATE
) -> Response:
    """The content with its ETag, or 304 if the browser's copy is current."""
    headers = {"etag": f'"{tag}"', "cache-control": cache_control}
    if headers["etag"] in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=headers)
    return Response(content(), media_type=media_type, headers=headers)
