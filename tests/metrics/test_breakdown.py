"""Rows of an evaluation: one for every true pose to find and every result, and they agree with the scores."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tests.conftest import Marble

from pnet.engine.evaluation import SceneScorer
from pnet.geometry.rigid import apply_pose
from pnet.metrics.breakdown import break_down
from pnet.metrics.outcomes import Outcome
from pnet.metrics.score_losses import score_losses
from pnet.parts.choice import KeypointChoice, KeypointRule
from pnet.records import Detections

POINT = KeypointChoice(KeypointRule.POINT)


def perfect(scene, part, points=None):
    """Detections that repeat the truth."""
    R, t, sizes = (torch.from_numpy(x) for x in (scene.R, scene.t, scene.parameters))
    keypoints = apply_pose(R, t, part.chain.keypoints_from_parameters(sizes))
    score = torch.linspace(0.9, 0.5, len(R), dtype=torch.float64)
    return Detections(R, t, sizes, score, keypoints, torch.from_numpy(scene.instance[:points]))


@pytest.mark.parametrize("name", ["tn06", "tn34", "marble"])
def test_the_truth_itself_is_found_without_an_error(make_scene, request, name):
    part = Marble({"r": [10]}) if name == "marble" else request.getfixturevalue(name)
    scenes = [make_scene(part, bodies, seed=bodies) for bodies in (1, 4)]
    rows = break_down(part, POINT, scenes, [perfect(scene, part) for scene in scenes])
    truths = rows.truths
    assert truths.scene.tolist() == [0, 1, 1, 1, 1] and (truths.fate.outcome == Outcome.FOUND).all()
    assert truths.fate.result.tolist() == [0, 0, 1, 2, 3]
    for error in (
        truths.errors.position,
        truths.errors.rotation,
        truths.parameter_error,
        truths.keypoint_error,
    ):
        assert np.abs(error).max() < 1e-7
    assert score_losses(rows).ap == pytest.approx(1)


def test_errors_are_estimate_minus_truth_of_the_own_result(make_scene, tn34):
    scene = make_scene(tn34, 3)
    found = perfect(scene, tn34)
    sizes = found.parameters.clone()
    sizes[1] += torch.tensor([0.001, -0.002])
    t = found.t.clone()
    t[2] += torch.tensor([0.0, 0.0, 0.03])
    rows = break_down(tn34, POINT, [scene], [replace(found, parameters=sizes, t=t)]).truths
    expected = [[0, 0], [0.001, -0.002], [0, 0]]
    np.testing.assert_allclose(rows.parameter_error, expected, atol=1e-12)
    np.testing.assert_allclose(rows.errors.position, [0, 0, 0.03], atol=1e-9)
    assert rows.fate.outcome.tolist() == [Outcome.FOUND, Outcome.FOUND, Outcome.WRONG_POSE]


def test_ap_and_errors_are_those_of_the_evaluation(make_scene, tn06):
    rng = np.random.default_rng(5)
    scenes = [make_scene(tn06, bodies, seed=bodies) for bodies in (1, 3, 6)]
    found = []
    for scene in scenes:
        exact = perfect(scene, tn06)
        t = exact.t + torch.from_numpy(rng.normal(0, 0.0015, exact.t.shape))
        found.append(replace(exact, t=t, parameters=exact.parameters + 0.001))
    scorer = SceneScorer(tn06).add_all(scenes, found)
    rows, metrics = break_down(tn06, POINT, scenes, found), scorer.compute()
    hit = rows.truths.fate.outcome == Outcome.FOUND
    assert 0 < hit.sum() == metrics["true_positives"] < len(hit) == metrics["truths_to_find"]
    assert score_losses(rows).ap == pytest.approx(metrics["AP"], abs=1e-12)
    assert 1000 * rows.truths.errors.position[hit].mean() == pytest.approx(metrics["position_error_mm"])
    assert np.abs(rows.truths.parameter_error[hit]).mean() == pytest.approx(0.001)


def test_only_the_points_that_were_clustered_count(make_scene, tn34):
    scene = make_scene(tn34, 2, points=400)
    rows = break_down(tn34, POINT, [scene], [perfect(scene, tn34, points=100)])
    assert rows.truths.fate.points.tolist() == np.bincount(scene.instance[:100]).tolist()
    with pytest.raises(ValueError, match="has 50 points, the predictions were made from 100"):
        short = replace(scene, points=scene.points[:50], instance=scene.instance[:50])
        break_down(tn34, POINT, [short], [perfect(scene, tn34, points=100)])


def test_hidden_bodies_have_no_row(make_scene, tn34):
    scene = replace(make_scene(tn34, 3), occlusion=np.array([0.0, 0.51, 0.5]))
    rows = break_down(tn34, POINT, [scene], [perfect(scene, tn34)])
    assert rows.truths.fate.body.tolist() == [0, 2] and len(rows.results) == 3


@pytest.mark.parametrize("width", [0, 3])
def test_a_method_without_sizes_and_keypoints_has_no_such_errors(make_scene, tn34, width):
    scene = make_scene(tn34, 2)
    found = perfect(scene, tn34)
    none = torch.full((2, width, 3), torch.nan).double()
    sizes = torch.full((2, 2 if width else 0), torch.nan).double()
    rows = break_down(tn34, POINT, [scene], [replace(found, keypoints=none, parameters=sizes)]).truths
    assert rows.parameter_error.shape == (2, 2) and np.isnan(rows.parameter_error).all()
    assert rows.keypoint_error.shape == (2, 3) and np.isnan(rows.keypoint_error).all()
    assert (rows.fate.outcome == Outcome.FOUND).all()


def test_empty_scenes_have_no_rows_of_truths(make_scene, tn34):
    scene = make_scene(tn34, 2)
    empty = replace(
        scene,
        **{name: getattr(scene, name)[:0] for name in ("points", "instance", "R", "t", "parameters")},
        visibility=scene.visibility[:0],
        occlusion=scene.occlusion[:0],
    )
    found = perfect(scene, tn34)
    stray = replace(found, instance=found.instance[:0])
    nothing = Detections(*(x[:0] for x in (found.R, found.t, found.parameters, found.score, found.keypoints,
                                           found.instance)))  # fmt: skip
    unseen = replace(nothing, instance=torch.full((400,), -1))
    rows = break_down(tn34, POINT, [empty, empty, scene], [nothing, stray, unseen])
    assert rows.truths.scene.tolist() == [2, 2] and rows.results.scene.tolist() == [1, 1]
    assert (rows.truths.fate.outcome == Outcome.MISSED).all()
    assert np.isnan(rows.truths.score).all() and np.isnan(rows.truths.keypoint_error).all()


def test_no_scene_at_all_is_refused(tn34):
    with pytest.raises(ValueError, match="there is no scene to look at"):
        break_down(tn34, POINT, [], [])
