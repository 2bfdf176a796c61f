"""ROS 2 bags: folders with metadata.yaml, and single storage files (sqlite3)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from beliefscope.recordings.logs import ros_types


@contextmanager
def open_log(path: Path, timeline: str | None) -> Iterator[BagLog]:
    """The log in a bag with the storage sqlite3 or mcap. The time of a message is that of its recording."""
    from rosbags.rosbag2 import Reader

    with Reader(path) as reader:
        yield BagLog(reader)


@dataclass
class BagLog:
    """An open bag."""

    reader: Any
    second: float | None = 1e9
    timeline: str = ""

    def __post_init__(self) -> None:
        self.topics = tuple(sorted({connection.topic for connection in self.reader.connections}))

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[str, int, Callable[[], Any]]]:
        """Topic, time in ns and decoder of each message, in the order of times."""
        connections = [connection for connection in self.reader.connections if connection.topic in topics]
        for connection, time, data in self.reader.messages(connections):
            yield connection.topic, time, partial(_decode, connection, data)


def _decode(connection: Any, data: bytes) -> Any:
    from rosbags.interfaces import MessageDefinitionFormat

    kind, text = connection.msgdef.format, connection.msgdef.data
    return ros_types.decode(connection.msgtype, text if kind == MessageDefinitionFormat.MSG else "", data)
