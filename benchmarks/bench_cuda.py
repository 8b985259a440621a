"""Operators, networks and whole scenes on a GPU, beside plain torch and the usual PointNet++ code.

Every figure is the median of many runs between two CUDA events after a warm-up, over clouds that take
turns, so that what a run reads is not what the last one left in the cache. Bounds are what this card was
seen to copy and to multiply in the same run.

python benchmarks/bench_cuda.py
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import cycle
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import torch
import usual_pointnet2 as usual
from bench_backbones import BACKBONES, build, build_usual, clouds, train
from bench_postprocess import predict
from hydra import compose, initialize_config_dir
from nut_bin import PART, POINTS, default_threads, load, machine, make_bin, number
from torch import Tensor

from pnet.cli.app import config_dir
from pnet.cli.instantiate import instantiate
from pnet.engine.precision import Precision
from pnet.models.parametricnet import ParametricNet
from pnet.models.summary import summarise
from pnet.ops.gathering import gather_max, gather_sum
from pnet.ops.grouping import group_max
from pnet.ops.neighbours import ball_query, octants, three_nearest
from pnet.ops.operators import plain_operators
from pnet.ops.sampling import farthest_points
from pnet.postprocess.pipeline import PoseRecovery
from pnet.records import PointPrediction

BATCHES = (1, 8, 16)
CENTRES, RADIUS, NEIGHBOURS, OCTANTS, CHANNELS = 4096, 0.02, 32, 0.01, 128
TURNS = 4  # inputs that take turns
TARGETS = """targets on a current data-centre GPU, 16,384 points: PointSIFT forward, tables included, at most
10 ms (stretch 4 ms); end to end at most 20 ms a scene; a training step of batch 8 at most 120 ms"""
Run = Callable[[Tensor], Any]


@dataclass(frozen=True)
class Meter:
    """Measures calls on a device.

    Attributes:
        device: where. repeats: runs of which the median is taken. patience: seconds after which none starts.
    """

    device: torch.device
    repeats: int
    patience: float = 5.0

    def ms(self, run: Run, inputs: Sequence[Tensor]) -> float:
        """Median milliseconds of run(input), the inputs taking turns."""
        turns = cycle(inputs)
        for _ in inputs:  # compiles, and fills the caches of memory
            run(next(turns))
        spent: list[float] = []
        while len(spent) < self.repeats and sum(spent) < 1000 * self.patience:
            spent.append(self._once(run, next(turns)))
        return median(spent)

    def peak(self, run: Run, value: Tensor) -> float | None:
        """MiB that a call holds at most; None on a CPU."""
        if self.device.type != "cuda":
            return None
        torch.cuda.reset_peak_memory_stats(self.device)
        run(value)
        torch.cuda.synchronize(self.device)
        return torch.cuda.max_memory_allocated(self.device) / 2**20

    def _once(self, run: Run, value: Tensor) -> float:
        if self.device.type != "cuda":
            start = perf_counter()
            run(value)
            return 1000 * (perf_counter() - start)
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record()
        run(value)
        end.record()
        end.synchronize()
        return begin.elapsed_time(end)


@dataclass(frozen=True)
class Bounds:
    """What the device was seen to do: bytes copied and multiply-adds, per millisecond."""

    copied: float
    products: dict[Precision, float]


def main() -> None:
    """Print the tables, or that there is no GPU."""
    arguments = parse_arguments()
    torch.set_num_threads(default_threads())
    if arguments.device == "cuda" and not torch.cuda.is_available():
        print("not measured: torch finds no CUDA device here (--device cpu only tries the script)")
        return
    torch.manual_seed(0)
    meter = Meter(torch.device(arguments.device), 3 if arguments.quick else 30)
    batches = BATCHES[:1] if arguments.quick else BATCHES
    count = 1024 if arguments.quick else POINTS
    nuts = make_bin()
    print(torch.cuda.get_device_name() if arguments.device == "cuda" else "CPU", "|", machine())
    print(nuts.text)
    print(TARGETS)
    bounds = measure_bounds(meter, 256 if arguments.quick else 8192)
    inputs = {b: [clouds(nuts.points[i:], count, b).to(meter.device) for i in range(TURNS)] for b in batches}
    lines = [*operator_table(meter, bounds, inputs), *network_table(meter, bounds, inputs, arguments.quick)]
    lines += scene_table(meter, inputs)
    arguments.out.mkdir(parents=True, exist_ok=True)
    path = arguments.out / "cuda.md"
    path.write_text("\n".join(lines) + "\n")
    print(path)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    parser.add_argument("--quick", action="store_true", help="few points, one cloud, three runs: to try it")
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks"), help="folder of the table")
    return parser.parse_args()


def measure_bounds(meter: Meter, size: int) -> Bounds:
    """Copy a large tensor, multiply large matrices."""
    large = [torch.zeros(size, size, device=meter.device) for _ in range(2)]
    copied = 2 * large[0].numel() * 4 / meter.ms(torch.clone, large)
    products = {}
    for precision in Precision:
        dtype = torch.bfloat16 if precision is Precision.BF16 else torch.float32
        factors = [matrix.to(dtype) for matrix in large]
        with precision.numbers(meter.device.type):
            products[precision] = size**3 / meter.ms(lambda a: a @ factors[0], factors)  # noqa: B023
    seen = ", ".join(f"{name} {2 * rate / 1e9:.0f} TFLOP/s" for name, rate in products.items())
    print(f"this device: copies {copied / 1e6:.0f} GB/s; products {seen}")
    return Bounds(copied, products)


def say(lines: list[str], *cells: object) -> None:
    """One row of a Markdown table, printed and kept."""
    lines.append("| " + " | ".join(str(cell) for cell in cells) + " |")
    print(lines[-1], flush=True)


def head(lines: list[str], *titles: str) -> None:
    print()
    lines.append("")
    say(lines, *titles)
    say(lines, *("---" for _ in titles))


@dataclass(frozen=True)
class Case:
    """An operator on clouds: what it reads and writes at least, and what a user would run instead."""

    name: str
    run: Run
    bytes: float | None
    instead: Run | None = None


def operator_table(meter: Meter, bounds: Bounds, inputs: dict[int, list[Tensor]]) -> list[str]:
    """Each operator with kernels, in plain torch, and in the usual PointNet++ code."""
    lines: list[str] = []
    head(
        lines,
        "operator",
        "clouds",
        "ms",
        "plain torch",
        "usual code",
        "times faster",
        "bound",
        "of the bound",
    )
    for batch, given in inputs.items():
        for case in operators(given[0]):
            own = meter.ms(case.run, given)
            few = Meter(meter.device, 3, 1.0)
            with plain_operators():
                plain = few.ms(case.run, given[:1])
            other = None if case.instead is None else few.ms(case.instead, given[:1])
            least = None if case.bytes is None else case.bytes / bounds.copied
            say(
                lines, case.name, batch, number(own), number(plain), "" if other is None else number(other),
                f"{min(x for x in (plain, other) if x is not None) / own:.1f}",
                "" if least is None else number(least), "" if least is None else f"{least / own:.0%}",
            )  # fmt: skip
    return lines


def operators(cloud: Tensor) -> Iterator[Case]:
    """On clouds like this one (B, N, 3); features and tables are those of the first set abstraction."""
    B, n, _ = cloud.shape
    m = n // 4
    features = torch.randn(B, n, CHANNELS, device=cloud.device)
    few = torch.randn(B, m, CHANNELS, device=cloud.device)
    table, (near, weight) = (
        ball_query(cloud, cloud[:, :m], RADIUS, NEIGHBOURS),
        three_nearest(cloud, cloud[:, :m]),
    )
    eight = octants(cloud, OCTANTS)
    grouped = torch.randn(B, m, NEIGHBOURS, CHANNELS, device=cloud.device)
    row, place = 4 * CHANNELS, 8  # bytes of a row of features, of an index
    whole, part = B * n * row, B * m * row
    yield Case("farthest_points, N to N/4", lambda x: farthest_points(x, m), None, partial(_usual_sample, m))
    yield Case(
        "ball_query, N/4 centres, 32", lambda x: ball_query(x, x[:, :m], RADIUS, NEIGHBOURS),
        B * (n + m) * 12 + table.numel() * place, partial(_usual_ball, m),
    )  # fmt: skip
    yield Case("octants", lambda x: octants(x, OCTANTS), B * n * 12 + eight.numel() * place)
    yield Case(
        "three_nearest, N to N/4",
        lambda x: three_nearest(x, x[:, :m]),
        B * n * (12 + 3 * 12),
        partial(_usual_three, m),
    )
    read = whole + table.numel() * place
    yield Case("gather_max", lambda _: gather_max(features, table), read + part * 2)
    yield Case(
        "gather_max, and backward", lambda _: _backward(gather_max, features, table), 2 * read + 4 * part
    )
    yield Case("group_max", lambda _: group_max(grouped), grouped.numel() * 4 + part * 2)
    yield Case(
        "gather_sum of 8, N rows", lambda _: gather_sum(features, eight), 2 * whole + eight.numel() * place
    )
    yield Case(
        "interpolation", lambda _: gather_sum(few, near, weight), part + whole + near.numel() * (place + 4)
    )
    yield Case(
        "interpolation, and backward", lambda _: _backward(gather_sum, few, near, weight),
        2 * (part + whole + near.numel() * (place + 4)),
    )  # fmt: skip


def _usual_sample(m: int, cloud: Tensor) -> Tensor:
    return usual.farthest_points(cloud, m)


def _usual_ball(m: int, cloud: Tensor) -> Tensor:
    return usual.ball_query(cloud, cloud[:, :m], RADIUS, NEIGHBOURS)


def _usual_three(m: int, cloud: Tensor) -> tuple[Tensor, Tensor]:
    return usual.three_nearest(cloud, cloud[:, :m])


def _backward(operator: Callable[..., Tensor], rows: Tensor, *tables: Tensor) -> None:
    rows = rows.detach().requires_grad_()
    operator(rows, *tables).sum().backward()


def network_table(meter: Meter, bounds: Bounds, inputs: dict[int, list[Tensor]], quick: bool) -> list[str]:
    """Every backbone under the compact network: tables, forward and training step."""
    lines: list[str] = []
    titles = (
        "network",
        "numbers",
        "clouds",
        "tables ms",
        "forward ms",
        "step ms",
        "step MiB",
        "forward's bound",
    )
    head(lines, *titles)
    names = BACKBONES[-2:] if quick else BACKBONES
    for name in names:
        network = build(load(f"backbone/{name}")).to(meter.device)
        work = summarise(network, next(iter(inputs.values()))[0][0]).operations
        for precision in Precision:
            if meter.device.type == "cpu" and precision is Precision.TF32:
                continue
            for batch, given in inputs.items():
                row = network_row(meter, network, precision, given)
                least = number(batch * work / bounds.products[precision])
                say(lines, name, precision, batch, *row, least)
    other = build_usual().to(meter.device)
    for batch, given in inputs.items():
        if batch <= 8:
            row = network_row(Meter(meter.device, 3, 1.0), other, Precision.FLOAT32, given)
            say(lines, "usual PointNet++", Precision.FLOAT32, batch, *row, "")
    return lines


def network_row(meter: Meter, network: ParametricNet, precision: Precision, given: list[Tensor]) -> list[str]:
    """Times of the tables, the forward and the step, and the step's memory."""

    def step(cloud: Tensor) -> None:
        precision.set_products(meter.device.type)
        with torch.autocast(meter.device.type, torch.bfloat16, enabled=precision is Precision.BF16):
            train(network, cloud)

    try:
        tables = meter.ms(lambda x: network.backbone.tables(x), given)
        forward = meter.ms(partial(forward_pass, network.eval(), precision), given)
        whole, peak = meter.ms(step, given), meter.peak(step, given[0])
    except torch.cuda.OutOfMemoryError:
        torch.cuda.empty_cache()
        return ["", "", "out of memory", ""]
    return [number(tables), number(forward), number(whole), "" if peak is None else f"{peak:,.0f}"]


