"""Times the scoring of scenes on one core, and beside it the naive twin of the tests.

Run from the repository root: OMP_NUM_THREADS=1 python benchmarks/bench_average_precision.py
"""

import argparse
import importlib.util
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import TypeVar

import roma
import torch

from pnet.geometry.pose_space import PoseSpace
from pnet.geometry.symmetry import dihedral
from pnet.metrics.average_precision import (
    average_precision,
    mean_average_precision,
    precision_recall_curve,
)
from pnet.metrics.matching import SceneMatch, ScoredPoses, TruePoses, match_scene

T = TypeVar("T")
Drawn = list[tuple[TruePoses, ScoredPoses]]


def main() -> None:
    arguments = parse_arguments()
    torch.set_num_threads(1)
    n, space, generator = arguments.poses, nut_space(), torch.Generator().manual_seed(0)
    drawn = [draw_scene(n, generator) for _ in range(arguments.scenes)]
    print(f"{platform.processor() or platform.machine()}, one thread, torch {torch.__version__}")
    print(f"{arguments.scenes} scenes x {n} truths x {n} results, 12 symmetry rotations")
    time_stages(space, drawn)
    if arguments.naive_scenes:
        time_naive(space, drawn[: arguments.naive_scenes])


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--poses", type=int, default=60, help="true poses and results a scene")
    parser.add_argument("--naive-scenes", type=int, default=5, help="0 leaves the naive twin out")
    return parser.parse_args()


def nut_space() -> PoseSpace:
    """A hexagonal nut of some 3 cm, metres."""
    scale = torch.diag(torch.tensor([0.008, 0.008, 0.005], dtype=torch.float64))
    eye = torch.eye(3, dtype=torch.float64)
    return PoseSpace(dihedral(6), scale, eye, torch.zeros(3, dtype=torch.float64), 0.0035)


def draw_scene(n: int, generator: torch.Generator) -> tuple[TruePoses, ScoredPoses]:
    """n true poses in a bin of 30 cm; two results of three near one, some of them duplicates."""
    R = roma.special_procrustes(torch.randn(n, 3, 3, generator=generator, dtype=torch.float64))
    t = 0.3 * torch.rand(n, 3, generator=generator, dtype=torch.float64)
    pick = torch.randint(0, n, (n,), generator=generator)
    noise = torch.where(torch.rand(n, generator=generator) < 2 / 3, 0.001, 0.02)[:, None]
    found = t[pick] + noise * torch.randn(n, 3, generator=generator, dtype=torch.float64)
    truth = TruePoses(R, t, torch.rand(n, generator=generator))
    return truth, ScoredPoses(R[pick], found, torch.rand(n, generator=generator))


def time_stages(space: PoseSpace, drawn: Drawn) -> None:
    matches, distances = timed(lambda: match_all(space, drawn))
    curve, macro = timed(lambda: precision_recall_curve(matches))
    mean, own = timed(lambda: mean_average_precision(matches))
    print(f"AP {average_precision(curve):.4f}, MAP {mean:.4f}")
    rows = {
        "distances and matches": distances,
        "curve and AP": macro,
        "MAP": own,
        "all": distances + macro + own,
    }
    for name, seconds in rows.items():
        print(f"{name:<34}{seconds:>10.3f} s")


def time_naive(space: PoseSpace, drawn: Drawn) -> None:
    twin = load_naive_twin()
    fast, fast_seconds = timed(lambda: average_precision(precision_recall_curve(match_all(space, drawn))))
    naive, naive_seconds = timed(lambda: twin.naive_ap([twin.naive_scene(space, *scene) for scene in drawn]))
    if abs(fast - naive) > 1e-9:
        raise SystemExit(f"AP differs: pnet {fast}, naive twin {naive}")
    print(f"the same AP of {len(drawn)} scenes, {fast:.4f}:")
    print(f"{'pnet':<34}{fast_seconds:>10.3f} s")
    print(f"{'naive twin':<34}{naive_seconds:>10.3f} s  ({naive_seconds / fast_seconds:.0f} x)")


def match_all(space: PoseSpace, drawn: Drawn) -> list[SceneMatch]:
    return [match_scene(space, truth, results) for truth, results in drawn]


def timed(work: Callable[[], T], repeats: int = 3) -> tuple[T, float]:
    """The result and the median of the seconds that the runs took."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = work()
        seconds.append(time.perf_counter() - start)
    return result, statistics.median(seconds)


def load_naive_twin() -> ModuleType:
    """The tests are no package, so their module is loaded from its file."""
    path = Path(__file__).parents[1] / "tests" / "metrics" / "test_average_precision.py"
    spec = importlib.util.spec_from_file_location("naive_average_precision", path)
    if spec is None or spec.loader is None:
        raise SystemExit(f"{path}: cannot be loaded, run this from a checkout of the repository")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    main()
