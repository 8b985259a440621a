"""The whole post-processing with the kernels of CUDA, against that of the CPU."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from pnet.data.targets import point_labels
from pnet.parts.choice import KeypointChoice
from pnet.postprocess.cluster import CentroidClusters
from pnet.postprocess.folded_vote import FoldedVote
from pnet.postprocess.kernels import Kernels, only
from pnet.postprocess.pipeline import PoseRecovery
from pnet.postprocess.pose_average import PoseAveraging
from pnet.postprocess.radius_filter import RadiusFilter
from pnet.postprocess.vote import MeanVote
from pnet.records import PointPrediction, PosePrediction

MEAN = PoseRecovery(
    CentroidClusters(0.01, 5, 8),
    RadiusFilter(0.001, 5, 0.001, 0.003, 0.9),
    MeanVote(),
    visibility_threshold=0.0,
    scene_parameters=True,
    best_visible=0.7,
    trust=0.001,
)
FOLDED = replace(MEAN, voting=FoldedVote(8, 20, 25.0, 3.0), radius_filter=None)
AVERAGING = PoseAveraging(CentroidClusters(0.01, 5, 8), visibility_threshold=0.6, votes=20, width=60.0)
WAITS = (
    "item",
    "tolist",
    "cpu",
    "numpy",
    "__bool__",
    "__int__",
    "__float__",
    "__index__",
    "nonzero",
    "unique",
)


def say(part, scene, seed: int) -> PointPrediction:
    """What a network says that knows the labels up to noise; the last two points' centroids lie anywhere."""
    g = torch.Generator().manual_seed(seed)
    labels = point_labels(scene, part.chain, KeypointChoice())
    noisy = [
        labels[name] + 0.0005 * torch.randn(labels[name].shape, generator=g)
        for name in ("centroid", "keypoints")
    ]
    noisy[0][-2:] += 0.1
    return PointPrediction(*(value[None] for value in (*noisy, labels["visibility"])))


@pytest.fixture(scope="module")
def batch(tn06, make_scene) -> PointPrediction:
    """Two scenes, between them one of no numbers."""
    both = [say(tn06, make_scene(tn06, bodies, 60, seed), seed) for bodies, seed in ((3, 0), (2, 1))]
    wrong = replace(both[0], centroid=both[0].centroid * torch.nan)
    rows = zip(*(vars(scene).values() for scene in (both[0], wrong, both[1])), strict=True)
    return PointPrediction(*(None if row[0] is None else torch.cat(row) for row in rows))


def moved(prediction, here):
    return type(prediction)(*here(*vars(prediction).values()))


def check(found, expected):
    assert [len(d.score) for d in found] == [len(d.score) for d in expected]
    for own, other in zip(found, expected, strict=True):
        for name, value in vars(own).items():
            assert value.device.type == "cpu"
            torch.testing.assert_close(value, getattr(other, name), rtol=0, atol=1e-9, equal_nan=True)


@pytest.mark.parametrize("recovery", [MEAN, FOLDED], ids=["mean", "folded"])
def test_a_batch_has_the_detections_it_has_on_the_cpu(here, tn06, batch, recovery):
    expected = recovery(tn06, batch)
    assert [len(d.score) for d in expected] == [3, 0, 2]
    assert all(set(d.instance[-2:].tolist()) == {-1} for d in expected)
    with only(Kernels.TRITON):
        check(recovery(tn06, moved(batch, here)), expected)


def test_averaged_poses_are_those_of_the_cpu(here, tn06, batch, make_scene):
    """Of points that are hidden nothing is counted."""
    scenes = [make_scene(tn06, bodies, 60, seed) for bodies, seed in ((3, 0), (3, 0), (2, 1))]
    R = torch.from_numpy(np.stack([scene.R[scene.instance] for scene in scenes]))
    seen = batch.visibility * (torch.arange(60) % 7 != 0)
    prediction = PosePrediction(batch.centroid, R, seen)
    expected = AVERAGING(tn06, prediction)
    assert [len(d.score) > 0 for d in expected] == [True, False, True]
    with only(Kernels.TRITON):
        check(AVERAGING(tn06, moved(prediction, here)), expected)


def test_how_often_the_host_waits_does_not_depend_on_scenes_or_clusters(here, tn06, batch, monkeypatch):
    """Counted in this room's own files: what is asked of a tensor on a device waits for all before it."""
    counts = []

    def count(name):
        whole = getattr(torch.Tensor, name)

        def counted(self, *args, **kwargs):
            counts[-1] += "pnet/postprocess/" in sys._getframe(1).f_code.co_filename
            return whole(self, *args, **kwargs)

        monkeypatch.setattr(torch.Tensor, name, counted)

    for name in WAITS:
        count(name)
    recovery = replace(MEAN, radius_filter=None, scene_parameters=False)
    last = PointPrediction(batch.centroid[2:], batch.keypoints[2:], batch.visibility[2:])
    with only(Kernels.TRITON):
        for scenes in (batch, last):
            counts.append(0)
            recovery(tn06, moved(scenes, here))
    assert counts == [4, 4]  # for the number of seeds, of clusters; for the instances, the points' numbers
