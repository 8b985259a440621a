"""Time to choose label keypoints, and to fold votes; beside a plain loop over instances.

python benchmarks/bench_labels.py
"""

import platform
from collections.abc import Callable

import numpy as np
import torch
from nut_bin import clock as timing
from omegaconf import OmegaConf

from pnet.cli.app import config_dir
from pnet.cli.instantiate import instantiate
from pnet.geometry.rigid import apply_pose
from pnet.parts.base import ParametricPart
from pnet.parts.checks import random_instances
from pnet.parts.choice import KeypointChoice, NearestToPoint
from pnet.postprocess.folded_vote import FoldedVote
from pnet.postprocess.vote import MeanVote, PointVotes

SCENES, INSTANCES, POINTS = 100, 60, 16384
REPEATS = 7
PARTS = ("tn06", "tn16", "tn34", "tn42", "tless20")
COLUMNS = {"camera": 9, "amortised": 11, "plain loop": 12, "point": 8, "mean vote": 11, "folded": 10}
FOLDED = FoldedVote(hypotheses=256, votes=512, width=25.0, cut=1.5)


def main() -> None:
    """Print one table row for each part."""
    torch.set_num_threads(2)
    print(f"{platform.processor() or platform.machine()}, 2 threads, medians of {REPEATS}")
    print(
        f"milliseconds a scene of {INSTANCES} instances, {POINTS} points; amortised: {SCENES} scenes a call"
    )
    print(f"{'part':8}" + "".join(f"{title:>{width}}" for title, width in COLUMNS.items()))
    for name in PARTS:
        part = instantiate(OmegaConf.load(config_dir() / "part" / f"{name}.yaml"))
        row = zip(times(part), COLUMNS.values(), strict=True)
        print(f"{name:8}" + "".join(f"{value:{width}.3f}" for value, width in row))


def times(part: ParametricPart) -> list[float]:
    """Milliseconds a scene: camera rule, amortised, plain loop, point rule, mean vote, folded vote."""

    def clock(run: Callable[[], object]) -> float:
        return timing(run, REPEATS).ms

    choice = KeypointChoice()
    many_sizes, many_R, _ = random_instances(part, SCENES * INSTANCES, seed=0)
    sizes, R, t = random_instances(part, INSTANCES, seed=1)
    owner = torch.arange(POINTS) % INSTANCES
    points = surface_points(part, sizes, owner)
    template = part.chain.keypoints_from_parameters(sizes)
    local, _ = part.chain.choose(NearestToPoint(points), template[owner])
    votes = PointVotes(
        t[owner],
        apply_pose(R[owner], t[owner], local),
        owner,
        INSTANCES,
        torch.ones(POINTS, 1 + len(part.chain), dtype=torch.bool),
    )
    return [
        clock(lambda: part.chain.select(choice, sizes, R)),
        clock(lambda: part.chain.select(choice, many_sizes, many_R)) / SCENES,
        clock(lambda: [part.chain.select(choice, s, r) for s, r in zip(sizes, R, strict=True)]),
        clock(
            lambda: part.chain.choose(
                NearestToPoint(points), part.chain.keypoints_from_parameters(sizes)[owner]
            )
        ),
        clock(lambda: MeanVote()(part, votes)),
        clock(lambda: FOLDED(part, votes)),
    ]


def surface_points(part: ParametricPart, sizes: torch.Tensor, owner: torch.Tensor) -> torch.Tensor:
    """(N, 3) points on the smallest part object's surface, scaled to each instance's reach, part frame."""
    mesh = part.mesh(part.part_object("L", 0))
    sample = torch.from_numpy(np.asarray(mesh.sample(len(owner), seed=0)))
    reach = torch.linalg.vector_norm(part.chain.keypoints_from_parameters(sizes), dim=-1).amax(-1)
    return sample * (reach / reach.min())[owner, None]


if __name__ == "__main__":
    main()
