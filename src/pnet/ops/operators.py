"""How an operator comes to its kernels.

Each operator is a `torch.library` custom operator `pnet::…`, so autograd, export and torch.compile know it.
The function under `@operator` is its plain torch reference and runs on any device; a faster kernel for a
device registers beside it (`@kernel(operator, "cpu")`, "cuda") and is imported at its first use.
"""

import os
import shutil
import sysconfig
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol, TypeVar, cast

import torch
from torch import Tensor

Function = TypeVar("Function", bound=Callable[..., object])


class Operator(Protocol):
    """What is used of torch's private `CustomOpDef`."""

    def __call__(self, *args: Any) -> Any: ...

    def register_kernel(self, device: str) -> Callable[[Function], Function]: ...

    def register_fake(self, function: Function) -> Function: ...

    def register_autograd(self, backward: Any, *, setup_context: Any) -> None: ...

    def set_kernel_enabled(self, device: str, enabled: bool) -> AbstractContextManager[None]: ...


OPERATORS: dict[str, Operator] = {}
TOOLKITS = {"cpu": "numba", "cuda": "triton"}  # what compiles a device's kernels
KERNELS: dict[str, list[str]] = {device: [] for device in TOOLKITS}  # the operators that have one there


def operator(reference: Callable[..., object]) -> Operator:
    """Make a plain torch function the operator `pnet::<its name>`."""
    name = reference.__name__.strip("_")
    made = cast(Operator, torch.library.custom_op(f"pnet::{name}", reference, mutates_args=()))
    OPERATORS[name] = made
    return made


def kernel(made: Operator, device: str) -> Callable[[Function], Function]:
    """Register a device's kernel of an operator; without its toolkit the reference goes on to serve it."""

    def register(function: Function) -> Function:
        if not has_toolkit(device):
            return function
        KERNELS[device].append(next(name for name, known in OPERATORS.items() if known is made))
        return made.register_kernel(device)(function)

    return register


@cache
def has_toolkit(device: str) -> bool:
    """Whether a device's kernels can be compiled.

    Triton comes with CUDA builds of torch for Linux, not with others. It builds its launcher with a C
    compiler and Python's headers, which a slim container lacks.
    """
    if find_spec(TOOLKITS[device]) is None:
        return False
    compilers = (os.environ.get("CC") or "gcc", "clang")
    header = Path(sysconfig.get_paths()["include"]) / "Python.h"
    return device != "cuda" or (header.is_file() and any(map(shutil.which, compilers)))


def all_operators() -> dict[str, Operator]:
    """Every operator by its name; their modules register them, and their kernels, when they are imported."""
    from pnet.ops import gathering, grouping, neighbours, sampling  # noqa: F401

    return OPERATORS


@contextmanager
def plain_operators() -> Iterator[None]:
    """Run the references instead of the kernels, in this whole process: to compare, or to find a fault."""
    operators = all_operators()
    with ExitStack() as stack:
        for device, names in KERNELS.items():
            for name in names:
                stack.enter_context(operators[name].set_kernel_enabled(device, enabled=False))
        yield


def squared_distance(a: Tensor, b: Tensor) -> Tensor:
    """(..., 3), (..., 3) → (...), summed in the order of the kernels, so that rounding is the same."""
    d = a - b
    return d[..., 0] * d[..., 0] + d[..., 1] * d[..., 1] + d[..., 2] * d[..., 2]


def squared(radius: float, points: Tensor) -> float:
    """The radius' square as a number of the points' precision: all kernels compare with the same one."""
    if not radius > 0:
        raise ValueError(f"the radius is {radius}, expected more than 0 metres")
    return float(torch.tensor(radius * radius, dtype=points.dtype))


def check_clouds(**clouds: Tensor) -> None:
    """Raise ValueError where a cloud is not (B, N, 3), has no point or (on a CPU) is not finite; names it."""
    for name, cloud in clouds.items():
        if cloud.ndim != 3 or cloud.shape[2] != 3 or 0 in cloud.shape:
            raise ValueError(f"{name}: shape {tuple(cloud.shape)}, expected (B, N, 3), at least one point")
        if not cloud.is_floating_point() or cloud.element_size() < 4:
            raise ValueError(f"{name} is {cloud.dtype}, expected float32 or float64")
        looked_at = cloud.device.type == "cpu" and not torch.compiler.is_compiling()  # numbers are there
        if looked_at and not bool(torch.isfinite(cloud).all()):
            raise ValueError(f"{name} has NaN or infinite coordinates")
    if len({(len(cloud), cloud.dtype) for cloud in clouds.values()}) > 1:
        kinds = ", ".join(f"{name} {tuple(cloud.shape)} {cloud.dtype}" for name, cloud in clouds.items())
        raise ValueError(f"the clouds differ in number or type: {kinds}")
