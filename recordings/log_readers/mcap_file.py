"""MCAP: messages in JSON, and messages of ROS 2 (CDR)."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any

from beliefscope.datasets.errors import BadInput
from beliefscope.recordings.log_readers import ros_types


@contextmanager
def open_log(path: Path, timeline: str | None) -> Iterator[McapLog]:
    """The log in a file. The time of a message is its log time."""
    with path.open("rb") as stream:
        yield McapLog(stream)


@dataclass
class McapLog:
    """An open MCAP file."""

    stream: IO[bytes]
    second: float | None = 1e9
    timeline: str = ""

    def __post_init__(self) -> None:
        from mcap.exceptions import McapError
        from mcap.reader import make_reader

        try:
            summary = make_reader(self.stream).get_summary()
        except (McapError, struct.error, OSError) as error:
            reason = str(error)[:100] or type(error).__name__
            raise BadInput(
                f"not a complete MCAP file ({reason:.100}); `mcap recover` repairs a truncated one"
            ) from None
        if summary is None or not (summary.channels or summary.statistics):
            raise BadInput("the file has no summary of its topics; `mcap recover` adds it")
        if not summary.channels:
            raise BadInput("the file has no topics")
        self.topics = tuple(sorted({channel.topic for channel in summary.channels.values()}))

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[str, int, Callable[[], Any]]]:
        """Topic, log time in ns and decoder of each message, in the order of log times."""
        from mcap.reader import make_reader

        self.stream.seek(0)
        for schema, channel, message in make_reader(self.stream, validate_crcs=True).iter_messages([*topics]):
            yield channel.topic, message.log_time, partial(_decode, schema, channel, message)


def _decode(schema: Any, channel: Any, message: Any) -> Any:
    encoding = channel.message_encoding
    if encoding == "json":
        return json.loads(message.data)
    if encoding == "cdr" and schema is not None and schema.encoding == "ros2msg":
        return ros_types.decode(schema.name, schema.data.decode(), message.data)
    kind = f"{encoding} with schema {schema.encoding!r}" if schema is not None else encoding
    raise BadInput(f"topic {channel.topic!r} is encoded as {kind}, expected json, or cdr with schema 'ros2msg'")