@torch.no_grad()
def forward_pass(network: ParametricNet, precision: Precision, cloud: Tensor) -> PointPrediction:
    """In evaluation, tables included."""
    with precision.numbers(cloud.device.type):
        prediction: PointPrediction = network.eval()(cloud)
    return prediction


def scene_table(meter: Meter, inputs: dict[int, list[Tensor]]) -> list[str]:
    """End to end: PointSIFT forward, then poses from predictions such as a trained network's.

    An untrained network's own votes make no clusters, so its forward is timed and a prediction of 60
    instances with a millimetre of noise takes the place of its result.
    """
    lines: list[str] = []
    head(lines, "clouds", "voting", "forward ms", "poses ms", "end to end ms a scene", "found a scene")
    network = build(load("backbone/pointsift")).to(meter.device).eval()
    part = load(f"part/{PART}")
    precision = Precision.of("auto", meter.device.type)
    for setting in ("paper", "folded"):
        with initialize_config_dir(str(config_dir()), version_base="1.3"):
            recovery: PoseRecovery = instantiate(
                compose("train", overrides=[f"postprocess={setting}"]).postprocess
            )
        one = predict(part, by_point=not recovery.voting.filters_keypoints)
        for batch, given in inputs.items():
            prediction = repeated(one, batch, meter.device)
            forward = meter.ms(partial(forward_pass, network, precision), given)
            poses = meter.ms(lambda _: recovery(part, prediction), given)  # noqa: B023
            found = sum(len(d.score) for d in recovery(part, prediction)) / batch
            total = (forward + poses) / batch
            say(lines, batch, setting, number(forward), number(poses), number(total), f"{found:.0f}")
    return lines


def repeated(one: PointPrediction, batch: int, device: torch.device) -> PointPrediction:
    """The prediction of one scene for each of a batch."""
    values = {
        name: None if value is None else value.float().expand(batch, *value.shape[1:]).contiguous().to(device)
        for name, value in vars(one).items()
    }
    return PointPrediction(**values)


if __name__ == "__main__":
    main()
