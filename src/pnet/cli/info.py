"""pnet-info: versions, devices, kernels, caches and folders, for a bug report."""

import os
from collections.abc import Iterator
from pathlib import Path

from omegaconf import DictConfig
from rich.table import Table

from pnet.cli.app import config_dir, run_app
from pnet.cli.fit import NEEDED_ON_CUDA

EXTRAS = ("triton", "mujoco", "hydra-submitit-launcher", "OpenEXR", "h5py")  # beside what provenance names


def main() -> None:
    """Entry point."""
    run_app(info, "info")


def info(cfg: DictConfig) -> None:
    """Print what results, and their speed, depend on."""
    from rich.console import Console

    from pnet.engine.provenance import package_versions, provenance

    table = Table(show_header=False)
    state = provenance(seed=0)
    packages = {**state.pop("packages"), **package_versions(EXTRAS)}
    for key in ("seed", "device"):
        state.pop(key)
    rows = {**state, "configs": config_dir(), **dict(devices()), **dict(caches()), **packages}
    for name, value in rows.items():
        table.add_row(str(name), str(value))
    console = Console(soft_wrap=True)
    console.print(table)
    console.print(kernel_table())


def devices() -> Iterator[tuple[str, str]]:
    """The processor, and each GPU that torch can use or why there is none."""
    import torch

    from pnet.engine.precision import Precision
    from pnet.ops.operators import has_toolkit

    bf16 = "bf16" if Precision.of("auto", "cpu") is Precision.BF16 else "no bf16"
    yield "cpu", f"{os.cpu_count()} cores, {torch.get_num_threads()} threads, {bf16} in hardware"
    if not torch.cuda.is_available():
        built = torch.version.cuda
        yield (
            "gpu",
            f"none found, torch is built for CUDA {built}" if built else "none (a CPU build of torch)",
        )
        return
    if not has_toolkit("cuda"):
        yield "gpu kernels", f"none: they need {NEEDED_ON_CUDA}"
    for i in range(torch.cuda.device_count()):
        card = torch.cuda.get_device_properties(i)
        memory, capability = f"{card.total_memory / 2**30:.0f} GiB", f"{card.major}.{card.minor}"
        yield f"gpu {i}", f"{card.name}, {memory}, compute capability {capability}, CUDA {torch.version.cuda}"


def caches() -> Iterator[tuple[str, str]]:
    """Where compiled kernels are kept; a folder that is deleted is filled again."""
    import pnet.ops.cpu
    import pnet.postprocess.cpu

    own = os.environ.get("NUMBA_CACHE_DIR", "")
    beside = [Path(room.__path__[0]) / "__pycache__" for room in (pnet.ops.cpu, pnet.postprocess.cpu)]
    for folder in [Path(own)] if own else beside:
        yield f"numba's cache, {folder.parent.parent.name}", _size(folder)
    home = Path.home() / ".triton" / "cache"
    yield "triton's cache", _size(Path(os.environ.get("TRITON_CACHE_DIR", home)))


def kernel_table() -> Table:
    """What runs each operator and each step on each device: a compiled kernel, or plain torch."""
    import torch

    import pnet.postprocess.pipeline  # noqa: F401  its steps register
    from pnet.ops.operators import KERNELS, TOOLKITS, all_operators
    from pnet.postprocess.kernels import STEPS

    titles = {"cpu": "cpu", "cuda": "cuda" if torch.cuda.is_available() else "cuda (no card here)"}
    table = Table("operator or step", *titles.values(), title="kernels (ops=reference runs none of them)")
    for name in all_operators():
        table.add_row(name, *(TOOLKITS[d] if name in KERNELS[d] else "plain torch" for d in titles))
    for name, known in STEPS.items():
        served = {kernels.value for kernels in known}
        table.add_row(name, *(TOOLKITS[d] if d in served and KERNELS[d] else "plain torch" for d in titles))
    return table


def _size(folder: Path) -> str:
    if not folder.is_dir():
        return f"{folder} (not there yet)"
    total = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    return f"{folder} ({total / 2**20:.1f} MiB)"


if __name__ == "__main__":
    main()
