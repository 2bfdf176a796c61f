"""Traces: run a filter over an episode and keep every step; save and load the result."""

from beliefscope.inspect.traces.data import ARRAYS, Trace, arrays_of
from beliefscope.inspect.traces.file import header_of, load_trace, save_trace, save_trace_parts, trace_from_arrays
from beliefscope.inspect.traces.run import trace, trace_parts

__all__ = [
    "ARRAYS",
    "Trace",
    "arrays_of",
    "header_of",
    "load_trace",
    "save_trace",
    "save_trace_parts",
    "trace",
    "trace_from_arrays",
    "trace_parts",
]
