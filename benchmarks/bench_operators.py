"""Time of the operators on point clouds beside plain torch, the usual PointNet++ code and other libraries.

python benchmarks/bench_operators.py
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
import usual_pointnet2 as usual
from matplotlib.axes import Axes
from nut_bin import (
    COLOURS,
    FAINT,
    INK,
    POINTS,
    Cloud,
    NutBin,
    Timing,
    clock,
    default_threads,
    draw_bars,
    machine,
    make_bin,
    number,
    plain_number,
    sampled,
    tidy,
)
from scipy.spatial import cKDTree
from sklearn.neighbors import NearestNeighbors
from torch import Tensor
from torch.nn import functional as F

from pnet.backbones.layers import RelativeDense, centred
from pnet.ops.gathering import gather_max, gather_rows, gather_sum
from pnet.ops.neighbours import ball_query, octants, three_nearest
from pnet.ops.operators import plain_operators
from pnet.ops.sampling import farthest_point_order, farthest_points

RADIUS, NEIGHBOURS = 0.03, 32  # metres
CHANNELS, WIDE = 64, 128
FEW = 1024  # points of the searches in Python loops
PATIENT = 25.0  # seconds: a plain sampling that would take longer is not run
SIZES = tuple(2**i for i in range(10, 17))
PNET, PLAIN, USUAL = "pnet", "plain torch reference", "usual PyTorch code"
SCIPY, SKLEARN, FPSAMPLE = "scipy cKDTree", "scikit-learn kd_tree", "fpsample"
LOOP = "scipy and a numpy loop"
COLOUR = {
    PNET: COLOURS[0],
    PLAIN: COLOURS[1],
    USUAL: COLOURS[2],
    SCIPY: COLOURS[3],
    LOOP: COLOURS[3],
    SKLEARN: COLOURS[4],
    FPSAMPLE: COLOURS[4],
}

Run = Callable[[], Any]

FIRST_CALL = """
import json
from time import perf_counter

marks = [perf_counter()]
import torch
marks.append(perf_counter())
import pnet.ops.neighbours
marks.append(perf_counter())
import numba
marks.append(perf_counter())
from pnet.ops.gathering import gather_max, gather_sum
from pnet.ops.neighbours import ball_query, nearest, octants
from pnet.ops.sampling import farthest_points

cloud = torch.rand(1, 256, 3)
rows = torch.rand(1, 256, 8, requires_grad=True)
farthest_points(cloud, 64)
index, weight = nearest(cloud, cloud[:, :64], 3)
marks.append(perf_counter())
ball_query(cloud, cloud[:, :64], 0.1, 8)
octants(cloud, 0.3)
for out in (gather_sum(rows, index), gather_sum(rows, index, weight), gather_max(rows, index)):
    out.sum().backward()
