"""Scenes of a batch are recovered as each of them alone, by any kernels."""

from dataclasses import replace

import pytest
import torch
from tests.conftest import load_part

from pnet.data.targets import point_labels
from pnet.parts.choice import KeypointChoice, KeypointRule
from pnet.postprocess.batches import in_batches, sound_points
from pnet.postprocess.cluster import CentroidClusters
from pnet.postprocess.folded_vote import FoldedVote
from pnet.postprocess.kernels import Kernels, only
from pnet.postprocess.pipeline import PoseRecovery
from pnet.postprocess.pose_average import PoseAveraging
from pnet.postprocess.radius_filter import RadiusFilter
from pnet.postprocess.vote import MeanVote
from pnet.records import Detections, PointPrediction, PosePrediction

MEAN = PoseRecovery(
    CentroidClusters(0.01, 5, 10),
    RadiusFilter(0.002, 5, 0.002, 0.02, 0.5),
    MeanVote(),
    visibility_threshold=0.6,
    scene_parameters=True,
    best_visible=0.7,
    trust=0.001,
)
FOLDED = replace(MEAN, voting=FoldedVote(32, 100, 25.0, 3.0), scene_parameters=False)
AVERAGING = PoseAveraging(CentroidClusters(0.01, 5, 10), visibility_threshold=0.6, votes=100, width=60.0)
FIELDS = ("R", "t", "parameters", "score", "keypoints", "instance")


def cat(*scenes):
    """One batch of predictions of one scene each."""
    names = {name for name, value in vars(scenes[0]).items() if value is not None}
    return replace(scenes[0], **{name: torch.cat([getattr(p, name) for p in scenes]) for name in names})


def one(batch, i: int):
    return replace(batch, **{k: v[i : i + 1] for k, v in vars(batch).items() if v is not None})


@pytest.fixture(scope="module")
def points(make_scene):
    """Makes what a noisy network says of scenes: full, without any cluster, no numbers, another size."""

    def make(part, rule: KeypointRule = KeypointRule.CAMERA) -> PointPrediction:
        choice = KeypointChoice(rule)
        g = torch.Generator().manual_seed(0)

        def say(bodies: int, seed: int) -> PointPrediction:
            labels = point_labels(make_scene(part, bodies, 420, seed), part.chain, choice)
            noisy = (
                v + 0.0005 * torch.randn(v.shape, generator=g)
                for v in map(labels.get, ("centroid", "keypoints"))
            )
            return PointPrediction(*(v[None] for v in (*noisy, labels["visibility"])))

        full, scattered, wrong, other = say(7, 0), say(2, 0), say(3, 1), say(4, 2)
        scattered.centroid[:] += torch.arange(420.0)[None, :, None]
        wrong.keypoints[0, 17, 1] = torch.nan
        return cat(full, scattered, wrong, other, replace(full, visibility=full.visibility * torch.inf))

    return make


@pytest.fixture(scope="module")
def poses(make_scene):
    def make(part) -> PosePrediction:
        g = torch.Generator().manual_seed(0)

        def say(bodies: int, seed: int) -> PosePrediction:
            scene = make_scene(part, bodies, 420, seed)
            owner = torch.from_numpy(scene.instance)
            R, t, seen = (torch.from_numpy(x)[owner] for x in (scene.R, scene.t, scene.visibility))
            t = t + 0.0005 * torch.randn(t.shape, generator=g)
            return PosePrediction(t[None], R[None], (seen + 0.02 * torch.randn(420, generator=g))[None])

        wrong = say(3, 1)
        wrong.rotation[0, 17, 1] = torch.nan
        return cat(say(7, 0), wrong, say(4, 2))

    return make


def check(found: list[Detections], expected: list[Detections], tolerance: float) -> None:
    """Equal numbers, or (up to the turn that a symmetry leaves open) nearly."""
    assert [len(d.score) for d in found] == [len(d.score) for d in expected]
    for own, other in zip(found, expected, strict=True):
        for name in FIELDS:
            torch.testing.assert_close(
                getattr(own, name), getattr(other, name), rtol=0, atol=tolerance, equal_nan=True
            )


