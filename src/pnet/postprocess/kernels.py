"""Who does the heavy steps: numba's kernels on the CPU, Triton's on CUDA, plain torch anywhere else.

A step is a plain torch function under `@step`. A kernel has its name and its arguments, stands in `cpu/` or
`cuda/`, and is imported at its first use.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum
from functools import wraps
from importlib import import_module
from typing import Any, TypeVar, cast

from torch import Tensor

from pnet.ops.operators import has_toolkit

Function = TypeVar("Function", bound=Callable[..., object])


class Kernels(Enum):
    """What the steps run; kernels by their folder."""

    NUMBA = "cpu"
    TRITON = "cuda"
    PLAIN = ""


STEPS: dict[str, tuple[Kernels, ...]] = {}  # which kernels each step has
_forced: list[Kernels] = []  # the last one counts


def kernels_for(tensor: Tensor) -> Kernels:
    """What serves a tensor's device."""
    if _forced:
        return _forced[-1]
    match tensor.device.type:
        case "cpu":
            return Kernels.NUMBA
        case "cuda" if has_toolkit("cuda"):
            return Kernels.TRITON
    return Kernels.PLAIN


@contextmanager
def only(kernels: Kernels) -> Iterator[None]:
    """Run these whatever the device, in this whole process: to compare, or to find a fault."""
    _forced.append(kernels)
    try:
        yield
    finally:
        _forced.pop()


def step(module: str, *known: Kernels) -> Callable[[Function], Function]:
    """Let kernels take a plain function's place where they can; its first argument tells the device.

    Args:
        module: the file that has them, in each folder. known: which there are.
    """

    def decorate(plain: Function) -> Function:
        STEPS[plain.__name__] = known

        @wraps(plain)
        def run(tensor: Tensor, *args: Any) -> object:
            kernels = kernels_for(tensor)
            if kernels not in known:
                return plain(tensor, *args)
            found = import_module(f"pnet.postprocess.{kernels.value}.{module}")
            return getattr(found, plain.__name__)(tensor, *args)

        return cast(Function, run)

    return decorate