marks.append(perf_counter())
print(json.dumps([b - a for a, b in zip(marks, marks[1:])]))
"""
STAGES = (
    "import torch",
    "import pnet.ops.neighbours",
    "import numba, done by the first call",
    "first search and sampling",
    "the other operators",
)


@dataclass(frozen=True, eq=False)
class Case:
    """One task and the ways to do it.

    Attributes:
        title: in the table. ways: by name, pnet's own first; a text says why one is not measured.
        agreement: text on the results of pnet (left) and of another way (right).
    """

    title: str
    ways: dict[str, Run | str]
    agreement: Callable[[Any, Any], str]


def main() -> None:
    """Print the tables and draw them."""
    arguments = parse_arguments()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    nuts = make_bin()
    print(machine())
    print(nuts.text)
    size = POINTS // 4 if arguments.quick else POINTS
    repeats = 2 if arguments.quick else 7
    bars = {}
    print(f"\n{'medians, milliseconds':<40}{'ms':>10}{'/ pnet':>9}{'runs':>6}  result")
    for case in cases(nuts, nuts.points[:size]):
        bars[case.title] = measure(case, repeats)
    first_calls(1 if arguments.quick else 3)
    sizes = SIZES[:4] if arguments.quick else SIZES
    curves = growth(sampled(nuts.fine, sizes[-1]), sizes, repeats)
    arguments.out.mkdir(parents=True, exist_ok=True)
    draw(bars, curves, sizes, arguments.out / "operators.png")


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=default_threads())
    parser.add_argument("--quick", action="store_true", help="a quarter of the points, two runs")
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks"), help="folder of the picture")
    return parser.parse_args()


def measure(case: Case, repeats: int) -> list[tuple[str, float]]:
    """Print a case; its ways with milliseconds."""
    print(case.title)
    bars: list[tuple[str, float]] = []
    expected = None
    for name, run in case.ways.items():
        if isinstance(run, str):
            print(f"  {name:<38}{'':>10}{'':>9}{'':>6}  {run}")
            continue
        timing: Timing = clock(run, repeats)
        if name == PNET:
            expected = timing.result
        text = "" if name == PNET else case.agreement(expected, timing.result)
        ratio = timing.ms / bars[0][1] if bars else 1.0
        print(f"  {name:<38}{number(timing.ms):>10}{ratio:>9.1f}{timing.runs:>6}  {text}", flush=True)
        bars.append((name, timing.ms))
    return bars


def cases(nuts: NutBin, points: Cloud) -> Iterator[Case]:
    """All rows of the table; made one after another, so that their tensors can go."""
    yield from sampling(nuts.pixels, points)
    yield from searches(points)
    yield from gathers(points)
    yield from grouped_layers(points)


def sampling(pixels: Cloud, points: Cloud) -> Iterator[Case]:
    """Farthest points of a cloud and of all pixels."""
    n = len(points)
    cloud = torch.from_numpy(points)[None]
    small = plain(lambda: farthest_points(cloud, n // 4))
    yield Case(
        f"farthest points: {n // 4:,} of {n:,}",
        {PNET: lambda: farthest_points(cloud, n // 4), PLAIN: small},
        same_entries,
    )
    expected = 4 * len(pixels) / n * clock(small, 1).ms / 1000
    whole: Run | str = plain(lambda: farthest_point_order(pixels, n))
    if expected > PATIENT:
        whole = f"not run: would take about {expected:.0f} s"

    def gaps(*orders: Any) -> str:
        own, other = (cKDTree(pixels[order.astype(np.int64)]).query(pixels)[0].max() for order in orders)
        return f"largest gap {1000 * other:.3f} mm, pnet {1000 * own:.3f} mm"

    ways: dict[str, Run | str] = {PNET: lambda: farthest_point_order(pixels, n), PLAIN: whole}
    yield Case(f"farthest points: {n:,} of {len(pixels):,}", ways | {FPSAMPLE: fpsample_way(pixels, n)}, gaps)


def fpsample_way(pixels: Cloud, count: int) -> Run | str:
    """Bucket-based sampling of the package fpsample, or why not."""
    try:
        import fpsample
    except ModuleNotFoundError:
        return "not installed"
    return lambda: fpsample.bucket_fps_kdline_sampling(pixels, count, h=9, start_idx=0)


def searches(points: Cloud) -> Iterator[Case]:
    """Neighbour tables."""
    cloud, threads = torch.from_numpy(points)[None], torch.get_num_threads()
    n, few = len(points), len(points) // 4
    known = cloud[:, :few]
    within = f"{1000 * RADIUS:.0f} mm"
    yield Case(
        f"ball query: {few:,} centres, {within}, k = {NEIGHBOURS}, among {n:,}",
        {
            PNET: lambda: ball_query(cloud, known, RADIUS, NEIGHBOURS),
            PLAIN: plain(lambda: ball_query(cloud, known, RADIUS, NEIGHBOURS)),
            USUAL: lambda: usual.ball_query(cloud, known, RADIUS, NEIGHBOURS),
            SCIPY: lambda: cKDTree(points).query_ball_point(points[:few], RADIUS, workers=threads),
        },
        lambda a, b: same_entries(a, b) if isinstance(b, Tensor) else "lists of all that are within",
    )
    neighbours = NearestNeighbors(n_neighbors=3, algorithm="kd_tree", n_jobs=threads)
    yield Case(
        f"three nearest: {n:,} among {few:,}",
        {
            PNET: lambda: three_nearest(cloud, known)[0],
            PLAIN: plain(lambda: three_nearest(cloud, known)[0]),
            USUAL: lambda: usual.three_nearest(cloud, known)[0],
            SCIPY: lambda: cKDTree(points[:few]).query(points, 3, workers=threads)[1],
            SKLEARN: lambda: neighbours.fit(points[:few]).kneighbors(points)[1],
        },
        same_entries,
    )
    yield Case(
        f"nearest of eight octants: {n:,}, {within}",
        {PNET: lambda: octants(cloud, RADIUS), PLAIN: plain(lambda: octants(cloud, RADIUS))},
        same_entries,
    )
    first = cloud[:, :FEW].contiguous()
    yield Case(
        f"nearest of eight octants: the first {FEW:,}, {within}",
        {
            PNET: lambda: octants(first, RADIUS),
            PLAIN: plain(lambda: octants(first, RADIUS)),
            LOOP: lambda: octants_by_loop(points[:FEW], RADIUS),
        },
        same_entries,
    )


def octants_by_loop(points: Cloud, radius: float) -> np.ndarray:
    """(n, 8) as `pnet.ops.neighbours.octants`: a tree's lists, and the smallest of each octant."""
    found = np.repeat(np.arange(len(points))[:, None], 8, 1)
    for me, near in enumerate(cKDTree(points).query_ball_point(points, radius)):
        others = np.sort([i for i in near if i != me]).astype(np.int64)
        offset = points[others] - points[me]
        square, octant = (offset**2).sum(1), (offset > 0) @ [4, 2, 1]
        for o in range(8):
            (places,) = np.nonzero(octant == o)
            if len(places):
                found[me, o] = others[places[square[places].argmin()]]
    return found


