"""Ties between results and true poses."""

import math

import pytest
import torch

from pnet.geometry.pose_space import PoseSpace
from pnet.geometry.symmetry import SphericalSymmetry, cyclic
from pnet.metrics.matching import ScoredPoses, TruePoses, match_scene, nearest_matches


def sphere(threshold: float = 0.1) -> PoseSpace:
    """A body whose pose distance is the distance of positions."""
    eye = torch.eye(3, dtype=torch.float64)
    return PoseSpace(SphericalSymmetry(), eye[0, 0], eye, 0 * eye[0], threshold)


def truths_at(x: list[float], occlusion: list[float] | None = None) -> TruePoses:
    return TruePoses(*poses_at(x), torch.tensor(occlusion or [0.0] * len(x)))


def results_at(x: list[float], score: list[float] | None = None) -> ScoredPoses:
    return ScoredPoses(*poses_at(x), torch.tensor(score or [1.0] * len(x)))


def poses_at(x: list[float]) -> tuple[torch.Tensor, torch.Tensor]:
    t = torch.zeros(len(x), 3, dtype=torch.float64)
    t[:, 0] = torch.tensor(x, dtype=torch.float64)
    return torch.eye(3).expand(len(x), 3, 3), t


def test_each_result_is_tied_to_its_nearest_true_pose():
    match = match_scene(sphere(), truths_at([0.0, 1.0]), results_at([0.05, 0.9, 0.7, -3.0]))
    assert match.truth.tolist() == [0, 1, 1, 0]
    torch.testing.assert_close(match.distance, torch.tensor([0.05, 0.1, 0.3, 3.0]).double())
    assert match.matched.tolist() == [True, True, False, False]


def test_a_distance_equal_to_the_threshold_is_a_match():
    assert match_scene(sphere(0.5), truths_at([0.0]), results_at([0.5])).matched.tolist() == [True]


def test_a_pose_is_relevant_up_to_and_with_the_largest_occlusion():
    truth = truths_at([0.0, 1.0, 2.0], [0.0, 0.5, 0.51])
    assert match_scene(sphere(), truth, results_at([])).relevant.tolist() == [True, True, False]
    match = match_scene(sphere(), truth, results_at([]), max_occlusion=0.6)
    assert match.relevant.tolist() == [True, True, True]


def test_a_symmetric_turn_is_no_distance():
    eye = torch.eye(3, dtype=torch.float64)
    space = PoseSpace(cyclic(4), eye, eye, 0 * eye[0], 1e-6)
    results = ScoredPoses(cyclic(4).rotations, torch.zeros(4, 3), torch.arange(4.0))
    assert match_scene(space, truths_at([0.0]), results).matched.all()


def test_results_without_truths_are_unmatched():
    match = match_scene(sphere(), truths_at([]), results_at([0.0, 1.0]))
    assert match.truth.tolist() == [-1, -1]
    assert match.distance.tolist() == [math.inf, math.inf]
    assert match.matched.tolist() == [False, False]
    assert match.relevant.shape == (0,)
    assert [len(index) for index in nearest_matches(match)] == [0, 0]


@pytest.mark.parametrize("x", [[], [0.0, 1.0]])
def test_a_scene_without_results_has_empty_ties(x):
    match = match_scene(sphere(), truths_at(x), results_at([]))
    assert match.score.shape == match.truth.shape == match.matched.shape == (0,)
    assert match.relevant.tolist() == [True] * len(x)
    assert [len(index) for index in nearest_matches(match)] == [0, 0]


def test_nearest_matches_give_one_result_for_each_relevant_pose_that_has_one():
    truth = truths_at([0.0, 1.0, 2.0, 3.0], [0.0, 0.9, 0.0, 0.0])
    results = results_at([2.05, 0.09, 1.0, -0.01, 2.2, 0.03], [6.0, 5.0, 4.0, 3.0, 2.0, 1.0])
    i, j = nearest_matches(match_scene(sphere(), truth, results))
    assert i.tolist() == [0, 2]  # 1 is occluded, 3 was not found
    assert j.tolist() == [3, 0]  # the nearest, not the surest


def test_records_hold_float64_on_the_cpu():
    results = ScoredPoses(torch.eye(3)[None].float(), torch.zeros(1, 3), torch.ones(1))
    assert {results.R.dtype, results.t.dtype, results.score.dtype} == {torch.float64}


@pytest.mark.parametrize(
    ("R", "t", "score", "name"),
    [
        ((2, 3, 3), (3, 3), (3,), "R has shape"),
        ((3, 3, 3), (3, 2), (3,), "t has shape"),
        ((3, 3, 3), (3, 3), (3, 1), "score has shape"),
        ((3, 3), (3,), (), "R has shape"),
        ((3, 3), (), (), "R has shape"),
    ],
)
def test_a_wrong_shape_is_refused(R, t, score, name):
    with pytest.raises(ValueError, match=name):
        ScoredPoses(torch.zeros(R), torch.zeros(t), torch.zeros(score))


@pytest.mark.parametrize("name", ["R", "t", "occlusion"])
def test_nan_is_refused(name):
    fields = {"R": torch.eye(3)[None], "t": torch.zeros(1, 3), "occlusion": torch.zeros(1)}
    fields[name] = fields[name] * math.nan
    with pytest.raises(ValueError, match=f"true poses: {name} holds NaN"):
        TruePoses(**fields)
