"""What became of true poses and results: every rule and their order, on scenes counted by hand."""

import numpy as np
import pytest
import torch
from tests.metrics.test_matching import results_at, sphere, truths_at

from pnet.metrics.average_precision import count_positives
from pnet.metrics.matching import match_scene
from pnet.metrics.outcomes import Kind, Outcome, Reason, count_points, result_kinds, true_fates

FAR = 0.05  # twice beyond the threshold of 0.02


def look(truth_x, counts, result_x, occlusion=None, score=None):
    """Fates and kinds in a scene on a line; counts: (bodies, detections + 1)."""
    truth, results = truths_at(truth_x, occlusion), results_at(result_x, score)
    space = sphere(0.02)
    match = match_scene(space, truth, results)
    counts = np.array(counts, np.int64).reshape(len(truth_x), len(result_x) + 1)
    fates = true_fates(space, truth, results, match, counts)
    return fates, result_kinds(match, fates, counts)


def outcomes(*arguments, **options):
    return [Outcome(o).label for o in look(*arguments, **options)[0].outcome]


def test_points_are_counted_by_body_and_detection():
    body, detection = np.array([0, 0, 1, 1, 1, -1]), np.array([0, -1, 1, 1, 0, 0])
    assert count_points(body, detection, 2, 2).tolist() == [[1, 0, 1], [1, 2, 0]]
    assert count_points(body[:0], detection[:0], 0, 3).shape == (0, 4)


def test_a_matched_pose_is_found_whatever_its_points_say():
    assert outcomes([0.0], [[1, 9]], [0.01]) == ["found"]
    assert outcomes([0.0, 1.0], [[2, 0], [9, 0]], [0.0]) == ["found", "wrong pose"]


def test_a_pose_without_points_or_most_of_them_unclustered_is_missed():
    assert outcomes([0.0], [[0, 0]], [FAR]) == ["missed"]
    assert outcomes([0.0], [[4, 6]], [FAR]) == ["missed"]
    assert outcomes([0.0], [[7]], []) == ["missed"]


def test_exactly_half_of_the_points_unclustered_is_not_missed():
    assert outcomes([0.0], [[5, 5]], [FAR]) == ["wrong pose"]


def test_missed_goes_before_merged():
    assert outcomes([0.0, 1.0], [[4, 6], [9, 0]], [FAR]) == ["missed", "wrong pose"]


def test_the_smaller_body_of_a_merger_is_merged_and_the_larger_one_has_a_wrong_pose():
    assert outcomes([0.0, 1.0], [[6, 0], [10, 0]], [0.5]) == ["merged", "wrong pose"]


def test_bodies_with_equally_many_points_in_a_detection_both_own_it():
    assert outcomes([0.0, 1.0], [[8, 0], [8, 0]], [0.5]) == ["wrong pose", "wrong pose"]


def test_of_two_detections_with_as_many_points_the_surer_one_is_home():
    counts = [[5, 5, 0], [9, 0, 0]]  # the surer one is the other body's
    assert outcomes([0.0, 1.0], counts, [0.5, 0.6]) == ["merged", "wrong pose"]
    counts = [[5, 5, 0], [0, 9, 0]]  # the other one is
    assert outcomes([0.0, 1.0], counts, [0.5, 0.6]) == ["wrong pose", "wrong pose"]


def test_a_body_in_two_pieces_of_a_fifth_is_split():
    assert outcomes([0.0], [[8, 2, 0]], [0.5, 0.6]) == ["split"]
    assert outcomes([0.0], [[81, 19, 0]], [0.5, 0.6]) == ["wrong pose"]


def test_a_piece_that_is_mostly_another_bodys_is_none():
    assert outcomes([0.0, 1.0], [[6, 4, 0], [0, 5, 0]], [0.5, 0.6]) == ["wrong pose", "wrong pose"]


def test_merged_goes_before_split():
    counts = [[4, 3, 3, 0], [9, 0, 0, 0]]  # two pieces, but most of it is in the other's
    assert outcomes([0.0, 1.0], counts, [0.5, 0.6, 0.7]) == ["merged", "wrong pose"]


def test_a_split_body_that_a_piece_matches_is_found():
    fates, kinds = look([0.0], [[5, 5, 0]], [0.5, 0.01])
    assert fates.outcome.tolist() == [Outcome.FOUND] and fates.result.tolist() == [1]
    assert kinds.kind.tolist() == [Kind.FALSE, Kind.RIGHT]
    assert kinds.reason.tolist() == [Reason.PIECE_OF_FOUND, Reason.NONE]