@pytest.mark.parametrize("recovery", [MEAN, FOLDED], ids=["mean", "folded"])
def test_on_the_cpu_a_batch_is_its_scenes_to_the_last_bit(part, points, recovery):
    batch = points(part)
    found = recovery(part, batch)
    assert [len(d.score) > 0 for d in found] == [True, False, False, True, False]
    check(found, [recovery(part, one(batch, i))[0] for i in range(5)], 0)
    check(recovery(part, cat(one(batch, 3), one(batch, 0))), [found[3], found[0]], 0)
    unseen = replace(batch, visibility=None)
    check(recovery(part, unseen), [recovery(part, one(unseen, i))[0] for i in range(5)], 0)


@pytest.mark.parametrize("recovery", [MEAN, FOLDED], ids=["mean", "folded"])
@pytest.mark.parametrize("rule", [KeypointRule.CAMERA, KeypointRule.POINT])
@pytest.mark.parametrize("name", ["tn06", "tn42"])
def test_all_scenes_at_once_in_plain_torch_give_the_same(name, points, recovery, rule):
    part = load_part(name)
    batch = points(part, rule)
    expected = recovery(part, batch)
    with only(Kernels.PLAIN):
        check(recovery(part, batch), expected, 1e-9)
        check(recovery(part, one(batch, 3)), expected[3:4], 1e-9)
        check(recovery(part, one(batch, 1)), expected[1:2], 0)


def test_a_revolutions_poses_are_the_same_but_for_the_turn_about_its_axis(tn34, points):
    batch = points(tn34)
    expected = MEAN(tn34, batch)
    with only(Kernels.PLAIN):
        found = MEAN(tn34, batch)
    axes = [[replace(d, R=d.R[..., 2]) for d in both] for both in (found, expected)]
    check(*axes, 1e-9)
    assert len(found[0].score) > 2


@pytest.mark.parametrize("name", ["tn06", "tn34"])
@pytest.mark.parametrize("kernels", [Kernels.NUMBA, Kernels.PLAIN])
def test_poses_averaged_over_a_batch_are_those_of_its_scenes(name, poses, kernels):
    part = load_part(name)
    batch = poses(part)
    expected = [AVERAGING(part, one(batch, i))[0] for i in range(3)]
    assert [len(d.score) > 0 for d in expected] == [True, False, True]
    with only(kernels):
        check(AVERAGING(part, batch), expected, 0 if kernels is Kernels.NUMBA else 1e-9)
        unseen = replace(batch, visibility=None)
        assert len(AVERAGING(part, unseen)[0].score) == 7


@pytest.mark.parametrize("kernels", [Kernels.NUMBA, Kernels.PLAIN])
@pytest.mark.parametrize("shape", [(0, 5), (2, 0), (1, 1)])
def test_without_points_or_scenes_there_is_nothing(tn06, kernels, shape):
    said = torch.zeros(*shape, 3), torch.zeros(*shape, len(tn06.chain), 3), torch.ones(shape)
    with only(kernels):
        for prediction in (PointPrediction(*said), PointPrediction(*said[:2], None)):
            found = MEAN(tn06, prediction)
            assert [d.instance.tolist() for d in found] == [[-1] * shape[1]] * shape[0]
        for seen in (said[2], None):
            found = AVERAGING(tn06, PosePrediction(said[0], torch.zeros(*shape, 3, 3), seen))
            assert [len(d.score) for d in found] == [0] * shape[0]


def test_the_cpus_kernels_get_one_scene_at_a_time_and_others_all():
    batch, clouds = PosePrediction(torch.zeros(3, 4, 3), torch.zeros(3, 4, 3, 3), None), torch.rand(3, 4, 3)
    seen = []

    def note(prediction, points):
        seen.append((len(prediction.centroid), points))
        return [len(seen)] * len(prediction.centroid)

    assert in_batches(note, batch, clouds) == [1, 2, 3]
    assert all(n == 1 and torch.equal(points[0], clouds[i]) for i, (n, points) in enumerate(seen))
    with only(Kernels.PLAIN):
        assert in_batches(note, batch, None) == [4] * 3
    assert seen[3] == (3, None)


def test_a_scene_of_which_something_is_no_number_has_no_sound_point():
    first, second = torch.zeros(3, 2, 3), torch.zeros(3, 2)
    first[0, 1, 2], second[2, 0] = torch.nan, -torch.inf
    assert sound_points(first, second).tolist() == [[False] * 2, [True] * 2, [False] * 2]
    assert sound_points(first, None).tolist() == [[False] * 2, [True] * 2, [True] * 2]
