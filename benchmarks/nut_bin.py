"""What the benchmarks of operators and backbones share: a bin of nuts, a clock and bars."""

import math
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.axes import Axes
from numpy.typing import NDArray
from omegaconf import OmegaConf

from pnet.cli.app import config_dir
from pnet.cli.instantiate import instantiate
from pnet.geometry.camera import Camera
from pnet.ops.sampling import farthest_point_order
from pnet.scenes.factory import SceneFactory
from pnet.scenes.noise import NoNoise
from pnet.scenes.pile_factory import PileFactory
from pnet.scenes.protocol import CycleTask, Protocol
from pnet.scenes.rendering import render_view
from pnet.scenes.view_factory import ViewFactory

matplotlib.use("Agg")  # no screen

PART, PART_OBJECT, NUTS = "tn06", 21, 60  # a nut of middling size
POINTS = 16384
FINE = 2.0  # pixels of the fine camera along a side, for each of the default one's
SLOW, LONG = 2.0, 8.0  # seconds: slower calls are repeated less often, or not at all
INK, FAINT = "#20242c", "#d9dde3"
COLOURS = ("#1f6feb", "#9aa4b2", "#f2994a", "#27ae60", "#9b6dff")

Cloud = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class NutBin:
    """One scene.

    Attributes:
        points: (16384, 3) in sampling order. pixels: (n, 3) all that the default camera sees of the nuts.
        fine: (m, 3) all that a camera of higher resolution sees; metres, camera frame.
        text: what it is.
    """

    points: Cloud
    pixels: Cloud
    fine: Cloud
    text: str


@dataclass(frozen=True)
class Timing:
    """Median milliseconds of some runs, and what the last returned."""

    ms: float
    runs: int
    result: Any


def make_bin() -> NutBin:
    """Drop the nuts into the default bin; without PyBullet they hang in it as clutter."""
    part, protocol = load(f"part/{PART}"), Protocol("bench", NUTS, POINTS, {}, drop_step=NUTS)
    box, physics, clutter = load("bin/square_150"), load("physics/pybullet"), load("clutter/spread")
    piles = PileFactory(part, protocol, box, physics, clutter, seed=0, fingerprint="bench")
    views = ViewFactory(part, load("camera/ensenso_n35"), load("view/above"), NoNoise(), POINTS)
    factory = SceneFactory(piles, views, fingerprint="bench")
    kind = "pile"
    try:
        cycle = factory.make_cycle(CycleTask("train", kind, "L", 0, PART_OBJECT))
    except ModuleNotFoundError:
        kind = "clutter, as PyBullet is not installed"
        cycle = factory.make_cycle(CycleTask("train", "clutter", "L", 0, PART_OBJECT))
    (scene,) = cycle.scenes
    mesh = part.mesh(scene.parameters[0])
    pixels, fine = (
        visible_points(camera, render_view(camera, mesh, scene.R, scene.t))
        for camera in (scene.camera, finer(scene.camera))
    )
    text = (
        f"{len(scene.R)} nuts {part.name} ({part.text(scene.parameters[0])}), {kind}: "
        f"{len(pixels)} pixels, {len(scene.points)} points"
    )
    return NutBin(scene.points.astype(np.float32), pixels, fine, text)


def sampled(cloud: Cloud, count: int) -> Cloud:
    """The first points of a cloud in sampling order."""
    return cloud[farthest_point_order(cloud, count)]


def finer(camera: Camera) -> Camera:
    """The same view with `FINE` times the pixels along a side."""
    return replace(
        camera,
        width=round(FINE * camera.width),
        height=round(FINE * camera.height),
        fx=FINE * camera.fx,
        fy=FINE * camera.fy,
        cx=FINE * (camera.cx + 0.5) - 0.5,
        cy=FINE * (camera.cy + 0.5) - 0.5,
    )


def visible_points(camera: Camera, view: Any) -> Cloud:
    """(n, 3) a point for each pixel on a body."""
    cloud: Cloud = camera.depth_to_points(view.depth)[view.instance >= 0].astype(np.float32)
    return cloud


def load(path: str, *args: Any, **kwargs: Any) -> Any:
    """Build conf/<path>.yaml."""
    return instantiate(OmegaConf.load(config_dir() / f"{path}.yaml"), *args, **kwargs)


def clock(run: Callable[[], Any], repeats: int = 7, patience: float = math.inf) -> Timing:
    """Median of some calls after one to warm up; of fewer where that was slow, and it alone where long.

    Args:
        run: what is timed. repeats: calls. patience: seconds after which no further call starts.
    """
    result, first = timed(run)
    if first > LONG:
        return Timing(1000 * first, 1, result)
    if first > SLOW:
        repeats = 1 if first > 2 * SLOW else min(repeats, 3)
    spent: list[float] = []
    while len(spent) < repeats and sum(spent) < patience:
        result, last = timed(run)
        spent.append(last)
    return Timing(1000 * median(spent), len(spent), result)


def timed(run: Callable[[], Any]) -> tuple[Any, float]:
    """What a call returns, and its seconds."""
    start = perf_counter()
    result = run()
    return result, perf_counter() - start


def machine() -> str:
    """The processor, the threads and the versions that a table was made with."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        named = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        name = named[0].split(":", 1)[1].strip() if named else name
    return f"{name}, threads: {torch.get_num_threads()}, torch {torch.__version__}, numpy {np.__version__}"


def default_threads() -> int:
    """Two, or fewer where there are fewer cores."""
    return min(2, os.cpu_count() or 1)


def number(ms: float) -> str:
    """Milliseconds with three digits."""
    if ms >= 100:
        return f"{ms:,.0f}"
    return f"{ms:.1f}" if ms >= 10 else f"{ms:.2f}"


def draw_bars(
    axes: Axes, groups: Mapping[str, Sequence[tuple[str, float]]], colours: Mapping[str, str], size: float = 8
) -> None:
    """Horizontal bars on a log axis, group under group.

    Args:
        groups: title → (name, milliseconds) of its bars. colours: by name. size: of the letters, points.
    """
    y, ticks, names = 0.0, [], []
    values = [ms for bars in groups.values() for _, ms in bars]
    low, high = min(values) / 2, max(values) * 3.5
    for title, bars in groups.items():
        axes.text(low * 1.06, y, title, fontsize=size, fontweight="bold", color=INK, va="center")
        for name, ms in bars:
            y += 1
            axes.barh(y, ms - low, left=low, height=0.78, color=colours[name])
            axes.text(ms * 1.08, y, number(ms), fontsize=size - 0.5, color=INK, va="center")
            ticks.append(y)
            names.append(name)
        y += 1.35
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(plain_number)
    axes.set(xlim=(low, high), ylim=(y - 0.6, -0.9), xlabel="milliseconds")
    axes.set_yticks(ticks, names, fontsize=size)
    tidy(axes)
    axes.grid(axis="x", color=FAINT, linewidth=0.6)
    axes.tick_params(axis="y", length=0)


def plain_number(value: float, _: object) -> str:
    """A tick as 0.1 or 1,000 and not as a power of ten."""
    return f"{value:,.0f}" if value >= 1 else f"{value:g}"


def tidy(axes: Axes) -> None:
    """No frame but the lower left corner, and nothing on top of the data."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.set_axisbelow(True)
    axes.tick_params(colors=INK, labelsize=8)
