"""Times the making and the reading of scenes by stage, and beside it the obvious ways.

Run from the repository root: OMP_NUM_THREADS=1 python benchmarks/bench_generation.py
"""

import argparse
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import trimesh
from omegaconf import OmegaConf
from scipy.spatial import cKDTree

from pnet.cli.instantiate import instantiate
from pnet.data.augmentation import Augmentation
from pnet.data.module import SceneDataModule, Targets
from pnet.data.source import StoredData
from pnet.data.views import RandomViews, StoredViews
from pnet.ops.operators import plain_operators
from pnet.ops.sampling import farthest_point_order
from pnet.records import Scene
from pnet.scenes.bullet import connect
from pnet.scenes.factory import SceneFactory
from pnet.scenes.generation import CycleReport, Plan, cycle_path, generate, open_root
from pnet.scenes.noise import NoNoise
from pnet.scenes.pile_factory import PileFactory
from pnet.scenes.protocol import CycleTask, Protocol, SplitPlan
from pnet.scenes.rendering import View, render_view
from pnet.scenes.store import CycleFile
from pnet.scenes.view_factory import ViewFactory

T = TypeVar("T")
CONF = Path(__file__).parents[1] / "conf"
PARTS = {"tn06": 21, "tn34": 5}  # a part object of middling size
ENGINES = ("pybullet", "mujoco")
STAGES = ("simulate", "render", "sample", "write")
LOADED = 60  # scenes read for a loader's rate


def main() -> None:
    arguments = parse_arguments()
    print(f"{platform.processor() or platform.machine()}, {arguments.workers or 'no'} workers")
    print(f"{arguments.cycles} cycles of {arguments.drop_limit} drops, {arguments.points} points a scene")
    for name in arguments.parts:
        index = PARTS[name]
        for engine in (engine for engine in ENGINES if find_spec(engine)):
            factory = build_factory(name, engine, arguments)
            with tempfile.TemporaryDirectory() as folder:
                full_bin = time_stages(factory, Path(folder), index, arguments.workers, engine)
                if engine == ENGINES[0]:
                    time_loading(factory, Path(folder))
        compare(factory, full_bin)


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drop-limit", type=int, default=60)
    parser.add_argument("--points", type=int, default=16_384)
    parser.add_argument("--cycles", type=int, default=4, help="the table has their medians")
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--workers", type=int, default=2, help="0 works in this process")
    return parser.parse_args()


def build(path: str) -> Any:
    return instantiate(OmegaConf.load(CONF / f"{path}.yaml"))


def build_factory(name: str, engine: str, arguments: argparse.Namespace) -> SceneFactory:
    """The configs' own settings, but for the protocol."""
    plan = SplitPlan("L", arguments.cycles)
    protocol = Protocol("bench", arguments.drop_limit, arguments.points, {"train": plan})
    part, physics = build(f"part/{name}"), build(f"physics/{engine}")
    piles = PileFactory(part, protocol, build("bin/square_150"), physics, build("clutter/spread"), 0, "bench")
    views = ViewFactory(part, build("camera/ensenso_n35"), build("view/above"), NoNoise(), arguments.points)
    return SceneFactory(piles, views, "bench")


def time_stages(factory: SceneFactory, root: Path, index: int, workers: int, engine: str) -> Scene:
    """Print the stages of all cycles; the first cycle's last scene."""
    protocol, part = factory.piles.protocol, factory.piles.part
    cycles = range(protocol.splits["train"].cycles)
    tasks = [CycleTask("train", "pile", "L", cycle, index) for cycle in cycles]
    plan = Plan(factory, root / "piles", root)
    manifest = {
        "camera": factory.views.camera.to_dict(),
        "protocol": {"points": protocol.points},
        "files": {"train": len(tasks)},
    }
    for folder in (plan.piles, plan.scenes):
        open_root(folder, manifest)
    reports, seconds = timed(lambda: list(generate(plan, tasks, workers)), repeats=1)
    made = [report for report in reports if report is not None]
    print(f"\n{part.name}, {part.text(part.part_object('L', index))}, {engine}")
    print(f"{'stage':<34}{'ms a scene':>12}{'scenes/s':>12}")
    for stage in STAGES:
        print_row(stage, statistics.median(per_scene(report, stage) for report in made))
    print_row("all, one process", statistics.median(sum(per_scene(r, s) for s in STAGES) for r in made))
    print_row("all, by the clock", seconds / sum(report.scenes for report in made))
    sizes = [path.stat().st_size for path in (cycle_path(f, tasks[0]) for f in (plan.piles, root))]
    print(f"bytes a scene: piles {sizes[0] // made[0].scenes}, scenes {sizes[1] // made[0].scenes}")
    file = CycleFile(cycle_path(root, tasks[0]))
    return file.scene(len(file) - 1)