def gathers(points: Cloud) -> Iterator[Case]:
    """Rows by a table of indices, forward and backward."""
    cloud = torch.from_numpy(points)[None]
    n, few = len(points), len(points) // 4
    ball = ball_query(cloud, cloud[:, :few], RADIUS, NEIGHBOURS)
    near, weight = three_nearest(cloud, cloud[:, :few])
    rows = torch.randn(1, n, CHANNELS, requires_grad=True)
    coarse = torch.randn(1, few, WIDE, requires_grad=True)
    both = "forward + backward"

    def case(title: str, inputs: Tensor, own: Callable[[Tensor], Tensor], other: Any) -> Case:
        grad = torch.randn_like(own(inputs))
        ways = {
            PNET: lambda: with_gradient(own, [inputs], grad),
            PLAIN: plain(lambda: with_gradient(own, [inputs], grad)),
            USUAL: lambda: with_gradient(other, [inputs], grad),
        }
        return Case(title, ways, deviation)

    yield case(
        f"gather_max: {few:,} × {NEIGHBOURS} of {n:,} × {CHANNELS}, {both}",
        rows,
        lambda r: gather_max(r, ball),
        lambda r: usual.take(r, ball).max(2)[0],
    )
    yield case(
        f"gather_rows: {few:,} × {NEIGHBOURS} of {n:,} × {CHANNELS}, {both}",
        rows,
        lambda r: gather_rows(r, ball),
        lambda r: usual.take(r, ball),
    )
    yield case(
        f"interpolation: {n:,} × 3 of {few:,} × {WIDE}, {both}",
        coarse,
        lambda r: gather_sum(r, near, weight),
        lambda r: (usual.take(r, near) * weight[..., None]).sum(2),
    )


def grouped_layers(points: Cloud) -> Iterator[Case]:
    """Linear + norm + ReLU of every neighbour: product per point, or per neighbour."""
    cloud = centred(torch.from_numpy(points)[None])
    n, few = len(points), len(points) // 4
    ball = ball_query(cloud, cloud[:, :few], RADIUS, NEIGHBOURS)
    features = torch.randn(1, n, CHANNELS, requires_grad=True)
    tables = {
        f"{few:,} × {NEIGHBOURS}": (ball, 1),
        f"{n:,} × 8, two side by side": (octants(cloud, RADIUS), 2),
    }
    for what, (index, side) in tables.items():
        yield from grouped_layer(what, cloud, features, index, side)


