"""Time and memory of the backbones, with kernels and in plain torch, and of the usual PointNet++.

Every network is the compact one of conf/model with three keypoints on a backbone of conf/backbone.

python benchmarks/bench_backbones.py
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
import usual_pointnet2 as usual
from nut_bin import COLOURS, INK, Cloud, clock, default_threads, draw_bars, load, machine, make_bin, number
from omegaconf import OmegaConf
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from pnet.backbones.base import Backbone
from pnet.cli.app import config_dir
from pnet.engine.allocator import keep_freed_memory
from pnet.models.parametricnet import ParametricNet
from pnet.models.summary import summarise
from pnet.ops.operators import plain_operators
from pnet.records import PointPrediction

BACKBONES = ("pointnet", "pointnet2", "pointnet2_msg", "pointnet2_delayed", "pointsift", "range_unet")
KEYPOINTS = 3
SIZES, BATCHES = (4096, 16384), (1, 4)
PATIENCE = 1.0  # seconds of a cell after its warm-up
PROFILED = (("range_unet", 4), ("pointsift", 4))  # on how many of the smaller clouds
TOP = 8
USUAL = "usual PointNet++"
FLOAT, SHORT, PLAIN = "float32", "bfloat16", "plain torch operators"
COLOUR = {FLOAT: COLOURS[0], SHORT: COLOURS[4], PLAIN: COLOURS[1], USUAL: COLOURS[2]}


@dataclass(frozen=True)
class Cell:
    """Milliseconds of one network in one setting; None: not measured."""

    network: str
    points: int
    batch: int
    kind: str
    forward: float
    step: float | None
    tables: float | None = None


def main() -> None:
    """Print the tables and the profiles, and draw the bars."""
    arguments = parse_arguments()
    torch.set_num_threads(arguments.threads)
    keep_freed_memory()  # as pnet-train does; it serves all networks here
    torch.manual_seed(0)
    nuts = make_bin()
    sizes, repeats = (SIZES[:1], 2) if arguments.quick else (SIZES, 7)
    networks = {name: build(load(f"backbone/{name}")) for name in BACKBONES}
    print(machine())
    print(nuts.text)
    print_costs(networks, nuts.points, sizes)
    kinds = [FLOAT, SHORT] if bfloat16_in_hardware() else [FLOAT]
    print(f"\nmilliseconds a batch: medians of at most {repeats} runs, of one where it takes more than 4 s")
    print("tables: the neighbour search alone; forward: in evaluation, tables included;")
    print("step: forward in training and backward, tables included")
    print(f"{'network':<20}{'points':>8}{'batch':>7}{'tables':>10}{'forward':>10}{'step':>10}  numbers")
    cells = []
    for cell in cells_of(networks, nuts.points, sizes, kinds, repeats):
        print_cell(cell)
        cells.append(cell)
    for name, batch in PROFILED:
        for kind in kinds:
            print_profile(name, networks[name], clouds(nuts.points, SIZES[0], batch), kind)
    arguments.out.mkdir(parents=True, exist_ok=True)
    draw(cells, sizes, arguments.out / "backbones.png")


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=default_threads())
    parser.add_argument("--quick", action="store_true", help="the smaller cloud only, two runs")
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks"), help="folder of the picture")
    return parser.parse_args()


def build(backbone: Backbone) -> ParametricNet:
    """The compact network on a backbone."""
    network: ParametricNet = load("model/compact", backbone=backbone, keypoints=KEYPOINTS)
    return network


def build_usual() -> ParametricNet:
    """The usual code with the sizes of conf/backbone/pointnet2.yaml."""
    conf: Any = OmegaConf.load(config_dir() / "backbone/pointnet2.yaml")
    levels = [(level.points, level.radius, level.neighbours, level.mlp) for level in conf.levels]
    return build(usual.UsualPointNet2(levels, conf.propagation))


def bfloat16_in_hardware() -> bool:
    return bool(torch.cpu._is_avx512_bf16_supported())


def clouds(points: Cloud, count: int, batch: int) -> Tensor:
    """(batch, count, 3) the first points, each cloud turned about its own axis of view."""
    cloud = points[:count].astype(np.float64)
    centre = cloud.mean(0)
    turned = []
    for i in range(batch):
        c, s = np.cos(i), np.sin(i)
        turned.append((cloud - centre) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + centre)
    return torch.from_numpy(np.stack(turned).astype(np.float32))


def print_costs(networks: dict[str, ParametricNet], points: Cloud, sizes: Sequence[int]) -> None:
    """What is counted and not timed."""
    heads = "".join(f"{f'G mult-adds, {n:,}':>22}{f'MiB kept, {n:,}':>20}" for n in sizes)
    print(f"\n{'network':<20}{'M parameters':>14}{heads}")
    for name, network in networks.items():
        counted = [summarise(network, torch.from_numpy(points[:n])) for n in sizes]
        row = "".join(f"{c.operations / 1e9:>22.2f}{c.kept_bytes / 2**20:>20.0f}" for c in counted)
        print(f"{name:<20}{counted[0].parameters / 1e6:>14.2f}{row}", flush=True)


def cells_of(
    networks: dict[str, ParametricNet],
    points: Cloud,
    sizes: Sequence[int],
    kinds: Sequence[str],
    repeats: int,
) -> Iterator[Cell]:
    """Everything that is timed."""
    time = partial(clock, repeats=repeats, patience=PATIENCE)
    for name, network in networks.items():
        for n in sizes:
            for batch in BATCHES:
                cloud = clouds(points, n, batch)
                tables = time(partial(network.backbone.tables, cloud)).ms
                for kind in kinds:
                    with numbers(kind):
                        forward = time(partial(evaluate, network, cloud)).ms
                        step = time(partial(train, network, cloud)).ms
                    yield Cell(name, n, batch, kind, forward, step, tables)
        for n in sizes if name == "pointnet2" else sizes[:1]:
            cloud = clouds(points, n, 1)
            with plain_operators():
                forward, step = (time(partial(run, network, cloud)).ms for run in (evaluate, train))
            yield Cell(name, n, 1, PLAIN, forward, step)
        if name == "pointnet2":
            other = build_usual()
            for n in sizes:
                cloud = clouds(points, n, 1)
                few = partial(clock, repeats=2)
                forward = few(partial(evaluate, other, cloud)).ms
                step = few(partial(train, other, cloud)).ms if n == SIZES[0] else None
                yield Cell(name, n, 1, USUAL, forward, step)


def numbers(kind: str) -> AbstractContextManager[object]:
    """The precision of matrix products."""
    return torch.autocast("cpu", torch.bfloat16) if kind == SHORT else nullcontext()


def evaluate(network: ParametricNet, cloud: Tensor) -> PointPrediction:
    """Forward in evaluation, tables included."""
    network.eval()
    with torch.no_grad():
        prediction: PointPrediction = network(cloud)
    return prediction


def train(network: ParametricNet, cloud: Tensor) -> None:
    """Forward in training and backward, tables included; the loss is the cheapest there is."""
    network.train().zero_grad()
    predicted = network(cloud)
    loss = (predicted.centroid - cloud).square().mean() + predicted.visibility.mean()
    loss = loss + (predicted.keypoints - cloud[..., None, :]).square().mean()
    loss.backward()


def print_cell(cell: Cell) -> None:
    times = "".join(
        f"{'' if ms is None else number(ms):>10}" for ms in (cell.tables, cell.forward, cell.step)
    )
    print(f"{cell.network:<20}{cell.points:>8,}{cell.batch:>7}{times}  {cell.kind}", flush=True)


def print_profile(name: str, network: ParametricNet, cloud: Tensor, kind: str) -> None:
    """Where one training step spends its time: the operators with the largest shares."""
    run: Callable[[], None] = partial(train, network, cloud)
    with numbers(kind):
        run()
        with profile(activities=[ProfilerActivity.CPU]) as recorded:
            run()
    averages = sorted(recorded.key_averages(), key=lambda entry: -entry.self_cpu_time_total)
    total = sum(entry.self_cpu_time_total for entry in averages)
    print(f"\na training step of {name} on {cloud.shape[0]} × {cloud.shape[1]:,} points, {kind}: own time")
    for entry in averages[:TOP]:
        share = entry.self_cpu_time_total / total
        print(
            f"  {entry.key:<42}{share:>8.1%}{entry.self_cpu_time_total / 1000:>9.1f} ms{entry.count:>6} calls"
        )


def draw(cells: Sequence[Cell], sizes: Sequence[int], path: Path) -> None:
    """A row for each size: forward on the left, a training step on the right; one cloud."""
    figure, rows = plt.subplots(
        len(sizes), 2, figsize=(12, 0.4 + 4.6 * len(sizes)), layout="constrained", squeeze=False
    )
    for n, row in zip(sizes, rows, strict=True):
        for what, axes in zip(("forward", "step"), row, strict=True):
            groups: dict[str, list[tuple[str, float]]] = {}
            for cell in cells:
                ms = getattr(cell, what)
                if cell.points == n and cell.batch == 1 and ms is not None:
                    groups.setdefault(cell.network, []).append((cell.kind, ms))
            draw_bars(axes, groups, COLOUR)
            title = "Forward in evaluation" if what == "forward" else "Training step"
            text = f"{title}, one cloud of {n:,} points; threads: {torch.get_num_threads()}"
            axes.set_title(text, fontsize=10, color=INK, loc="left")
    figure.savefig(path, dpi=150)
    print(f"\n{path}")


if __name__ == "__main__":
    main()
