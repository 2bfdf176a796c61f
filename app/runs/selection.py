"""What is being looked at: a run by its names, and its trace."""

from __future__ import annotations

import re
import threading
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NotYet
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any
from urllib.parse import parse_qsl

from beliefscope.app.protocol.map_format import WiredMaps, wire_maps
from beliefscope.app.protocol.messages import MAP_SIZES, columns, header
from beliefscope.datasets.errors import BadInput, one_of
from beliefscope.datasets.faults.injection import WHOLE, Faults
from beliefscope.filters.checkpoint import Checkpoint
from beliefscope.inspect.likelihood import LikelihoodMap, MapEngine, no_maps
from beliefscope.inspect.trace import Trace, arrays_of
from beliefscope.inspect.traces.replay import Edit

COARSE, FINE = MAP_SIZES
MAPS_IN_MEMORY = 12 << 20  # bytes a trace: 300 coarse ones


STEM = 150  # letters of a file's name that are its filter's


@dataclass(frozen=True)
class Selection:
    """What is being looked at: names of a task and a filter, an episode's index, how its sensors are broken.

    Data: name of the data set; empty for the task's first. Edit: what is changed over some steps of the run.
    """

    task: str
    filter: str
    episode: int
    faults: Faults = WHOLE
    data: str = ""
    edit: Edit | None = None

    @property
    def told(self) -> str:
        """The run in words."""
        return f"{self.filter}, {self.task} episode {self.episode}" + (f", {self.faults}" if self.faults else "")

    @property
    def stem(self) -> str:
        """For names of its files. Names of filters may hold anything, since they may come out of a file."""
        return f"{re.sub(r'[^A-Za-z0-9_.+-]', '-', f'{self.task}-{self.filter}')[:STEM]}-episode{self.episode}"

    def to_json(self) -> dict[str, Any]:
        """As JSON values, for another process."""
        edit = None if self.edit is None else self.edit.to_json()
        return {**vars(self), "faults": self.faults.to_json(), "edit": edit}

    @classmethod
    def of_json(cls, shown: Mapping[str, Any]) -> Selection:
        """What ``to_json`` gave."""
        edit = None if shown["edit"] is None else Edit.of(shown["edit"])
        return cls(**{**shown, "faults": Faults.of(shown["faults"]), "edit": edit})

    def against(self, text: str) -> Selection:
        """The other run that this one is compared with, from what is different about it.

        ``filter=NAME``, ``faults=FAULTS`` (none where empty) or both; or an edit over some steps, ``from=20&to=40``
        with ``faults=FAULTS``, ``weights=MODALITY=BETA`` or both. Raises BadInput for anything else, and the same run.
        """
        given = dict(parse_qsl(text, keep_blank_values=True))
        if given.keys() & {"from", "to", "weights"}:
            return replace(self, edit=Edit.parse(text))
        for key in given:
            if key not in ("filter", "faults"):
                raise one_of("part of the other run", key, ("filter", "faults", "from", "to", "weights"))
        faults = Faults.parse(given["faults"]) if "faults" in given else self.faults
        other = replace(self, filter=given.get("filter", self.filter), faults=faults)
        if other == self:
            raise BadInput(f"{text!r} is the run that is shown, not another")
        return other


class Traced:
    """A trace that is being computed, or is there; and what is derived from it.

    Attributes:
        key: hash of everything the trace depends on: checkpoint, episode, seed, particles, faults.
        done: the trace, or the error that computing it ended in. progress: 0..1.
        shown: what a scene that is there already can go on showing: the key, or that of all states of a live run.
        grows: whether it is of a live run, and more steps may come (``app/runs/live_runs.py``).
    """

    grows = False

    def __init__(self, key: str, checkpoint: Checkpoint) -> None:
        self.key = self.shown = key
        self.checkpoint = checkpoint
        self.done: Future[Trace] = Future()
        self.done.set_running_or_notify_cancel()  # so that who stops waiting for it cannot cancel it
        self.progress = 0.0
        self._maps = threading.Lock()
        self._keeping = threading.Lock()
        self._kept: OrderedDict[tuple[int, float | None, int], WiredMaps] = OrderedDict()
        self._kept_bytes = 0

    def result(self, timeout: float | None = None) -> Trace:
        """Waits for it. Raises what computing it raised; TimeoutError (of ``concurrent.futures``) after so many s."""
        return self.done.result(timeout)

    def ready(self, timeout: float) -> bool:
        """Whether it is there after so many s. Raises what computing it raised."""
        try:
            self.done.result(timeout)
        except NotYet:
            return False
        return True

    @property
    def trace(self) -> Trace:
        """Waits for it. Raises what computing it raised."""
        return self.result()

    def __len__(self) -> int:
        """Steps."""
        return len(self.trace)

    def at(self, step: int) -> tuple[Trace, int]:
        """A trace in which the step is, and its index there."""
        return self.trace, step

    @cached_property
    def no_maps(self) -> str | None:
        """Why there are no likelihood maps, in one line; None where there are."""
        return no_maps(self.checkpoint, self.trace)

    def header(self) -> dict[str, Any]:
        """What the page must know of the trace before it reads its columns."""
        return header(self.trace, self.columns[0], self.checkpoint.task, self.no_maps)

    @cached_property
    def columns(self) -> tuple[list[dict[str, Any]], bytes]:
        """The trace's numbers as the page wants them: descriptions and one buffer."""
        return columns(self.trace)

    def map(self, step: int, angle: float | None, size: int) -> LikelihoodMap:
        """One likelihood map; one at a time a trace, because its engine keeps caches."""
        with self._maps:
            return self._engine.map(step, angle=angle, size=size)

    def wired(self, step: int, angle: float | None, size: int) -> WiredMaps:
        """The same as it is sent; the last ones are kept, for others who look there and for a hand that goes back."""
        key = step, angle, size
        with self._keeping:
            known = self._kept.get(key)
            if known is not None:
                self._kept.move_to_end(key)
                return known
        made = wire_maps(self.checkpoint.task, *self.at(step), self.map(step, angle, size))
        with self._keeping:
            if key not in self._kept:
                self._kept[key] = made
                self._kept_bytes += made.nbytes
            while self._kept_bytes > MAPS_IN_MEMORY:
                self._kept_bytes -= self._kept.popitem(last=False)[1].nbytes
        return made

    def unmade(self, step: int, angle: float | None, count: int) -> list[int]:
        """The steps, of so many next to this one, whose coarse maps ``wired`` would have to make; the nearest first."""
        near = sorted(range(max(0, step - count), min(len(self), step + count + 1)), key=lambda at: abs(at - step))
        with self._keeping:
            return [at for at in near[:count] if (at, angle, COARSE) not in self._kept]

    @property
    def nbytes(self) -> int:
        """In memory, of the trace and its maps, about; none while it is computed."""
        there = self.done.done() and self.done.exception() is None
        return self._kept_bytes + (self._trace_bytes if there else 0)

    @cached_property
    def _trace_bytes(self) -> int:
        return sum(array.nbytes for array in arrays_of(self.trace).values())

    def maps(self, steps: Iterable[int]) -> Iterator[LikelihoodMap]:
        """The fine maps at several steps; other askers get theirs in between."""
        return (self.map(step, None, FINE) for step in steps)

    @cached_property
    def _engine(self) -> MapEngine:
        return MapEngine(self.checkpoint, self.trace)
