"""Logs of messages: topics with their own rates, resampled on one clock.

The ticks of the clock are the whole multiples of the map's ``dt``, or the messages of its topic ``clock``. At each
tick, a column has the value of the topic's last message at or before it (zero-order hold).
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from beliefscope.datasets.errors import BadInput, unknown_name
from beliefscope.datasets.text import percent
from beliefscope.recordings.log_readers.arrays import Columns, check_size
from beliefscope.recordings.log_readers.column_map import ColumnMap, base_name
from beliefscope.recordings.log_readers.images import image_of, is_image

Ticks = NDArray[np.int64]

LONGEST = 10_000_000
"""Largest number of ticks."""

SAMPLE = 100
"""Messages per topic in a preview. The first ``DECODED`` are decoded."""

DECODED = 3

CLOCK = "clock"
"""Column of the times of the steps."""

NEW = "new message of "
"""Before the name of a column: whether its topic has had a message since the step before."""

DELAY = "delay of the estimate"
"""Column of the s from the state of each tick to the estimate that follows before the next tick; NaN without one."""

LATE = 0.2
"""Delay, as a share of a step, up to which an estimate is probably that of the tick before it."""

AGE = "age"
"""Field of every topic: s since its last message."""


class Preview(NamedTuple):
    """First messages of a log.

    Attributes:
        columns: with few rows. intervals: topic -> median s between messages, 0 if unknown. timeline: empty if there is
            no choice.
    """

    columns: Columns
    intervals: Mapping[str, float] = {}
    timeline: str = ""


class MessageLog(Protocol):
    """An open log.

    Attributes:
        topics: names. second: units of time per second: 10^9 for ns; None: the unit is a step. timeline: its name, if
            the log has several, else empty.
    """

    topics: Sequence[str]
    second: float | None
    timeline: str

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[str, int, Callable[[], Any]]]:
        """Topic, time, and function that decodes the message: numbers, text, arrays, and nested messages.

        Messages of a topic should be in the order of their times; then only the used ones are decoded.
        """


@dataclass
class Series:
    """Messages of a topic: the last one before each tick.

    Attributes:
        topic: its name. paths: column -> fields that lead to its value. times: of the messages. values: column -> their
            values.
    """

    topic: str
    paths: Mapping[str, list[str]]
    times: list[int] = field(default_factory=list)
    values: dict[str, list[Any]] = field(default_factory=dict)
    pending: tuple[int, int, Callable[[], Any]] | None = None

    def add(self, tick: int, time: int, decode: Callable[[], Any]) -> None:
        """Add a message whose first tick is ``tick``."""
        if self.pending and self.pending[0] != tick:
            self.flush()
        self.pending = tick, time, decode

    def flush(self) -> None:
        """Decode the last message."""
        if self.pending:
            _, time, decode = self.pending
            message = decoded(self.topic, decode)
            self.times.append(time)
            for name, path in self.paths.items():
                if path != [AGE] or AGE in entries_of(message):
                    self.values.setdefault(name, []).append(value_at(message, path, name))
            self.pending = None


def decoded(topic: str, decode: Callable[[], Any]) -> Any:
    """A decoded message. Raises BadInput with the topic: the libraries raise errors of every type."""
    try:
        return decode()
    except BadInput:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise BadInput(f"a message of topic {topic!r} cannot be decoded: {reason:.150}") from None


def on_clock(log: MessageLog, mapping: ColumnMap) -> Columns:
    """The columns of a map at the ticks of the clock.

    The first tick is the first at which every topic of state, sensors, control, estimate and episode has a message;
    covariates are missing (NaN, empty text) before their first. The last tick is the first after the last message of
    the state's topics, or of all topics if the state is unknown. The column ``CLOCK`` has the times of the ticks, s
    since the first one, ``NEW`` before a name whether its topic has had a message since the tick before, ``DELAY`` how
    late the estimates are.

    Raises BadInput for unknown topics and fields, topics without messages or whose times do not overlap, more than
    ``LONGEST`` ticks, and values of different shapes.
    """
    if mapping.dt is None and not (mapping.clock and log.second):
        raise BadInput(
            "the topics have their own rates: the map needs dt, s per step of the common clock, or clock, a topic with "
            "one message per step"
        )
    series = {topic: Series(topic, paths) for topic, paths in _paths(log.topics, mapping.references).items()}
    clock = _Clock(log, mapping)
    for topic, time, decode in log.messages([*series]):
        series[topic].add(clock.tick(time), time, decode)
    ticks = {}
    for topic, entry in series.items():
        entry.flush()
        if not entry.times:
            raise BadInput(f"topic {topic!r} has no message")
        ticks[topic] = np.array([clock.tick(time) for time in entry.times], np.int64)
    first, last = _ends(ticks, _topics(log.topics, mapping.required), _topics(log.topics, mapping.truth))
    steps = clock.between(first, last)
    columns: dict[str, NDArray[Any]] = {CLOCK: (clock.times(steps) - clock.times(steps[:1])) / (log.second or 1.0)}
    for topic, entry in series.items():
        order = np.argsort(entry.times, kind="stable")
        index = np.searchsorted(ticks[topic][order], steps, side="right") - 1
        for name in entry.paths:
            if name not in entry.values:  # the age
                times = np.array(entry.times, np.int64)[order]
                values = (clock.times(steps) - times[index]) / (log.second or 1.0)
                columns[name] = np.where(index < 0, np.nan, values)
            else:
                columns[name] = _held(_stacked(name, entry.values[name]), order, index, name)
            columns[NEW + name] = np.diff(index, prepend=-1) > 0
    if log.second and (estimates := _topics(log.topics, mapping.estimated)):
        published = _next_time(series, ticks, min(estimates), steps)
        held = [_last_time(series, ticks, topic, steps) for topic in _topics(log.topics, mapping.truth)]
        columns[DELAY] = (published - np.min(held or [clock.times(steps)], axis=0)) / log.second
    return columns


def _last_time(series: Mapping[str, Series], ticks: Mapping[str, Ticks], topic: str, steps: Ticks) -> Ticks:
    """(T,) time of the topic's last message at or before each tick."""
    index = np.searchsorted(np.sort(ticks[topic]), steps, side="right") - 1
    return np.sort(series[topic].times)[index]


