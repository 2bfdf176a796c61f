"""Message types of ROS 2: from their definitions in the log to decoded messages."""

from __future__ import annotations

import re
from typing import Any

from beliefscope.datasets.errors import BadInput

LONG_ARRAY = re.compile(r"\[(?:<=)?\s*\d{6,}")
"""An array whose size makes the generated decoder too long."""


class RosTypes:
    """Decodes CDR messages. Each type has its own store, so that only the types in use need valid definitions."""

    def __init__(self) -> None:
        self._stores: dict[tuple[str, str], Any] = {}

    def decode(self, name: str, definition: str, data: bytes) -> Any:
        """A message as a dataclass of numbers, text, arrays and nested messages.

        Args:
            name: of the type, such as ``nav_msgs/msg/Odometry``. definition: ``.msg`` text of the type and those that
                it uses; empty for the standard types of ROS 2.
        """
        store = self._stores.get((name, definition))
        if store is None:
            store = self._stores[name, definition] = _store(name, definition)
        return store.deserialize_cdr(data, name)


def _store(name: str, definition: str) -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    if not definition:
        store = get_typestore(Stores.LATEST)
        if name not in store.fielddefs:
            raise BadInput(f"the log has no definition of the message type {name!r}, which is not a standard one")
        return store
    if match := LONG_ARRAY.search(definition):
        raise BadInput(f"the definition of the message type {name!r} has an array of the size {match[0][1:]}")
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, name))
    return store
