"""The C library's memory, kept between updates."""

import ctypes
import sys

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""glibc's names for what ``mallopt`` sets: how much is kept at most, and from which size on blocks are the system's."""

KEPT_BYTES = 256 << 20
LARGEST_KEPT_BLOCK = 32 << 20
"""The most that glibc takes [bytes]."""


def keep_freed_memory() -> None:
    """Keep freed memory for the next update instead of giving it back to the system and asking for it again.

    Each page that comes back costs a fault, at every update anew. glibc only; other C libraries stay as they are.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, LARGEST_KEPT_BLOCK)
        mallopt(M_TRIM_THRESHOLD, KEPT_BYTES)
