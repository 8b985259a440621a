"""Time from point-wise predictions to poses, stage by stage; beside scikit-learn's mean shift and a plain
loop over instances for the fits.

python benchmarks/bench_postprocess.py
python benchmarks/bench_postprocess.py --device cuda --scenes 8
"""

import argparse
import platform
from collections.abc import Callable

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from nut_bin import clock as timing
from omegaconf import OmegaConf
from scipy.spatial.transform import Rotation
from sklearn.cluster import MeanShift
from torch import Tensor

from pnet.cli.app import config_dir
from pnet.cli.instantiate import instantiate
from pnet.geometry.rigid import apply_pose
from pnet.parts.base import ParametricPart
from pnet.parts.choice import KeypointChoice, NearestToPoint
from pnet.postprocess.cluster import CentroidClusters
from pnet.postprocess.fit import fit_pose
from pnet.postprocess.grouping import clusters_of
from pnet.postprocess.pipeline import PoseRecovery
from pnet.records import PointPrediction

INSTANCES, POINTS = 60, 16384
WIDTH, DEPTH, APART = 0.2, 0.06, 0.02  # the bin, its filling, and the nearest centroids, metres
NOISE, STRAY = 0.0007, 0.05  # of a vote along each axis, metres; share of votes that lie anywhere
PARTS = ("tn06", "tn16", "tn34", "tn42")
SETTINGS = ("paper", "folded")
COLUMNS = {
    "cluster": 9,
    "sklearn": 9,
    "filter": 8,
    "vote": 8,
    "fit": 7,
    "fit loop": 10,
    "whole": 9,
    "found": 7,
}


def main() -> None:
    """Print one table row for each part and setting."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=11)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--scenes", type=int, default=1, help="that are recovered together")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    print(
        f"{processor(arguments.device)}, {arguments.threads} threads, {arguments.scenes} scenes together, "
        f"medians of {arguments.repeats}, torch {torch.__version__}"
    )
    print(f"milliseconds a scene of {INSTANCES} instances, {POINTS} points")
    print(f"{'part':6}{'setting':>9}" + "".join(f"{title:>{width}}" for title, width in COLUMNS.items()))
    for setting in SETTINGS:
        with initialize_config_dir(str(config_dir()), version_base="1.3"):
            recovery = instantiate(compose("train", overrides=[f"postprocess={setting}"]).postprocess)
        for name in PARTS:
            part = instantiate(OmegaConf.load(config_dir() / "part" / f"{name}.yaml"))
            by_point = not recovery.voting.filters_keypoints
            said = predictions(part, by_point, arguments.scenes, torch.device(arguments.device))
            row = zip(times(part, recovery, said, arguments.repeats), COLUMNS.values(), strict=True)
            print(f"{name:6}{setting:>9}" + "".join(f"{value:{width}.1f}" for value, width in row))


def processor(device: str) -> str:
    """What is measured."""
    if device.startswith("cuda"):
        return torch.cuda.get_device_name(device)
    return platform.processor() or platform.machine()


def times(
    part: ParametricPart, recovery: PoseRecovery, prediction: PointPrediction, repeats: int
) -> list[float]:
    """Milliseconds a scene of every column, and the number of instances found in the first."""
    scenes = len(prediction.centroid)

    def finished(run: Callable[[], object]) -> Callable[[], None]:
        def wait() -> None:
            run()
            if prediction.centroid.device.type == "cuda":
                torch.cuda.synchronize()

        return wait

    def clock(run: Callable[[], object], most: int = repeats) -> float:
        return timing(finished(run), most).ms / scenes

    centroids = prediction.centroid
    clusters = clusters_of(recovery.cluster(centroids))
    votes = recovery._votes(prediction, clusters)
    agreed = recovery.voting(part, votes)
    target = agreed.parameters, agreed.centroid, agreed.keypoints
    return [
        clock(lambda: recovery.cluster(centroids)),
        clock(lambda: [scikit_clusters(recovery.cluster, scene) for scene in centroids.cpu().double()], 1),
        clock(lambda: recovery._votes(prediction, clusters)),
        clock(lambda: recovery.voting(part, votes)),
        clock(lambda: fit_pose(part.chain, *target)),
        clock(
            lambda: [fit_pose(part.chain, *one) for one in zip(*(t.split(1) for t in target), strict=True)]
        ),
        clock(lambda: recovery(part, prediction)),
        len(recovery(part, prediction)[0].score),
    ]


def predictions(part: ParametricPart, by_point: bool, scenes: int, device: torch.device) -> PointPrediction:
    """Of so many different scenes."""
    each = [vars(predict(part, by_point, seed)).values() for seed in range(scenes)]
    return PointPrediction(*(torch.cat(values).to(device) for values in zip(*each, strict=True)))


def predict(part: ParametricPart, by_point: bool, seed: int = 0) -> PointPrediction:
    """A network that knows the labels up to noise and some wild votes, in a batch of one scene.

    Args:
        part: the template. by_point: labels of the rule `point`, else `camera`. seed: of everything random.
    """
    rng = np.random.default_rng(seed)
    R = torch.from_numpy(Rotation.random(INSTANCES, rng).as_matrix())
    t = torch.from_numpy(centres(rng))
    share = rng.uniform(0.2, 1.8, INSTANCES)  # some are hidden more than others
    owner = torch.from_numpy(rng.choice(INSTANCES, POINTS, p=share / share.sum()))
    size = part.part_object("L", len(part.grids["L"]) // 2)
    sizes = torch.from_numpy(size).expand(INSTANCES, -1)
    if by_point:
        surface = torch.from_numpy(np.asarray(part.mesh(size).sample(POINTS, seed=seed)))
        template = part.chain.keypoints_from_parameters(sizes)[owner]
        local, _ = part.chain.choose(NearestToPoint(surface), template)
    else:
        local = part.chain.select(KeypointChoice(), sizes, R)[0][owner]
    true = torch.cat([t[owner, None], apply_pose(R[owner], t[owner], local)], 1)
    votes = true + torch.from_numpy(rng.normal(0, NOISE, true.shape))
    stray = torch.from_numpy(rng.random(POINTS) < STRAY)
    votes[stray] = torch.from_numpy(anywhere(rng, (int(stray.sum()), votes.shape[1])))
    visibility = torch.from_numpy(rng.uniform(0.5, 1, INSTANCES))[owner]
    return PointPrediction(*(value.float()[None] for value in (votes[:, 0], votes[:, 1:], visibility)))


def centres(rng: np.random.Generator) -> np.ndarray:
    """(INSTANCES, 3) centroids in the bin, none too near to another, metres."""
    found = anywhere(rng, (1,))
    while len(found) < INSTANCES:
        new = anywhere(rng, (1,))
        if np.linalg.norm(found - new, axis=1).min() >= APART:
            found = np.concatenate([found, new])
    return found


def anywhere(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """(*shape, 3) places in the bin's filling, metres, camera frame."""
    half = WIDTH / 2
    return rng.uniform([-half, -half, 0.65 - DEPTH], [half, half, 0.65], (*shape, 3))


def scikit_clusters(cluster: CentroidClusters, centroids: Tensor) -> object:
    """The same clusters, seed by seed."""
    return MeanShift(
        bandwidth=cluster.bandwidth,
        bin_seeding=True,
        min_bin_freq=cluster.min_seed_points,
        cluster_all=False,
    ).fit(centroids.numpy())


if __name__ == "__main__":
    main()
