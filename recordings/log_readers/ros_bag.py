"""ROS 2 bags: folders with metadata.yaml, and single storage files (sqlite3)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from beliefscope.recordings.log_readers import ros_types

STORAGES = (".db3", ".mcap")
"""Suffixes of the files of a bag."""


@contextmanager
def open_log(path: Path, timeline: str | None) -> Iterator[BagLog]:
    """The log in a bag with the storage sqlite3 or mcap. The time of a message is that of its recording."""
    from rosbags.rosbag2 import Reader

    with ExitStack() as stack:
        bag = stack.enter_context(Reader(path))
        if path.is_dir() and not bag.compression_mode:
            # The topics of metadata.yaml may differ from those in the files, and then have no messages.
            files = sorted(file for file in path.iterdir() if file.suffix in STORAGES)
            yield BagLog([stack.enter_context(Reader(file)) for file in files])
        else:
            yield BagLog([bag])


@dataclass
class BagLog:
    """An open bag. readers: of its files."""

    readers: Sequence[Any]
    second: float | None = 1e9
    timeline: str = ""

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of the topics."""
        return tuple(sorted({connection.topic for reader in self.readers for connection in reader.connections}))

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[str, int, Callable[[], Any]]]:
        """Topic, time in ns and decoder of each message, in the order of files and times."""
        for reader in self.readers:
            connections = [connection for connection in reader.connections if connection.topic in topics]
            for connection, time, data in reader.messages(connections) if connections else ():
                yield connection.topic, time, partial(_decode, connection, data)


def _decode(connection: Any, data: bytes) -> Any:
    from rosbags.interfaces import MessageDefinitionFormat

    kind, text = connection.msgdef.format, connection.msgdef.data
    return ros_types.decode(connection.msgtype, text if kind == MessageDefinitionFormat.MSG else "", data)
