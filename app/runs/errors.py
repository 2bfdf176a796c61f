"""Errors of the running server that are not mistakes in a request."""

from beliefscope.datasets.errors import BadInput


class QueueFull(BadInput):
    """The queue has reached its limit; the request may be repeated later."""
