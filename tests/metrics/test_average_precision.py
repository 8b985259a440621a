"""Precision, recall and what is drawn from them, against hand-made cases and a naive twin."""

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import average_precision_score

from pnet.geometry.pose_space import PoseSpace
from pnet.geometry.symmetry import SphericalSymmetry
from pnet.metrics.average_precision import (
    PrecisionRecallCurve,
    average_precision,
    best_f1,
    count_positives,
    mean_average_precision,
    precision_recall_curve,
    recall_at_precision,
)
from pnet.metrics.matching import SceneMatch, ScoredPoses, TruePoses, match_scene

# --- the naive twin -------------------------------------------------------------------------------


@dataclass
class NaiveScene:
    """distance: rows of results, columns of true poses."""

    distance: list[list[float]]
    score: list[float]
    occlusion: list[float]
    distance_threshold: float


def naive_scene(space: PoseSpace, truth: TruePoses, results: ScoredPoses) -> NaiveScene:
    distance = [
        [float(space.distance(Rr, tr, Rt, tt)) for Rt, tt in zip(truth.R, truth.t, strict=True)]
        for Rr, tr in zip(results.R, results.t, strict=True)
    ]
    return NaiveScene(distance, results.score.tolist(), truth.occlusion.tolist(), space.distance_threshold)


def naive_counts(scene: NaiveScene, threshold: float) -> tuple[int, int]:
    """True and false positives, by tying anew among the positives."""
    tied: dict[int, list[tuple[float, int]]] = {}
    true = false = 0
    for i, row in enumerate(scene.distance):
        if scene.score[i] < threshold:
            continue
        if not row or min(row) > scene.distance_threshold:
            false += 1
            continue
        tied.setdefault(row.index(min(row)), []).append((min(row), i))
    for truth, positives in tied.items():
        nearest = min(positives)
        false += sum(positive != nearest for positive in positives)
        true += scene.occlusion[truth] <= 0.5
    return true, false


def naive_precision_recall(scene: NaiveScene, threshold: float) -> tuple[float, float]:
    true, false = naive_counts(scene, threshold)
    to_find = sum(occlusion <= 0.5 for occlusion in scene.occlusion)
    return true / (true + false) if true + false else 1.0, true / to_find if to_find else 1.0


def naive_curve(scenes: list[NaiveScene]) -> list[tuple[float, float]]:
    """(precision, recall) at each threshold, averaged over scenes; the first point is (1, 0)."""
    thresholds = sorted({score for scene in scenes for score in scene.score}, reverse=True)
    points = [(1.0, 0.0)]
    for threshold in thresholds or [-math.inf]:
        pairs = [naive_precision_recall(scene, threshold) for scene in scenes]
        points.append(tuple(sum(column) / len(scenes) for column in zip(*pairs, strict=True)))
    return points


def naive_ap(scenes: list[NaiveScene]) -> float:
    points = naive_curve(scenes)
    return sum((r - r0) * p for (_, r0), (p, r) in pairwise(points))


def naive_f1(scenes: list[NaiveScene]) -> float:
    return max(2 * p * r / (p + r) if p + r else 0.0 for p, r in naive_curve(scenes))


# --- hand-made cases ------------------------------------------------------------------------------


def scene(score: list[float], truth: list[int | None], relevant: list[bool]) -> SceneMatch:
    """A match in which result i hits true pose truth[i], or none."""
    return SceneMatch(
        torch.tensor(score, dtype=torch.float64),
        torch.tensor([-1 if hit is None else hit for hit in truth], dtype=torch.int64),
        torch.zeros(len(score), dtype=torch.float64),
        torch.tensor([hit is not None for hit in truth], dtype=torch.bool),
        torch.tensor(relevant, dtype=torch.bool),
    )


NOTHING_FOUND = scene([], [], [True, True])
NOTHING_TO_FIND = scene([], [], [])