def _next_time(
    series: Mapping[str, Series], ticks: Mapping[str, Ticks], topic: str, steps: Ticks
) -> NDArray[np.float64]:
    """(T,) time of the topic's message between each tick and the next; NaN without one."""
    own = np.sort(ticks[topic])
    index = np.minimum(np.searchsorted(own, steps, side="right"), len(own) - 1)
    return np.where(own[index] == steps + 1, np.sort(series[topic].times)[index], np.nan)


def late_estimates(columns: Columns, mapping: ColumnMap) -> str:
    """A warning if most estimates are published just after the tick of their state, else empty."""
    if DELAY not in columns or len(columns[DELAY]) < 2:
        return ""
    delays, step = columns[DELAY][:-1], float(np.median(np.diff(columns[CLOCK])))
    late = delays[delays <= LATE * step]
    if len(late) <= len(delays) / 2:
        return ""
    return (
        f"{percent(len(late) / len(delays))} of the estimates are published just after the tick of their state "
        f"(typically {1e3 * np.median(late):.2g} ms), so they are one step old at the ticks. To pair them with their "
        f"state, make their topic the clock of the map, in place of {mapping.clock or 'dt'}"
    )


class _Clock:
    """Ticks: whole multiples of ``dt``, or the messages of the map's ``clock``, by their number."""

    def __init__(self, log: MessageLog, mapping: ColumnMap) -> None:
        self._dt = mapping.dt or 0.0
        self._step = max(round(self._dt * log.second), 1) if log.second else 1
        self._own: list[int] = []
        if mapping.clock:
            topic = _topic(log.topics, mapping.clock)
            self._own = sorted({time for _, time, _ in log.messages([topic])})
            if not self._own:
                raise BadInput(f"clock {topic!r} has no message")

    def tick(self, time: int) -> int:
        """The first tick that is not before a time; the number of ticks if there is none."""
        return bisect_left(self._own, time) if self._own else -(-time // self._step)

    def times(self, ticks: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.array(self._own, np.int64)[ticks] if self._own else ticks * self._step

    def between(self, first: int, last: int) -> NDArray[np.int64]:
        """(T,) ticks from the first to the last. Raises BadInput for none and for too many."""
        last = min(last, len(self._own) - 1) if self._own else last
        if last < first:
            raise BadInput("clock has no message while the topics of state and sensors have some")
        if last - first >= LONGEST:
            raise BadInput(f"the log has {last - first + 1} steps of {self._dt:g} s, more than {LONGEST}: increase dt")
        return np.arange(first, last + 1)


def _ends(ticks: Mapping[str, NDArray[np.int64]], required: set[str], truth: set[str]) -> tuple[int, int]:
    """First and last tick of the steps."""
    first = max((int(ticks[topic].min()) for topic in required), default=min(int(t.min()) for t in ticks.values()))
    last = min((int(ticks[topic].max()) for topic in truth), default=max(int(t.max()) for t in ticks.values()))
    if last < first:
        raise BadInput(f"the topics of state and sensors do not overlap in time: {', '.join(sorted(required))}")
    for topic in sorted(required):  # the only message of a topic may be a constant, the last one valid until the next
        own = np.unique(ticks[topic])
        if len(own) > 1 and own[-1] + np.diff(own).max() < first:
            later = max(required, key=lambda other: int(ticks[other].min()))
            raise BadInput(f"topic {topic!r} ends before {later!r} begins: they do not overlap in time")
    return first, last


def _held(values: NDArray[Any], order: NDArray[np.intp], index: NDArray[np.intp], name: str) -> NDArray[Any]:
    """(T, ...) value at each tick; missing where ``index`` is -1: NaN, empty text, and zeros for images."""
    check_size(name, (len(index), *values.shape[1:]), values.dtype)
    held, missing = values[order[index]], index < 0
    if not missing.any():
        return held
    if held.dtype.kind in "iub" and held.ndim < 3:
        held = held.astype(np.float64)
    held[missing] = "" if held.dtype.kind == "U" else np.nan if held.dtype.kind == "f" else 0
    return held


def _stacked(name: str, values: Sequence[Any]) -> NDArray[Any]:
    shapes = sorted({np.shape(value) for value in values})
    if len(shapes) > 1:
        raise BadInput(f"column {name!r} has values of the shapes {', '.join(map(str, shapes[:4]))}, expected one")
    array = np.asarray(values)
    if array.dtype.kind not in "fiubU":
        wrong = next((value for value in values if np.asarray(value).dtype.kind not in "fiubU"), values[0])
        raise BadInput(f"column {name!r} has neither numbers nor text, such as {str(wrong)!r:.50}")
    return array


def _paths(topics: Sequence[str], references: set[str]) -> dict[str, dict[str, list[str]]]:
    """Topic -> column -> fields. A column is a topic, or a topic and fields, joined by dots."""
    paths: dict[str, dict[str, list[str]]] = {}
    for name in sorted(map(base_name, references)):
        topic = _topic(topics, name)
        paths.setdefault(topic, {})[name] = name[len(topic) + 1 :].split(".") if name != topic else []
    if not paths:
        raise BadInput("the map names no column")
    return paths


def _topic(topics: Sequence[str], name: str) -> str:
    matches = [topic for topic in topics if name == topic or name.startswith(f"{topic}.")]
    if not matches:
        raise unknown_name("topic in column", name, topics)
    return max(matches, key=len)


def _topics(topics: Sequence[str], references: set[str]) -> set[str]:
    return {_topic(topics, base_name(reference)) for reference in references}


def value_at(message: Any, path: Sequence[str], name: str) -> NDArray[Any]:
    """The value of a message at a path of fields; of a nested message, all of its numbers in the order of its fields.

    A path through a list of M messages gives M values. Raises BadInput for a field that does not exist.
    """
    for depth, part in enumerate(path):
        if isinstance(message, list | tuple):
            return np.array([value_at(item, path[depth:], name) for item in message])
        entries = entries_of(message)
        if part not in entries:
            raise unknown_name(f"field of column {name!r}", part, entries)
        if part == "data" and is_image(entries):
            return image_of(entries)
        message = entries[part]
    return _numbers(message)


def _numbers(value: Any) -> NDArray[Any]:
    if isinstance(value, list | tuple):
        return np.array([_numbers(item) for item in value])
    entries = entries_of(value)
    if not entries:
        return np.asarray(np.nan if value is None else value)
    if len(entries) == 1:
        return _numbers(next(iter(entries.values())))
    parts = [_numbers(item) for item in entries.values()]
    return np.concatenate([part.ravel() for part in parts if part.dtype.kind in "fiub"])


def entries_of(message: Any) -> Mapping[str, Any]:
    """Fields of a message; empty for a number, a text or an array."""
    return message if isinstance(message, dict) else {}


def leaves(message: Any, name: str) -> Iterator[tuple[str, NDArray[Any]]]:
    """Columns of a message with numbers, text and images, and their values; without lists of messages."""
    entries = entries_of(message)
    if not entries:
        if not (isinstance(message, list | tuple) and any(map(entries_of, message))):
            yield name, np.asarray(np.nan if message is None else message)
    elif is_image(entries) and "data" in entries:
        yield f"{name}.data", image_of(entries)
    else:
        for key, value in entries.items():
            yield from leaves(value, f"{name}.{key}")


def preview(log: MessageLog) -> Preview:
    """The first messages of every topic. Topics that cannot be decoded are left out; raises BadInput if none can."""
    times: dict[str, list[int]] = {topic: [] for topic in log.topics}
    values: dict[str, list[NDArray[Any]]] = {}
    problem = BadInput("the log has no message")
    for topic, time, decode in log.messages(log.topics):
        times[topic].append(time)
        if len(times[topic]) <= DECODED:
            try:
                for name, value in leaves(decoded(topic, decode), topic):
                    values.setdefault(name, []).append(value)
            except BadInput as error:
                problem = error
        elif all(len(t) >= SAMPLE for t in times.values()):
            break
    if not values:
        raise problem
    usable = {n: v for n, v in values.items() if len({i.shape for i in v}) == 1 and v[0].size}
    stacked = {name: np.asarray(value) for name, value in usable.items()}
    intervals = {t: float(np.median(np.diff(v))) / (log.second or 1.0) if len(v) > 1 else 0.0 for t, v in times.items()}
    return Preview({n: v for n, v in stacked.items() if v.dtype.kind in "fiubU"}, intervals, log.timeline)
