"""Compiles every kernel for a card that need not be there, and says what it takes of a processor.

Launches are replaced by compilations: Triton's compiler and the assembler that its package brings run
anywhere. So what the interpreter allows and the compiler does not is found, and spilt registers are seen.

python tests/ops/cuda/compile_only.py 90
"""

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import triton
from triton.backends.compiler import GPUTarget
from triton.runtime import driver
from triton.runtime.jit import JITFunction

BIN = Path(triton.__file__).parent / "backends" / "nvidia" / "bin"
B, N, M, K, C = 2, 16384, 4096, 32, 128  # clouds, points, centres, neighbours, channels

found: list[dict[str, Any]] = []


class Card:
    """What the launcher asks of a driver."""

    def __init__(self, capability: int) -> None:
        self._target = GPUTarget("cuda", capability, 32)

    def get_current_device(self) -> int:
        return 0

    def get_current_stream(self, device: int | None = None) -> int:
        return 0

    def get_current_target(self) -> GPUTarget:
        return self._target

    def get_active_torch_device(self) -> torch.device:
        return torch.device("cpu")


def compile_instead(function: JITFunction, grid: object) -> Callable[..., None]:
    """In place of a launch."""

    def launch(*arguments: object, **options: object) -> None:
        kernel = function.warmup(*arguments, grid=grid, **options)
        found.append({"kernel": function.__name__, **resources(kernel), "shared": kernel.metadata.shared})

    return launch


def resources(kernel: Any) -> dict[str, Any]:
    """Registers and bytes of spilled ones of a thread; whether products and sums are fused anywhere."""
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(kernel.asm["cubin"])
        file.flush()
        text = subprocess.run(
            [str(BIN / "cuobjdump"), "-res-usage", file.name], capture_output=True, text=True, check=True
        ).stdout
    words = dict(word.split(":", 1) for word in text.split() if word.count(":") == 1)
    fused = any(word in kernel.asm["ptx"] for word in ("fma.rn.f32", "fma.rn.f64"))
    return {"registers": int(words["REG"]), "stack": int(words["STACK"]), "fused": fused}


def run_all() -> None:
    """Every kernel with the sizes of a paper's scene, in each number type that it serves."""
    for dtype in (torch.float32, torch.bfloat16, torch.float64):
        run_gathering(dtype)
    for dtype in (torch.float32, torch.float64):
        run_searches(dtype)
    run_postprocessing()


def run_gathering(dtype: torch.dtype) -> None:
    """Rows by a table, and back."""
    from pnet.ops.cuda import gathering, grouping, scattering

    rows, index = torch.zeros(B, N, C, dtype=dtype), torch.zeros(B, M, K, dtype=torch.int64)
    grad, winner = torch.zeros(B, M, C, dtype=dtype), torch.zeros(B, M, C, dtype=torch.int32)
    for weight in (None, torch.ones(B, M, K)):
        gathering.gather_sum(rows, index, weight)
        scattering.scatter_sum(grad, index, weight, N)
    gathering.gather_max(rows, index)
    scattering.scatter_max(grad, winner, index, N)
    grouping.group_max(torch.zeros(B, M // 4, K, C, dtype=dtype))
    grouping.ungroup_max(grad, winner, K)


def run_searches(dtype: torch.dtype) -> None:
    """Neighbours, and the order of sampling."""
    from pnet.ops.cuda import nearest, neighbours, octants, sampling

    clouds, large = (torch.rand(B, n, 3, dtype=dtype) for n in (N, 2 * N + 1))
    octants.octants(clouds, 1e-4)
    for points in (clouds, large):
        neighbours.ball_query(points, points[:, :M], 1e-3, K)
        sampling.farthest_points(points, M, 0)
    for k in (1, 3, 16):
        nearest.nearest(clouds[:, :M], clouds, k)


def run_postprocessing() -> None:
    """Seeds, modes, votes and fits, in double precision."""
    from pnet.postprocess.cuda import climb, fits, radius
    from pnet.postprocess.grouping import Groups

    points, seeds = (torch.rand(B, n, 3, dtype=torch.float64) for n in (N, 200))
    climb.climb(points, torch.ones(B, N, dtype=torch.bool), seeds, 0.01, 1e-5, 300)
    climb.distinct(seeds, torch.ones(B, 200, dtype=torch.bool), 0.01)
    climb.nearest_mode(points, seeds, torch.full((B,), 60), 0.01)
    d = 60
    groups = Groups(torch.arange(N) * d // N, torch.bincount(torch.arange(N) * d // N), N)
    radius.neighboured(points[0, :, None], groups, torch.zeros(d, 1, dtype=torch.bool), 20, 0.01)
    for keypoints in (3, 4, 5):
        fits.fit_rigid_many(
            *torch.rand(2, d, 256, keypoints, 3, dtype=torch.float64), torch.ones(d, 256, keypoints)
        )


if __name__ == "__main__":
    driver.set_active(Card(int(sys.argv[1])))
    JITFunction.__getitem__ = compile_instead
    torch.Tensor.new_empty = torch.Tensor.new_zeros  # what is not computed must still be a fair index
    torch.empty = torch.zeros
    run_all()
    print(json.dumps(found))
