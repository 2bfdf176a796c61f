"""Messages of ROS 2, decoded with the definitions of their types in the log."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any

from beliefscope.datasets.errors import BadInput

LONG_ARRAY = re.compile(r"\[(?:<=)?\s*\d{6,}")
"""An array whose size makes the generated decoder too long."""


def decode(name: str, definition: str, data: bytes) -> dict[str, Any]:
    """A CDR message: fields -> numbers, text, arrays and nested messages.

    Args:
        name: of the type, such as ``nav_msgs/msg/Odometry``. definition: ``.msg`` text of the type and of the types it
            uses; empty for the standard types of ROS 2.
    """
    name = name if "/msg/" in name else name.replace("/", "/msg/")
    store = _store(name, definition)
    return _fields(store, store.deserialize_cdr(data, name))


def _fields(store: Any, value: Any) -> Any:
    if isinstance(value, list):
        return [_fields(store, item) for item in value]
    if (name := getattr(value, "__msgtype__", None)) is None:
        return value
    return {field: _fields(store, getattr(value, field)) for field, _ in store.get_msgdef(name).fields}


@lru_cache(maxsize=100)
def _store(name: str, definition: str) -> Any:
    """Types of a definition. Each has its own store, so that only the types in use need valid definitions."""
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