def test_one_scene_by_hand():
    # falling score: hit, miss, hit, duplicate of the first; one of three is never found
    match = scene([0.9, 0.8, 0.7, 0.6], [0, None, 1, 0], [True] * 3)
    curve = precision_recall_curve([match])
    np.testing.assert_allclose(curve.precision, [1, 1, 1 / 2, 2 / 3, 2 / 4])
    np.testing.assert_allclose(curve.recall, [0, 1 / 3, 1 / 3, 2 / 3, 2 / 3])
    np.testing.assert_allclose(curve.threshold, [np.inf, 0.9, 0.8, 0.7, 0.6])
    assert average_precision(curve) == pytest.approx(1 / 3 + 1 / 3 * 2 / 3)
    assert mean_average_precision([match]) == pytest.approx(average_precision(curve))
    assert best_f1(curve) == pytest.approx(2 / 3)
    assert recall_at_precision(curve) == pytest.approx(1 / 3)
    assert count_positives([match]) == (2, 2)


def test_an_occluded_pose_counts_neither_way_and_its_duplicates_count_against():
    match = scene([0.9, 0.8, 0.7], [0, 0, 1], [False, True])
    curve = precision_recall_curve([match])
    np.testing.assert_allclose(curve.precision, [1, 1, 0, 1 / 2])
    np.testing.assert_allclose(curve.recall, [0, 0, 0, 1])
    assert count_positives([match]) == (1, 1)


def test_equal_scores_enter_together():
    match = scene([0.5, 0.5, 0.5], [None, 0, 1], [True, True])
    curve = precision_recall_curve([match])
    np.testing.assert_allclose(curve.precision, [1, 2 / 3])
    np.testing.assert_allclose(curve.recall, [0, 1])
    assert average_precision(curve) == pytest.approx(2 / 3)


def test_scenes_weigh_the_same_at_each_threshold():
    first = scene([0.9], [0], [True])
    second = scene([0.8, 0.7], [None, 0], [True, True])
    curve = precision_recall_curve([first, second])
    # at 0.9: (1 + 1) / 2 and (1 + 0) / 2; at 0.8: (1 + 0) / 2; at 0.7: (1 + 1/2) / 2
    np.testing.assert_allclose(curve.precision, [1, 1, 1 / 2, 3 / 4])
    np.testing.assert_allclose(curve.recall, [0, 1 / 2, 1 / 2, 3 / 4])
    assert average_precision(curve) == pytest.approx(1 / 2 + 1 / 4 * 3 / 4)
    assert mean_average_precision([first, second]) == pytest.approx((1 + 1 / 2 * 1 / 2) / 2)


def test_a_perfect_run_scores_one():
    matches = [scene([3.0, 2.0, 1.0], [2, 0, 1], [True] * 3)] * 7
    curve = precision_recall_curve(matches)
    assert average_precision(curve) == pytest.approx(1)
    assert mean_average_precision(matches) == pytest.approx(1)
    assert best_f1(curve) == pytest.approx(1)
    assert recall_at_precision(curve) == pytest.approx(1)


def test_no_result_at_all_leaves_the_share_of_scenes_with_nothing_to_find():
    matches = [NOTHING_FOUND, NOTHING_TO_FIND, NOTHING_FOUND, NOTHING_FOUND]
    curve = precision_recall_curve(matches)
    assert curve.precision.tolist() == [1, 1]
    assert curve.recall.tolist() == [0, 1 / 4]
    assert curve.threshold.tolist() == [math.inf, -math.inf]
    assert average_precision(curve) == mean_average_precision(matches) == 1 / 4
    assert best_f1(curve) == pytest.approx(2 / 5)
    assert count_positives(matches) == (0, 0)


def test_results_where_nothing_is_to_find_are_false():
    match = scene([0.5], [None], [])
    assert average_precision(precision_recall_curve([match])) == 0
    assert count_positives([match]) == (0, 1)


def test_only_false_results_score_zero():
    match = scene([0.5, 0.4], [None, None], [True])
    curve = precision_recall_curve([match])
    assert average_precision(curve) == best_f1(curve) == recall_at_precision(curve) == 0


