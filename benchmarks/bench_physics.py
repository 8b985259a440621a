"""Piles of every part by each physics engine and each stand-in for a concave body: time and statistics.

Run from the repository root: OMP_NUM_THREADS=1 python benchmarks/bench_physics.py
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from pnet.cli.instantiate import instantiate
from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.scenes.overlap import ConvexPiece, penetration
from pnet.scenes.physics import Physics, make_body
from pnet.scenes.pile import Bin, Pile
from pnet.scenes.piling import pile_bodies
from pnet.scenes.rendering import View, render_view
from pnet.scenes.viewpoints import Viewpoints

CONF = Path(__file__).parents[1] / "conf"
# a part object of middling size, and a bin that holds the pile
PARTS = {
    "tn06": (21, "square_150"),
    "tn16": (21, "square_200"),
    "tn34": (5, "square_150"),
    "tn42": (21, "square_200"),
    "candlestick": (0, "box_400"),
    "gear": (0, "box_400"),
    "tless20": (0, "box_400"),
    "tless29": (0, "box_400"),
}
PIXELS, DISTANCE = 512, 2.0  # of the square image; of the camera from the floor, metres
COLOURS = np.array(
    [[86, 140, 190], [222, 147, 64], [104, 168, 96], [190, 96, 110], [140, 120, 180], [150, 130, 110]]
)
HEADINGS = ("part", "engine", "collision", "s/cycle", "height", "spread", "visible", "flat", "deepest", "99%")
HEADINGS = (*HEADINGS, "restless", "escaped")


def main() -> None:
    arguments = parse_arguments()
    print(
        f"{arguments.cycles} cycles of {arguments.drop_limit} drops; height: mean and deviation of centroids"
    )
    print(
        "above the floor, mm; visible: mean of V; flat: share within 10° of a pose along the part's z axis;"
    )
    print("deepest, 99%: penetration of neighbouring bodies, mm; restless: piles not at rest in time")
    print("".join(f"{word:>12}" for word in HEADINGS))
    panels: dict[str, np.ndarray] = {}
    for name in arguments.parts:
        index, bin_name = PARTS[name]
        part, box = build(f"part/{name}"), build(f"bin/{bin_name}")
        for engine, physics in ways(arguments.collisions):
            found = piles_of(part, index, box, physics, arguments)
            print_row(name, engine, physics, found)
            if physics.collision == arguments.collisions[0]:
                panels[f"{name}, {engine}"] = found["picture"]
    if arguments.picture:
        draw(panels, arguments.picture)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drop-limit", type=int, default=60)
    parser.add_argument("--cycles", type=int, default=2)
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--collisions", nargs="+", default=["filled", "hull"])
    parser.add_argument("--picture", type=Path, help="PNG of the first full bin of every part and engine")
    return parser.parse_args()


def build(path: str) -> Any:
    return instantiate(OmegaConf.load(CONF / f"{path}.yaml"))


def ways(collisions: list[str]) -> Iterator[tuple[str, Physics]]:
    for collision in collisions:
        for engine in (engine for engine in ("pybullet", "mujoco") if find_spec(engine)):
            yield engine, replace(build(f"physics/{engine}"), collision=collision)


def piles_of(
    part: ParametricPart, index: int, box: Bin, physics: Physics, arguments: argparse.Namespace
) -> dict[str, Any]:
    """Statistics over cycles."""
    size, drops = part.part_object("L", index), range(1, arguments.drop_limit + 1)
    found: dict[str, list[Any]] = {
        key: [] for key in ("seconds", "t", "axis", "visible", "depth", "restless")
    }
    escaped, picture = 0, None
    for cycle in range(arguments.cycles):
        start = time.perf_counter()
        piles = list(pile_bodies(part, size, box, drops, physics, np.random.default_rng(cycle)))
        found["seconds"].append(time.perf_counter() - start)
        full = piles[-1]
        found["t"].append(full.t[:, 2])
        found["axis"].append(np.abs(full.R[:, 2, 2]))
        view = seen_from_above(part, size, full, box)
        picture = shaded(view) if picture is None else picture
        found["visible"].append(view.visibility)
        found["depth"].append(depths(part, size, physics, full))
        found["restless"].append(sum(not pile.settled for pile in piles))
        escaped += full.escaped
    joined = {key: np.concatenate([np.atleast_1d(x) for x in values]) for key, values in found.items()}
    return {**joined, "escaped": escaped, "picture": picture}


def seen_from_above(part: ParametricPart, size: np.ndarray, pile: Pile, box: Bin) -> View:
    """All of the bin's floor and a rim, from far above."""
    focal, centre = PIXELS * DISTANCE / (1.3 * max(box.width, box.depth)), (PIXELS - 1) / 2
    camera = Camera(PIXELS, PIXELS, focal, focal, centre, centre, near=0.2, far=2 * DISTANCE)
    R, t = Viewpoints((DISTANCE, DISTANCE)).draw(np.random.default_rng(0))
    return render_view(camera, part.mesh(size), R @ pile.R, pile.t @ R.T + t)


def shaded(view: View) -> np.ndarray:
    """(h, w, 3) uint8: a colour a body, darker where the surface turns away."""
    colour = COLOURS[view.instance % len(COLOURS)] * (0.25 + 0.75 * view.incidence[..., None] ** 2)
    return np.where(view.instance[..., None] >= 0, colour, 245).astype(np.uint8)


def draw(panels: dict[str, np.ndarray], path: Path) -> None:
    from matplotlib.figure import Figure

    columns = 4
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(3 * columns, 3.2 * rows), layout="constrained")
    for axes, (title, image) in zip(np.ravel(figure.subplots(rows, columns)), panels.items(), strict=False):
        axes.imshow(image)
        axes.set_title(title, fontsize=10)
    for axes in figure.axes:
        axes.set_axis_off()
    figure.savefig(path, dpi=100)


def depths(part: ParametricPart, size: np.ndarray, physics: Physics, pile: Pile) -> np.ndarray:
    """(d,) how deep each body reaches into those before it, metres, at least 0."""
    body = make_body(part, size, physics.collision)
    pieces, poses = [ConvexPiece(corners) for corners in body.pieces], list(zip(pile.R, pile.t, strict=True))
    found = []
    for i, (R, t) in enumerate(poses):
        near = [pose for pose in poses[:i] if np.linalg.norm(pose[1] - t) < 2 * body.radius]
        found.append(max(penetration(pieces, R, t, near), 0.0))
    return np.array(found)


def print_row(name: str, engine: str, physics: Physics, found: dict[str, Any]) -> None:
    values = (
        f"{np.median(found['seconds']):.1f}",
        f"{1000 * found['t'].mean():.1f}",
        f"{1000 * found['t'].std():.1f}",
        f"{found['visible'].mean():.3f}",
        f"{(found['axis'] > np.cos(np.deg2rad(10))).mean():.2f}",
        f"{1000 * found['depth'].max():.2f}",
        f"{1000 * np.quantile(found['depth'], 0.99):.2f}",
        f"{found['restless'].sum()}",
        f"{found['escaped']}",
    )
    print("".join(f"{word:>12}" for word in (name, engine, physics.collision, *values)), flush=True)


if __name__ == "__main__":
    main()
