"""Where average precision is lost, against cases counted by hand and AP itself."""

import numpy as np
import pytest
import torch
from tests.metrics.test_matching import results_at, sphere, truths_at

from pnet.metrics.average_precision import average_precision, precision_recall_curve
from pnet.metrics.breakdown import Breakdown, ResultRows, TruthRows, joined, taken
from pnet.metrics.matching import match_scene
from pnet.metrics.outcomes import Kind, result_kinds, true_fates
from pnet.metrics.pose_attributes import Attributes, pose_errors
from pnet.metrics.score_losses import calibration, outcome_losses, score_losses, sure_and_false


def broken_down(*scenes):
    """Rows of scenes (truths' x, results' x, scores, counts)."""
    space, truths, results, matches = sphere(0.02), [], [], []
    for index, (x, y, score, counts) in enumerate(scenes):
        truth, found = truths_at(x), results_at(y, score)
        match = match_scene(space, truth, found)
        counts = np.array(counts, np.int64).reshape(len(x), len(y) + 1)
        fates = true_fates(space, truth, found, match, counts)
        n, best = len(fates.body), torch.from_numpy(fates.result)
        nan = torch.full((1, 3, 3), torch.nan, dtype=torch.float64)
        own = truth.R[fates.body], truth.t[fates.body]
        R, t = torch.cat([found.R, nan])[best], torch.cat([found.t, nan[:, 0]])[best]
        nothing, wide = np.full(n, np.nan), np.full((n, 1), np.nan)
        attributes = Attributes(nothing, nothing, nothing, nothing, wide, wide)
        errors = pose_errors(space, space.symmetry, *own, R, t)
        truths.append(TruthRows(np.full(n, index), nothing, fates, attributes, errors, wide, wide))
        kinds, d = result_kinds(match, fates, counts), len(y)
        columns = (match.score.numpy(), match.truth.numpy(), match.distance.numpy())
        results.append(ResultRows(np.full(d, index), np.arange(d), *columns, kinds))
        matches.append(match)
    return Breakdown(joined(truths), joined(results), matches)


@pytest.fixture
def two_scenes():
    """The first finds one of two, with a surer false result; the second misses one of four."""
    return broken_down(
        ([0.0, 1.0], [1.5, 0.0], [0.9, 0.8], [[0, 5, 0], [5, 0, 0]]),
        (
            [0.0, 1.0, 2.0, 3.0],
            [0.0, 1.0, 2.0],
            [0.7, 0.6, 0.5],
            [[5, 0, 0, 0], [0, 5, 0, 0], [0, 0, 5, 0], [0, 0, 0, 5]],
        ),
    )


def test_outcomes_share_what_recall_lacks_each_scene_weighing_the_same(two_scenes):
    losses = outcome_losses(two_scenes)
    assert losses == pytest.approx({"missed": 1 / 8, "merged": 0, "split": 0, "wrong pose": 1 / 4})


def test_losses_lead_from_one_to_ap(two_scenes):
    losses = score_losses(two_scenes)
    curve = precision_recall_curve(two_scenes.matches)
    assert losses.ap == average_precision(curve)
    assert losses.recall == pytest.approx(curve.recall[-1]) == pytest.approx(0.625)
    assert losses.oracle_ap == pytest.approx(losses.recall)
    assert 1 - sum(losses.by_outcome.values()) - losses.by_order == pytest.approx(losses.ap)
    # recall 1/4 at 0.8 and 1/8 at each later score; precision is 1/2 of the first scene, 1 of the second
    assert losses.ap == pytest.approx(0.625 * 0.75)


def test_mending_what_is_wrong_gives_the_ap_of_right_results(two_scenes):
    losses = score_losses(two_scenes)
    assert losses.if_mended["wrong position"] == pytest.approx(0.5 + 0.375)
    assert {losses.if_mended[f"wrong {name}"] for name in ("rotation", "both", "sum")} == {losses.ap}
    assert losses.without["wrong pose"] == pytest.approx(0.625)
    assert losses.without["duplicate"] == losses.ap


def test_a_split_body_is_mended_by_its_best_piece():
    split = broken_down(([0.0], [0.05, 0.5], [0.9, 0.8], [[5, 5, 0]]))
    assert score_losses(split).by_outcome["split"] == 1
    assert score_losses(split).if_mended["split"] == 1


def test_what_has_no_result_cannot_be_mended():
    losses = score_losses(broken_down(([0.0], [], [], [[5]])))
    assert losses.ap == 0 and set(losses.if_mended.values()) == {0.0}


def test_nothing_to_find_and_nothing_found_lose_nothing():
    losses = score_losses(broken_down(([], [], [], [])))
    assert (losses.ap, losses.oracle_ap, losses.recall, losses.by_order) == (1, 1, 1, 0)


def test_random_scenes_lose_what_they_lack():
    rng = np.random.default_rng(3)
    scenes = []
    for _ in range(30):
        m, d = rng.integers(0, 5), rng.integers(0, 7)
        score = np.sort(rng.random(d))[::-1]
        x, y = (0.05 * np.arange(m)).tolist(), rng.uniform(-0.03, 0.25, d).tolist()
        scenes.append((x, y, score.tolist() or None, rng.integers(0, 6, (m, d + 1))))
    losses = score_losses(broken_down(*scenes))
    assert losses.oracle_ap == pytest.approx(losses.recall, abs=1e-9)
    assert 1 - sum(losses.by_outcome.values()) - losses.by_order == pytest.approx(losses.ap)
    assert min(losses.if_mended.values()) >= losses.ap - 1e-12
    assert min(losses.without.values()) >= losses.ap - 1e-12


def scored(score, right):
    """Results with these scores; those that are right hit a body each."""
    x = np.arange(len(score)).astype(float)
    y = np.where(right, x, x + 0.5)
    counts = np.concatenate([np.diag(np.full(len(x), 5)), np.zeros((len(x), 1), int)], 1)
    return broken_down((x.tolist(), y.tolist(), list(score), counts))


def test_calibration_counts_right_results_in_equal_bins():
    score = np.linspace(1, 0.01, 100)
    right = score > 0.5
    bins = calibration(scored(score, right))
    assert bins.counted.tolist() == [10] * 10 and bins.right.sum() == right.sum()
    np.testing.assert_allclose(bins.precision, [0] * 5 + [1] * 5)
    assert (bins.low[1:] > bins.high[:-1]).all()


def test_equal_scores_stay_in_one_bin():
    bins = calibration(scored([0.9] * 3 + [0.5] * 7, [True] * 6 + [False] * 4))
    assert bins.counted.tolist() == [7, 3] and bins.precision.tolist() == [3 / 7, 1]


def test_no_result_has_no_calibration():
    bins = calibration(broken_down(([0.0], [], [], [[5]])))
    assert len(bins.low) == 0 and len(bins.precision) == 0


def test_sure_and_false_are_above_half_of_the_right_ones():
    rows = scored([0.9, 0.8, 0.7, 0.6, 0.5], [False, True, True, False, True])
    assert sure_and_false(rows).tolist() == [True, False, False, False, False]
    assert not sure_and_false(scored([0.9, 0.8], [False, False])).any()


def test_rows_are_taken_and_joined_again(two_scenes):
    first, second = (taken(two_scenes.results, two_scenes.results.scene == i) for i in range(2))
    again = joined([first, second])
    assert again.score.tolist() == two_scenes.results.score.tolist()
    assert again.kinds.kind.tolist() == [Kind.FALSE, Kind.RIGHT, Kind.RIGHT, Kind.RIGHT, Kind.RIGHT]
