"""Failure search over data sets."""

from beliefscope.inspect.failures.events import find_failures

__all__ = ["find_failures"]
