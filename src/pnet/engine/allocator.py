"""How the process keeps the memory that tensors give back."""

import ctypes
import sys

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4  # of glibc's mallopt(3)


def keep_freed_memory() -> bool:
    """Let the C library keep what is freed for the next tensor, instead of returning it to the system.

    A training step on a CPU allocates the same large tensors again and again; glibc asks the system for each
    of them anew, and every page is filled with zeros before its first use. The price is that the process
    holds its peak, and that its heap may get holes.

    Returns:
        whether it was done: on Linux with glibc only.
    """
    if sys.platform != "linux":
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):  # another C library
        return False
    return mallopt(M_MMAP_MAX, 0) == 1 and mallopt(M_TRIM_THRESHOLD, -1) == 1
