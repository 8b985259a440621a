"""One process at a time works on a folder."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

NO_WAIT = "PNET_NO_WAIT"  # environment: raise `Busy` instead of waiting


def lock_path(folder: Path) -> Path:
    """The lock's file: beside the folder, which may not be there yet, whatever path leads to it."""
    folder = folder.resolve()
    return folder.parent / f".{folder.name}.lock"


class Busy(OSError):  # noqa: N818  a state more than an error
    """Another process works on the folder, and this one was told not to wait (by `NO_WAIT`)."""


@contextmanager
def hold(folder: Path, waiting: str) -> Iterator[None]:
    """Hold a folder's lock; the system gives it back when the process ends, however it ends.

    Args:
        folder: need not exist. waiting: what to tell while another process holds it.
    """
    path = lock_path(folder)
    path.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(path)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        if os.environ.get(NO_WAIT):
            raise Busy(waiting) from None
        print(f"{waiting}; waiting for it to end", file=sys.stderr)
        lock.acquire()
    try:
        yield
    finally:
        lock.release()
