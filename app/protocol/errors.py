"""Errors with their own HTTP status."""

from beliefscope.datasets.errors import BadInput


class InProgress(Exception):
    """The requested runs are being computed (202). Argument: completed fraction, 0..1."""


class NotFound(BadInput):
    """The requested object does not exist, or no longer (404)."""


class NameTaken(BadInput):
    """Another file has the name (409)."""


class QueueFull(BadInput):
    """The queue has reached its limit; the request may be repeated later (429)."""
