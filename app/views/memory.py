"""Memory management of the server process, so that memory use stays constant over hours."""

import ctypes
import gc
from contextlib import suppress

_M_ARENA_MAX, _MAX_ARENAS = -8, 2


def limit_malloc_arenas() -> None:
    """Limit the number of glibc heaps, because threads cannot reuse memory that was freed in another heap.

    Call this before any thread starts. Has no effect without glibc.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").mallopt(_M_ARENA_MAX, _MAX_ARENAS)


def freeze_heap() -> None:
    """Exclude all current objects from later garbage collections, until ``gc.unfreeze``."""
    gc.collect()
    gc.freeze()


def release_memory() -> None:
    """Collect garbage, which includes closed scenes, and return free memory to the system. Takes about 10 ms."""
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)