def test_recall_at_precision_takes_the_largest_recall_anywhere_on_the_curve():
    curve = PrecisionRecallCurve(
        np.array([1.0, 0.5, 0.99, 0.98]), np.array([0.0, 0.1, 0.6, 0.8]), np.zeros(4)
    )
    assert recall_at_precision(curve) == 0.6
    assert recall_at_precision(curve, 0.5) == 0.8


def test_no_scene_is_an_error():
    with pytest.raises(ValueError, match="no scene to score"):
        precision_recall_curve([])
    with pytest.raises(ValueError, match="no scene to score"):
        mean_average_precision([])


# --- references -----------------------------------------------------------------------------------


@pytest.mark.parametrize("missed", [0, 5])
def test_agrees_with_sklearn_on_one_scene_without_duplicates(missed):
    generator = np.random.default_rng(missed)
    hit = generator.random(200) < 0.6
    score = generator.integers(0, 60, 200) + 3.0 * hit
    truth = [int(index) if h else None for h, index in zip(hit, np.cumsum(hit) - 1, strict=True)]
    curve = precision_recall_curve([scene(score.tolist(), truth, [True] * (hit.sum() + missed))])
    expected = average_precision_score(hit, score) * hit.sum() / (hit.sum() + missed)
    assert average_precision(curve) == pytest.approx(expected, abs=1e-12)


def test_only_the_order_by_score_matters():
    generator = torch.Generator().manual_seed(3)
    score = torch.rand(40, generator=generator, dtype=torch.float64)
    truth = torch.randint(0, 12, (40,), generator=generator)
    values = [
        average_precision(precision_recall_curve([scene(s.tolist(), truth.tolist(), [True] * 12)]))
        for s in (score, score.exp() * 1e6, score.log())
    ]
    assert values[0] == values[1] == values[2]


PLACE = st.tuples(*[st.integers(0, 3)] * 2)
TRUTHS = st.lists(st.tuples(PLACE, st.sampled_from([0.0, 0.5, 0.6, 1.0])), max_size=5)
RESULTS = st.lists(st.tuples(PLACE, st.integers(0, 4)), max_size=7)


def positions(places: list[tuple[int, int]]) -> torch.Tensor:
    return torch.tensor([[x, y, 0.0] for x, y in places], dtype=torch.float64).reshape(-1, 3)


def poses(places: list[tuple[int, int]]) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.eye(3).expand(len(places), 3, 3), positions(places)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(TRUTHS, RESULTS), min_size=1, max_size=4))
def test_agrees_with_the_naive_twin(drawn):
    eye = torch.eye(3, dtype=torch.float64)
    space = PoseSpace(SphericalSymmetry(), eye[0, 0], eye, 0 * eye[0], 1.0)
    matches, naive = [], []
    for truths, results in drawn:
        truth = TruePoses(*poses([p for p, _ in truths]), torch.tensor([o for _, o in truths]))
        scored = ScoredPoses(*poses([p for p, _ in results]), torch.tensor([s for _, s in results]))
        matches.append(match_scene(space, truth, scored))
        naive.append(naive_scene(space, truth, scored))
    curve = precision_recall_curve(matches)
    points = list(zip(curve.precision, curve.recall, strict=True))
    np.testing.assert_allclose(points, naive_curve(naive), atol=1e-12)
    assert average_precision(curve) == pytest.approx(naive_ap(naive), abs=1e-12)
    assert mean_average_precision(matches) == pytest.approx(
        sum(naive_ap([one]) for one in naive) / len(naive), abs=1e-12
    )
    assert best_f1(curve) == pytest.approx(naive_f1(naive), abs=1e-12)
    counts = [naive_counts(one, -math.inf) for one in naive]
    assert count_positives(matches) == tuple(sum(column) for column in zip(*counts, strict=True))
    assert (np.diff(curve.recall) >= 0).all()
    assert (np.diff(curve.threshold) < 0).all()
