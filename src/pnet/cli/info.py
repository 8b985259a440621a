"""pnet-info: versions, devices, kernels, caches and folders, for a bug report."""

import os
from collections.abc import Iterator
from pathlib import Path

from omegaconf import DictConfig
from rich.table import Table

from pnet.cli.app import config_dir, run_app

EXTRAS = ("triton", "mujoco", "hydra-submitit-launcher", "OpenEXR", "h5py")  # beside what provenance names


def main() -> None:
    """Entry point."""
    run_app(info, "info")


def info(cfg: DictConfig) -> None:
    """Print what results, and their speed, depend on."""
    from importlib.metadata import PackageNotFoundError, version

    from rich.console import Console

    from pnet.engine.provenance import provenance

    table = Table(show_header=False)
    state = provenance(seed=0)
    packages = state.pop("packages")
    for key in ("seed", "device"):
        state.pop(key)
    for name in EXTRAS:
        try:
            packages[name] = version(name)
        except PackageNotFoundError:
            packages[name] = "absent"
    rows = {**state, "configs": config_dir(), **dict(devices()), **dict(caches()), **packages}
    for name, value in rows.items():
        table.add_row(str(name), str(value))
    console = Console(soft_wrap=True)
    console.print(table)
    console.print(kernel_table())


def devices() -> Iterator[tuple[str, str]]:
    """The processor, and each GPU that torch can use or why there is none."""
    import torch

    bf16 = "bf16 in hardware" if torch.cpu._is_avx512_bf16_supported() else "no bf16 in hardware"
    yield "cpu", f"{os.cpu_count()} cores, {torch.get_num_threads()} threads, {bf16}"
    if not torch.cuda.is_available():
        built = torch.version.cuda
        yield (
            "gpu",
            f"none found (torch is built for CUDA {built})" if built else "none (a CPU build of torch)",
        )
        return
    for i in range(torch.cuda.device_count()):
        card = torch.cuda.get_device_properties(i)
        memory, capability = f"{card.total_memory / 2**30:.0f} GiB", f"{card.major}.{card.minor}"
        yield f"gpu {i}", f"{card.name}, {memory}, compute capability {capability}, CUDA {torch.version.cuda}"


def caches() -> Iterator[tuple[str, str]]:
    """Where compiled kernels are kept; a folder that is deleted is filled again."""
    import pnet.ops.cpu

    beside = Path(pnet.ops.cpu.__file__).parent / "__pycache__"
    home = Path.home()
    yield "numba's cache", _size(Path(os.environ.get("NUMBA_CACHE_DIR", beside)))
    yield "triton's cache", _size(Path(os.environ.get("TRITON_CACHE_DIR", home / ".triton" / "cache")))


def kernel_table() -> Table:
    """What runs each operator on each device: a compiled kernel, or the reference in plain torch."""
    from pnet.ops import gathering, grouping, neighbours, sampling  # noqa: F401  they register
    from pnet.ops.operators import KERNELS, OPERATORS, TOOLKITS

    table = Table("operator", *KERNELS, title="kernels (ops=reference runs none of them)")
    for name in OPERATORS:
        table.add_row(name, *(TOOLKITS[d] if name in KERNELS[d] else "reference" for d in KERNELS))
    return table


def _size(folder: Path) -> str:
    if not folder.is_dir():
        return f"{folder} (not there yet)"
    total = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return f"{folder} ({total / 2**20:.1f} MiB)"


if __name__ == "__main__":
    main()
