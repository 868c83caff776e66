"""Freed memory stays with the process, for its next arrays.

The C library gives an array of more than some megabytes back to the system when it is freed, and
the system clears each page anew for the next one: of arrays of 10 to 36 MB, plain arithmetic took
three to six times as long, and a refinement of 1,490 poses an eighth of its time.
"""

import ctypes
import sys

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Options of glibc's mallopt, <malloc.h>."""
_KEPT = 256 << 20
"""Bytes that stay when they are free; a choice, small beside what a refinement needs."""
_OWN = 64 << 20
"""Bytes from which on an array has pages of its own, which go back at once; a choice."""


def keep_freed_memory() -> None:
    """Ask glibc for it; other C libraries have no such option, and nothing is done."""
    if sys.platform != "linux":
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return
    mallopt(_MMAP_THRESHOLD, _OWN)
    mallopt(_TRIM_THRESHOLD, _KEPT)