def grouped_layer(what: str, cloud: Tensor, features: Tensor, index: Tensor, side: int) -> Iterator[Case]:
    """The same weights in both ways; in evaluation, and forward + backward in training."""
    layer = RelativeDense(CHANNELS, CHANNELS, RADIUS, side)

    def own(given: Tensor, *_: Tensor) -> Tensor:
        rows: Tensor = layer(cloud, given, index)
        return rows

    def other(given: Tensor, *_: Tensor) -> Tensor:
        product = usual.linear_of_neighbours(layer.linear, cloud, given, index, RADIUS, side)
        return F.relu(layer.norm(product), inplace=True)

    def evaluated(forward: Callable[[Tensor], Tensor]) -> Tensor:
        layer.eval()
        with torch.no_grad():
            return forward(features)

    def trained(forward: Callable[..., Tensor], grad: Tensor) -> list[Tensor]:
        layer.train()
        return with_gradient(forward, [features, *layer.parameters()], grad)

    title = f"grouped layer {CHANNELS} → {CHANNELS}: {what}"
    ways: dict[str, Run | str] = {PNET: lambda: evaluated(own), USUAL: lambda: evaluated(other)}
    yield Case(f"{title}, forward", ways, deviation)
    grad = torch.randn_like(evaluated(own))
    ways = {PNET: lambda: trained(own, grad), USUAL: lambda: trained(other, grad)}
    yield Case(f"{title}, forward + backward", ways, deviation)


def plain(run: Run) -> Run:
    """The same with the references instead of the kernels."""

    def switched() -> Any:
        with plain_operators():
            return run()

    return switched


def with_gradient(forward: Callable[..., Tensor], inputs: Sequence[Tensor], grad: Tensor) -> list[Tensor]:
    """The output and the gradients of all inputs."""
    out = forward(*inputs)
    return [out.detach(), *torch.autograd.grad(out, inputs, grad)]


def same_entries(own: Any, other: Any) -> str:
    """Share of a table's entries that are the same."""
    share = (np.asarray(own).reshape(-1) == np.asarray(other).reshape(-1)).mean()
    return f"{100 * share:.2f} % of the entries equal"


def deviation(own: Tensor | list[Tensor], other: Tensor | list[Tensor]) -> str:
    """Largest deviation of outputs and gradients, as a share of the largest entry."""
    results = [[given] if isinstance(given, Tensor) else given for given in (own, other)]
    worst = max(float((a - b).abs().max() / a.abs().max()) for a, b in zip(*results, strict=True))
    return f"differs by {worst:.0e}" if worst else "identical"


def first_calls(repeats: int) -> None:
    """Print what a new process pays before its first result."""
    with tempfile.TemporaryDirectory() as folder:
        cold = new_process(folder)
        warm = [median(column) for column in zip(*(new_process(folder) for _ in range(repeats)), strict=True)]
    print(f"\n{'a new process, seconds':<40}{'empty cache':>14}{'warm cache':>14}")
    for name, a, b in zip(STAGES, cold, warm, strict=True):
        print(f"  {name:<38}{a:>14.2f}{b:>14.2f}")
    print(f"  {'from the first call on':<38}{sum(cold[2:]):>14.2f}{sum(warm[2:]):>14.2f}", flush=True)


def new_process(cache: str) -> list[float]:
    """Seconds of the stages of `FIRST_CALL`."""
    done = subprocess.run(
        [sys.executable, "-c", FIRST_CALL],
        env=os.environ | {"NUMBA_CACHE_DIR": cache},
        capture_output=True,
        text=True,
        check=True,
    )
    spent: list[float] = json.loads(done.stdout)
    return spent


