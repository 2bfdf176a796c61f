"""The process's memory: what is let go of goes back to the system, so that hours of use leave nothing behind."""

from __future__ import annotations

import ctypes
import gc
from contextlib import suppress

_ARENA_MAX, _HEAPS = -8, 2


def few_heaps() -> None:
    """glibc gives every few threads a heap of their own; what is freed in one is of no use to the others.

    To be called before there are threads. Elsewhere than on glibc nothing happens.
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").mallopt(_ARENA_MAX, _HEAPS)


def settle() -> None:
    """What is there by now stays: ``give_back`` need not look through it each time."""
    gc.collect()
    gc.freeze()


def give_back() -> None:
    """Collects garbage, which is all that finds a closed scene: viser's handles and its server know each other.

    Takes some 10 ms.
    """
    gc.collect()
    with suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)