def test_hidden_bodies_have_no_fate_but_take_part():
    fates, kinds = look([0.0, 1.0], [[6, 0], [10, 0]], [0.5], occlusion=[0.0, 0.51])
    assert fates.body.tolist() == [0] and fates.outcome.tolist() == [Outcome.MERGED]
    assert kinds.reason.tolist() == [Reason.HIDDEN_BODY]


def test_the_best_result_is_the_match_or_the_nearest_of_home_and_pieces():
    assert look([0.0], [[5, 5, 0]], [0.5, 0.3])[0].result.tolist() == [1]
    assert look([0.0], [[5, 5, 0]], [0.5, 0.01])[0].result.tolist() == [1]
    # the nearer result is another body's, or too small a piece
    assert look([0.0, 1.0], [[9, 0, 0], [0, 9, 0]], [0.5, 0.03])[0].result.tolist() == [0, 1]
    assert look([0.0], [[90, 10, 0]], [0.5, 0.03])[0].result.tolist() == [0]
    assert look([0.0, 1.0], [[6, 0], [10, 0]], [0.5])[0].result.tolist() == [-1, 0]


def test_points_of_a_fate_add_up():
    fates, _ = look([0.0, 1.0], [[6, 2, 1], [10, 0, 0]], [0.5, 0.6])
    assert fates.points.tolist() == [9, 10] and fates.unclustered.tolist() == [1, 0]
    assert fates.home.tolist() == [0, 0] and fates.pieces.tolist() == [1, 1]
    assert fates.at_home.tolist() == [6, 10] and fates.home_size.tolist() == [16, 16]


def test_of_results_matched_with_one_pose_the_surest_is_right_and_the_others_are_duplicates():
    _, kinds = look([0.0], [[3, 3, 3, 0]], [0.01, 0.0, -0.01], score=[0.5, 0.4, 0.3])
    assert kinds.kind.tolist() == [Kind.RIGHT, Kind.DUPLICATE, Kind.DUPLICATE]
    assert kinds.reason.tolist() == [Reason.NONE, Reason.DUPLICATE, Reason.DUPLICATE]


def test_the_first_result_of_a_hidden_body_counts_neither_way_the_second_as_false():
    _, kinds = look([0.0], [[3, 3, 0]], [0.01, 0.0], occlusion=[0.9])
    assert kinds.kind.tolist() == [Kind.HIDDEN, Kind.DUPLICATE]


def test_a_result_without_points_and_one_in_an_empty_scene_are_false():
    _, kinds = look([0.0], [[0, 4]], [0.5])
    assert kinds.reason.tolist() == [Reason.NO_POINTS] and kinds.owner.tolist() == [-1]
    _, kinds = look([], [], [0.5, 0.6])
    assert kinds.reason.tolist() == [Reason.NO_POINTS] * 2 and kinds.points.tolist() == [0, 0]


@pytest.mark.parametrize(
    ("counts", "reason"),
    [([[4, 0, 6]], Reason.MISSED), ([[8, 0, 2]], Reason.WRONG_POSE), ([[4, 4, 2]], Reason.SPLIT)],
)
def test_a_false_result_has_its_owners_outcome_for_a_reason(counts, reason):
    _, kinds = look([0.0], counts, [0.5, 0.6])
    assert kinds.reason[0] == reason


def test_the_piece_of_a_merged_body_says_so():
    _, kinds = look([0.0, 1.0], [[6, 3, 0], [9, 0, 0]], [0.5, 0.6])
    assert kinds.reason.tolist() == [Reason.WRONG_POSE, Reason.MERGED]


def test_random_scenes_agree_with_average_precisions_counts():
    rng = np.random.default_rng(0)
    for _ in range(60):
        m, d = rng.integers(0, 5), rng.integers(0, 8)
        truth = truths_at((0.05 * np.arange(m)).tolist(), rng.random(m).tolist() if m else None)
        score = rng.integers(0, 4, d).astype(float)
        results = results_at(rng.uniform(-0.03, 0.25, d).tolist(), score.tolist() if d else None)
        match = match_scene(sphere(0.02), truth, results)
        counts = rng.integers(0, 6, (m, d + 1))
        fates = true_fates(sphere(0.02), truth, results, match, counts)
        kinds = result_kinds(match, fates, counts)
        right, false = count_positives([match])
        assert (kinds.kind == Kind.RIGHT).sum() == right == (fates.outcome == Outcome.FOUND).sum()
        assert (kinds.reason != Reason.NONE).sum() == false
        assert len(fates.body) == int(match.relevant.sum())
        assert torch.equal(match.relevant.nonzero()[:, 0], torch.from_numpy(fates.body))