def growth(points: Cloud, sizes: Sequence[int], repeats: int) -> dict[str, list[float]]:
    """Print and return milliseconds by size; each size is a prefix of the same sample."""
    whole = torch.from_numpy(points)[None]
    ways: dict[str, Callable[[Tensor, Tensor], object]] = {
        "octants, 30 mm": lambda cloud, _: octants(cloud, RADIUS),
        f"ball query, N/4 centres, 30 mm, {NEIGHBOURS}": lambda cloud, known: ball_query(
            cloud, known, RADIUS, NEIGHBOURS
        ),
        "three nearest among N/4": lambda cloud, known: three_nearest(cloud, known),
        "farthest points, N/4 of N": lambda cloud, known: farthest_points(cloud, known.shape[1]),
    }
    curves: dict[str, list[float]] = {}
    print(f"\n{'growth, milliseconds; N:':<40}" + "".join(f"{n:>9,}" for n in sizes) + f"{'exponent':>10}")
    for name, run in ways.items():
        curves[name] = []
        for n in sizes:
            cloud = whole[:, :n].contiguous()
            known = cloud[:, : n // 4].contiguous()
            curves[name].append(clock(lambda: run(cloud, known), repeats).ms)  # noqa: B023
        print_growth(name, curves[name], sizes)
    print_growth("N log N, from the same start", n_log_n(sizes, curves["octants, 30 mm"][0]), sizes)
    print(f"exponents are fitted over the last {len(sizes) - len(sizes) // 2} sizes")
    return curves


def n_log_n(sizes: Sequence[int], start: float) -> list[float]:
    return [start * n * math.log(n) / (sizes[0] * math.log(sizes[0])) for n in sizes]


def print_growth(name: str, curve: Sequence[float], sizes: Sequence[int]) -> None:
    cells = "".join(f"{number(ms):>9}" for ms in curve)
    print(f"  {name:<38}{cells}{exponent(sizes, curve):>10.2f}", flush=True)


def exponent(sizes: Sequence[int], curve: Sequence[float]) -> float:
    """Slope of the upper half, both axes logarithmic."""
    upper = slice(len(sizes) // 2, None)
    return float(np.polyfit(np.log(sizes[upper]), np.log(curve[upper]), 1)[0])


def draw(
    bars: dict[str, list[tuple[str, float]]],
    curves: dict[str, list[float]],
    sizes: Sequence[int],
    path: Path,
) -> None:
    """The table as bars beside the growth."""
    lines = sum(len(ways) + 1.3 for ways in bars.values())
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(12, 1.2 + 0.155 * lines), width_ratios=(1.5, 1), layout="constrained"
    )
    draw_bars(left, bars, COLOUR)
    left.set_title(f"Operators; threads: {torch.get_num_threads()}", fontsize=10, color=INK, loc="left")
    draw_growth(right, curves, sizes)
    figure.savefig(path, dpi=150)
    print(f"\n{path}")


def draw_growth(axes: Axes, curves: dict[str, list[float]], sizes: Sequence[int]) -> None:
    """One line for each search."""
    for (name, curve), colour in zip(curves.items(), [COLOURS[i] for i in (0, 2, 3, 4)], strict=True):
        label = f"{name}: N$^{{{exponent(sizes, curve):.2f}}}$"
        axes.plot(sizes, curve, "o-", color=colour, linewidth=1.8, markersize=4, label=label)
    highest = max(curves.values(), key=lambda curve: curve[-1])
    guide = n_log_n(sizes, 1.0)
    guide = [2 * highest[-1] / guide[-1] * value for value in guide]
    axes.plot(sizes, guide, "--", color=COLOURS[1], linewidth=1.2, label="N log N")
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(plain_number)
    axes.set_xticks(sizes, [f"{n:,}" for n in sizes], rotation=30)
    axes.set_xlabel("N, points of the cloud")
    axes.set_ylabel("milliseconds")
    axes.set_title("pnet over the size of the cloud", fontsize=10, color=INK, loc="left")
    tidy(axes)
    axes.grid(color=FAINT, linewidth=0.6)
    axes.legend(fontsize=8, frameon=False, loc="lower right")


if __name__ == "__main__":
    main()
