"""A filter run that is being computed or complete, and the values derived from its trace."""

import json
import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future, TimeoutError as FutureTimeout
from functools import cached_property
from typing import Any

import numpy as np

from beliefscope.app.protocol.map_format import EncodedMaps, encode_maps
from beliefscope.app.protocol.trace_format import columns, header
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.filters.out_of_distribution import data_warning
from beliefscope.inspect.diagnostics.healthy_comparison import no_diagnosis
from beliefscope.inspect.diagnostics.kalman_equations import wrong_equations
from beliefscope.inspect.maps.availability import missing_quantities, no_maps
from beliefscope.inspect.maps.likelihood_map import MapOptions
from beliefscope.inspect.maps.map_engine import COARSE, LikelihoodMap, MapEngine
from beliefscope.inspect.trace import Trace, arrays_of
from beliefscope.inspect.traces.restarts import FAILURE, RESTARTS

MAP_CACHE_BYTES = 12 << 20  # per trace: about 300 coarse maps
DEFAULT_MAP = MapOptions()

_computing = threading.Lock()


class TracedRun:
    """A run and its trace. Methods may be called from any thread.

    Attributes:
        key: hash of everything the trace depends on: checkpoint, episode, seed, particles, faults, intervention.
        future: the trace, or the error that ended its computation.
        progress: completed fraction, 0..1.
        scene_key: identifies what a 3D scene draws; equal for all states of a live run.
        growing: whether the run is live and may get more steps (``app/runs/live_runs.py``).
    """

    growing = False

    def __init__(self, key: str, checkpoint: Checkpoint) -> None:
        self.key = self.scene_key = key
        self.checkpoint = checkpoint
        self.future: Future[Trace] = Future()
        self.future.set_running_or_notify_cancel()  # a client that stops waiting must not cancel it
        self.progress = 0.0
        self._results: dict[str, bytes] = {}
        self._engine_lock = threading.Lock()
        self._cache_lock = threading.Lock()
        self._cache: OrderedDict[tuple[int, int, MapOptions], EncodedMaps] = OrderedDict()
        self._cache_bytes = 0

    def ready(self, timeout: float) -> bool:
        """Whether the trace is complete within ``timeout`` s. Raises the error of its computation."""
        try:
            self.future.result(timeout)
        except FutureTimeout:
            return False
        return True

    @property
    def trace(self) -> Trace:
        """The trace; waits until it is complete. Raises the error of its computation."""
        return self.future.result()

    def __len__(self) -> int:
        """Number of steps."""
        return len(self.trace)

    def at(self, step: int) -> tuple[Trace, int]:
        """A trace that contains the step, and the index of the step in it."""
        return self.trace, step

    @cached_property
    def no_maps(self) -> str | None:
        """Reason why the run has no likelihood maps; None if it has."""
        return no_maps(self.checkpoint, self.trace)

    def no_maps_at(self, step: int) -> str | None:
        """Reason why a step of the run has no likelihood maps; None if it has."""
        if self.no_maps:
            return self.no_maps
        trace, index = self.at(step)
        if not np.isfinite(trace.estimate_mean[index]).all():
            return f"No maps: the estimate at step {step} is not a finite number."
        valid = no_maps(self.checkpoint, trace, steps=[index]) is None
        return None if valid else f"No maps: a covariance at step {step} is not positive definite."

    @cached_property
    def header(self) -> dict[str, Any]:
        """Description of the trace for the page."""
        checkpoint, trace = self.checkpoint, self.trace
        missing = missing_quantities(checkpoint, trace)
        description = header(trace, self.columns[0], checkpoint.task, self.no_maps, missing)
        warning = data_warning(checkpoint, [trace.episode], trace.faults)
        reason = no_diagnosis(checkpoint)
        defects = wrong_equations([trace], checkpoint) if reason else ()  # which a diagnosis contains
        failure = {name: trace.settings[name] for name in (FAILURE, RESTARTS) if FAILURE in trace.settings} or None
        return description | {"data_warning": warning, "no_diagnosis": reason, "defects": defects, "failure": failure}

    @cached_property
    def columns(self) -> tuple[list[dict[str, Any]], bytes]:
        """Time series of the trace for the page: descriptions and one buffer."""
        return columns(self.trace)

    def map(self, step: int, size: int, options: MapOptions = DEFAULT_MAP) -> LikelihoodMap:
        """Compute one map. The map engine keeps caches, so it computes one map at a time."""
        with self._engine_lock:
            return self._engine.available_map(step, size, options)

    def encoded_maps(self, step: int, size: int, options: MapOptions = DEFAULT_MAP) -> EncodedMaps:
        """One map in its binary encoding. The most recent ones are cached for all views of the run."""
        key = step, size, options
        with self._cache_lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
        maps = encode_maps(*self.at(step), self.map(step, size, options))
        with self._cache_lock:
            if key not in self._cache:
                self._cache[key] = maps
                self._cache_bytes += maps.nbytes
            while self._cache_bytes > MAP_CACHE_BYTES:
                self._cache_bytes -= self._cache.popitem(last=False)[1].nbytes
        return maps

    def result(self, name: str, compute: Callable[[], Any]) -> bytes:
        """JSON of a fast diagnostic or another result with this name, kept with the run. One is computed at a time."""
        with _computing:
            if name not in self._results:
                self._results[name] = json.dumps(compute(), allow_nan=False).encode()
            return self._results[name]

    def missing_maps(self, step: int, count: int, options: MapOptions) -> list[int]:
        """Of the ``count`` steps nearest to ``step``, those with maps whose coarse one is not cached; nearest first."""
        near = range(max(0, step - count), min(len(self), step + count + 1))
        nearest = sorted(near, key=lambda index: abs(index - step))[:count]
        with self._cache_lock:
            missing = [index for index in nearest if (index, COARSE, options) not in self._cache]
        return [index for index in missing if not self.no_maps_at(index)]

    @property
    def nbytes(self) -> int:
        """Approximate memory of the trace, once complete, and its cached maps."""
        complete = self.future.done() and self.future.exception() is None
        return self._cache_bytes + (self._trace_bytes if complete else 0)

    @cached_property
    def _trace_bytes(self) -> int:
        return sum(array.nbytes for array in arrays_of(self.trace).values())

    @cached_property
    def _engine(self) -> MapEngine:
        return MapEngine(self.checkpoint, self.trace)
