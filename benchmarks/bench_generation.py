"""Times the making of scenes by stage, and beside it the obvious ways to sample and to render.

Run from the repository root: OMP_NUM_THREADS=1 python benchmarks/bench_generation.py
"""

import argparse
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import trimesh
from omegaconf import OmegaConf
from scipy.spatial import cKDTree

from pnet.cli.instantiate import instantiate
from pnet.ops.operators import plain_operators
from pnet.ops.sampling import farthest_point_order
from pnet.records import Scene
from pnet.scenes.factory import SceneFactory
from pnet.scenes.generation import CycleReport, cycle_path, generate, open_root
from pnet.scenes.protocol import CycleTask, Protocol, SplitPlan
from pnet.scenes.rendering import View, render_view
from pnet.scenes.store import CycleFile

T = TypeVar("T")
CONF = Path(__file__).parents[1] / "conf"
PARTS = {"tn34": 5, "tn06": 21}  # a part object of middling size
STAGES = ("simulate", "render", "sample", "write")


def main() -> None:
    arguments = parse_arguments()
    print(f"{platform.processor() or platform.machine()}, {arguments.workers or 'no'} workers")
    print(f"{arguments.cycles} cycles of {arguments.drop_limit} drops, {arguments.points} points a scene")
    for name, index in PARTS.items():
        factory = build_factory(name, arguments)
        with tempfile.TemporaryDirectory() as folder:
            full_bin = time_stages(factory, Path(folder), index, arguments.workers)
        compare(factory, full_bin)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drop-limit", type=int, default=60)
    parser.add_argument("--points", type=int, default=16_384)
    parser.add_argument("--cycles", type=int, default=3, help="the table has their medians")
    parser.add_argument("--workers", type=int, default=0, help="0 works in this process")
    return parser.parse_args()


def build_factory(name: str, arguments: argparse.Namespace) -> SceneFactory:
    """The configs' own settings, but for the protocol."""
    plan = SplitPlan("L", arguments.cycles)
    protocol = Protocol("bench", arguments.drop_limit, arguments.points, {"train": plan})
    parts = {
        "part": f"part/{name}",
        "camera": "camera/ensenso_n35",
        "box": "bin/square_150",
        "physics": "physics/pybullet",
    }
    built = {key: instantiate(OmegaConf.load(CONF / f"{path}.yaml")) for key, path in parts.items()}
    settings = OmegaConf.load(CONF / "generate.yaml")
    return SceneFactory(
        protocol=protocol,
        camera_height=settings.camera_height,
        clutter_spacing=settings.clutter_spacing,
        seed=0,
        fingerprint="bench",
        **built,
    )


def time_stages(factory: SceneFactory, root: Path, index: int, workers: int) -> Scene:
    """Print the stages of all cycles; the first cycle's last scene."""
    tasks = [
        CycleTask("train", "pile", "L", cycle, index)
        for cycle in range(factory.protocol.splits["train"].cycles)
    ]
    open_root(root, {})
    reports, seconds = timed(lambda: list(generate(factory, root, tasks, workers)), repeats=1)
    made = [report for report in reports if report is not None]
    print(f"\n{factory.part.name}, {factory.part.text(factory.part.part_object('L', index))}")
    print(f"{'stage':<34}{'ms a scene':>12}{'scenes/s':>12}")
    for stage in STAGES:
        print_row(stage, statistics.median(per_scene(report, stage) for report in made))
    print_row("all, one process", statistics.median(sum(per_scene(r, s) for s in STAGES) for r in made))
    print_row("all, by the clock", seconds / sum(report.scenes for report in made))
    file = CycleFile(cycle_path(root, tasks[0]))
    return file.scene(len(file) - 1)


def per_scene(report: CycleReport, stage: str) -> float:
    return float(getattr(report.times, stage)) / report.scenes


def print_row(name: str, seconds: float) -> None:
    print(f"{name:<34}{1000 * seconds:>12.1f}{1 / seconds:>12.1f}")


def compare(factory: SceneFactory, scene: Scene) -> None:
    """One full bin, rendered and sampled in pnet's way and in the obvious one."""
    mesh = factory.part.mesh(scene.parameters[0])
    view, rendered = timed(lambda: render_view(scene.camera, mesh, scene.R, scene.t))
    depth, cast = timed(lambda: render_with_trimesh(scene, mesh))
    differing = (np.abs(depth - view.depth) > 1e-4)[view.instance >= 0].mean()
    cloud, count = visible_points(scene, view), factory.protocol.points
    order, sampled = timed(lambda: farthest_point_order(cloud, count))
    with plain_operators():
        plain, looped = timed(lambda: farthest_point_order(cloud, count), repeats=1)
    print(f"a full bin of {len(scene.R)} bodies, {len(cloud)} pixels on them")
    print_pair("render_view", rendered, "trimesh, all bodies in one mesh", cast)
    print(f"  {differing:.2%} of the pixels differ by more than 0.1 mm; trimesh gives no silhouettes")
    print_pair("farthest_point_order", sampled, "plain torch", looped)
    gaps = [1000 * cKDTree(cloud[taken]).query(cloud)[0].max() for taken in (order, plain)]
    print(f"  no pixel is farther from the sample than {gaps[0]:.4f} mm, plain torch {gaps[1]:.4f} mm")


def render_with_trimesh(scene: Scene, mesh: trimesh.Trimesh) -> np.ndarray:
    """(height, width) depth of all bodies in one mesh, from `intersects_location`."""
    bodies = [
        trimesh.Trimesh(mesh.vertices @ R.T + t, mesh.faces, process=False)
        for R, t in zip(scene.R, scene.t, strict=True)
    ]
    camera = scene.camera
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = camera.rays(u, v).reshape(-1, 3)
    together = trimesh.util.concatenate(bodies)
    hits, ray, _ = together.ray.intersects_location(camera.near * rays, rays, multiple_hits=False)
    depth = np.zeros(len(rays))
    depth[ray] = hits[:, 2]
    return depth.reshape(camera.height, camera.width)


def visible_points(scene: Scene, view: View) -> np.ndarray:
    """(n, 3) float32 a point for each pixel on a body."""
    cloud: np.ndarray = scene.camera.depth_to_points(view.depth)[view.instance >= 0]
    return cloud.astype(np.float32)


def print_pair(name: str, seconds: float, other: str, other_seconds: float) -> None:
    print(f"{name:<34}{1000 * seconds:>12.1f} ms")
    print(f"{other:<34}{1000 * other_seconds:>12.1f} ms  ({other_seconds / seconds:.1f} x)")


def timed(work: Callable[[], T], repeats: int = 3) -> tuple[T, float]:
    """The result and the median of the seconds that the runs took."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = work()
        seconds.append(time.perf_counter() - start)
    return result, statistics.median(seconds)


if __name__ == "__main__":
    main()