def per_scene(report: CycleReport, stage: str) -> float:
    return float(getattr(report.times, stage)) / report.scenes


def print_row(name: str, seconds: float) -> None:
    print(f"{name:<34}{1000 * seconds:>12.1f}{1 / seconds:>12.1f}")


def time_loading(factory: SceneFactory, root: Path) -> None:
    """How fast one loader process reads scenes with their labels, and renders new views."""
    light, stored = build("noise/structured_light"), StoredViews()
    around = RandomViews((0.6, 0.7), (0.0, 15.0))
    ways = {
        "read, label by camera": ("camera", stored, NoNoise()),
        "read, label by point": ("point", stored, NoNoise()),
        "read, noise, label by camera": ("camera", stored, light),
        "new view, label by camera": ("camera", around, NoNoise()),
        "new view, noise, label by camera": ("camera", around, light),
    }
    for name, (rule, views, noise) in ways.items():
        data = SceneDataModule(
            factory.piles.part,
            StoredData(root),
            Targets(rule),
            Augmentation(),
            None,
            1,
            None,
            1,
            0,
            0,
            views=views,
            noise=noise,
        )
        dataset: Any = data.train_dataloader().dataset
        dataset[0, 0]  # opens files
        draws = np.random.default_rng(0).permutation(len(dataset))[:LOADED].tolist()
        times = [timed(partial(dataset.__getitem__, (i, 0)), repeats=1)[1] for i in draws]
        print_row(name, statistics.median(times))


def compare(factory: SceneFactory, scene: Scene) -> None:
    """One full bin, rendered and sampled in pnet's way and in the obvious ones."""
    mesh = factory.piles.part.mesh(scene.parameters[0])
    view, rendered = timed(lambda: render_view(scene.camera, mesh, scene.R, scene.t))
    depth, cast = timed(lambda: render_with_trimesh(scene, mesh))
    differing = (np.abs(depth - view.depth) > 1e-4)[view.instance >= 0].mean()
    cloud, count = visible_points(scene, view), factory.piles.protocol.points
    order, sampled = timed(lambda: farthest_point_order(cloud, count))
    with plain_operators():
        plain, looped = timed(lambda: farthest_point_order(cloud, count), repeats=1)
    print(f"a full bin of {len(scene.R)} bodies, {len(cloud)} pixels on them")
    print_pair("render_view", rendered, "trimesh, all bodies in one mesh", cast)
    print(f"  {differing:.2%} of the pixels differ by more than 0.1 mm; trimesh gives no silhouettes")
    print_pair("render_view", rendered, "PyBullet's own renderer", render_with_bullet(scene, mesh))
    print_pair("farthest_point_order", sampled, "plain torch", looped)
    if find_spec("fpsample"):
        import fpsample

        other = timed(lambda: fpsample.bucket_fps_kdline_sampling(cloud, count, h=7))[1]
        print_pair("farthest_point_order", sampled, "fpsample, k-d line, h=7", other)
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


def render_with_bullet(scene: Scene, mesh: trimesh.Trimesh) -> float:
    """Seconds that PyBullet's software renderer takes for depth and instances."""
    bullet, client = connect()
    camera = scene.camera
    with tempfile.NamedTemporaryFile(suffix=".obj") as file:
        mesh.export(file.name)
        shape = client.createVisualShape(bullet.GEOM_MESH, fileName=file.name)
        for R, t in zip(scene.R, scene.t, strict=True):
            turn = trimesh.transformations.quaternion_from_matrix(R)[[1, 2, 3, 0]]
            client.createMultiBody(0, -1, shape, basePosition=t.tolist(), baseOrientation=turn.tolist())
    look = client.computeViewMatrix([0, 0, 0], [0, 0, 1], [0, -1, 0])
    angle = 2 * np.degrees(np.arctan(camera.height / 2 / camera.fy))
    lens = client.computeProjectionMatrixFOV(angle, camera.width / camera.height, camera.near, camera.far)
    seconds = timed(
        lambda: client.getCameraImage(
            camera.width, camera.height, look, lens, renderer=bullet.ER_TINY_RENDERER
        )
    )[1]
    client.disconnect()
    return seconds


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
