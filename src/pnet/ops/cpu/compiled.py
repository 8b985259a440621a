"""How kernels are compiled and spread over threads."""

import os
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import torch

Function = TypeVar("Function", bound=Callable[..., object])

# Numba looks at a kernel's own file to see whether what it kept is out of date, not at the files of the
# kernels that it calls: so their content is part of the name under which it is kept.
_SOURCES = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
_VERSION = f"{zlib.crc32(_SOURCES):08x}"

_pools: dict[tuple[int, int], ThreadPoolExecutor] = {}


def kernel(function: Function) -> Function:
    """Compile for the CPU, without the interpreter's lock; kept on disk where a folder can be written."""
    function.__qualname__ += f"-{_VERSION}"
    compiled: Any
    try:
        compiled = numba.njit(nogil=True, cache=True)(function)
    except RuntimeError:  # no place for the compiled code
        compiled = numba.njit(nogil=True)(function)
    return cast(Function, compiled)


def in_parts(run: Callable[[int, int], object], count: int, least: int = 1) -> None:
    """Call run(start, stop) over the parts of range(count), in as many threads as torch uses.

    Numba's own threads are left alone: they end a forked DataLoader worker with an error.

    Args:
        run: a compiled kernel's call. count: of rows or blocks. least: rows of a part that pay for a thread.
    """
    parts = max(1, min(torch.get_num_threads(), count // least))
    edges = [count * part // parts for part in range(parts + 1)]
    others = [_pool(parts - 1).submit(run, *edges[i : i + 2]) for i in range(1, parts)]
    run(*edges[:2])
    for other in others:
        other.result()


def _pool(workers: int) -> ThreadPoolExecutor:
    """A process's own pool: threads do not live on in a forked one."""
    key = os.getpid(), max(workers, 1)
    if key not in _pools:
        _pools[key] = ThreadPoolExecutor(key[1], "pnet-ops")
    return _pools[key]
