"""The gathered scores of a run."""

import math
import pickle

import pytest
import roma
import torch

from pnet.geometry.pose_space import PoseSpace
from pnet.geometry.symmetry import RevolutionSymmetry
from pnet.metrics.matching import ScoredPoses, TruePoses
from pnet.metrics.pose_metric import PoseMetrics

EYE = torch.eye(3, dtype=torch.float64)
SPACE = PoseSpace(RevolutionSymmetry(), 0.01 * EYE[0, 0], EYE, 0 * EYE[0], 0.005)


def tilt(degrees: float) -> torch.Tensor:
    return roma.rotvec_to_rotmat(math.radians(degrees) * EYE[0])


def truth() -> TruePoses:
    """Two poses to find and a hidden one, 0.1 m apart."""
    t = torch.tensor([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    return TruePoses(EYE.expand(3, 3, 3), t, torch.tensor([0.0, 0.5, 0.9]))


def results() -> ScoredPoses:
    """Two results on the first pose, the nearer one less sure; the hidden pose; a stray."""
    t = torch.tensor([[0.0, 0, 0.004], [0.0, 0, 0.001], [0.2, 0, 0], [0.5, 0, 0]])
    R = torch.stack([EYE, tilt(2.0), EYE, EYE])
    return ScoredPoses(R, t, torch.tensor([0.9, 0.8, 0.7, 0.6]))


def nothing() -> ScoredPoses:
    return ScoredPoses(torch.empty(0, 3, 3), torch.empty(0, 3), torch.empty(0))


def test_one_scene_by_hand():
    metric = PoseMetrics()
    k_true, k_found = torch.full((3, 2), 0.010), torch.full((4, 2), 0.011)
    k_found[1] = torch.tensor([0.012, 0.007])
    metric.update(SPACE, truth(), results(), k_true, k_found)
    scores = metric.compute()
    assert scores == pytest.approx(
        {
            "AP": 0.5,
            "MAP": 0.5,
            "F1": 2 / 3,
            "recall_at_precision_99": 0.5,
            "position_error_mm": 1.0,
            "axis_error_deg": 2.0,
            "parameter_error_mm": 2.5,
            "true_positives": 1,
            "false_positives": 2,
            "truths_to_find": 2,
            "results": 4,
            "scenes": 1,
        },
        rel=1e-5,
    )
    assert metric.curve().precision == pytest.approx([1, 1, 1 / 2, 1 / 2, 1 / 3])


def test_scenes_are_averaged_and_reset_forgets_them():
    metric = PoseMetrics()
    metric.update(SPACE, truth(), results())
    metric.update(SPACE, truth(), nothing())
    assert metric.compute()["AP"] == pytest.approx(0.25)
    assert metric.compute()["scenes"] == 2
    metric.reset()
    metric.update(SPACE, truth(), results())
    assert metric.compute()["AP"] == pytest.approx(0.5)


def test_the_forward_call_gives_one_scene_and_keeps_all():
    metric = PoseMetrics()
    assert metric(SPACE, truth(), results())["AP"] == pytest.approx(0.5)
    assert metric(SPACE, truth(), nothing())["AP"] == 0
    assert metric.compute()["AP"] == pytest.approx(0.25)


def test_errors_are_nan_where_nothing_matched():
    metric = PoseMetrics()
    metric.update(SPACE, truth(), nothing())
    scores = metric.compute()
    for name in ("position_error_mm", "axis_error_deg", "parameter_error_mm"):
        assert math.isnan(scores[name])
    assert (scores["AP"], scores["results"], scores["truths_to_find"]) == (0, 0, 2)


def test_the_occlusion_limit_is_a_setting():
    metric = PoseMetrics(max_occlusion=0.95)
    metric.update(SPACE, truth(), results())
    assert metric.compute()["truths_to_find"] == 3
    assert metric.compute()["true_positives"] == 2


def test_parameters_on_one_side_only_are_refused():
    with pytest.raises(ValueError, match="truth or the results only"):
        PoseMetrics().update(SPACE, truth(), results(), truth_parameters=torch.zeros(3, 1))


def test_no_scene_is_an_error():
    with pytest.warns(UserWarning, match="compute"), pytest.raises(ValueError, match="no scene"):
        PoseMetrics().compute()


def test_unknown_parameters_have_no_error_and_change_nothing_else():
    """As PPR-Net's results have them; the table shows a dash."""
    known, unknown = PoseMetrics(), PoseMetrics()
    truth_parameters, found = torch.full((3, 2), 0.010), torch.full((4, 2), 0.011)
    known.update(SPACE, truth(), results(), truth_parameters, found)
    unknown.update(SPACE, truth(), results(), truth_parameters, torch.full_like(found, math.nan))
    expected, scores = known.compute(), unknown.compute()
    assert expected.pop("parameter_error_mm") == pytest.approx(1.0, rel=1e-5)
    assert math.isnan(scores.pop("parameter_error_mm"))
    assert scores == expected and scores["AP"] == 0.5


def test_unknown_parameters_in_one_scene_leave_no_error():
    """A mean over some of the bodies would pass for one over all."""
    metric = PoseMetrics()
    for value in (0.011, math.nan):
        metric.update(SPACE, truth(), results(), torch.full((3, 1), 0.010), torch.full((4, 1), value))
    assert math.isnan(metric.compute()["parameter_error_mm"])
    assert metric.compute()["position_error_mm"] == pytest.approx(1.0, rel=1e-5)


def test_each_parameter_has_its_own_error_in_mm():
    """Of two parameters, one 2 mm off in the first scene and exact in the second, the other 3 and 1 mm."""
    metric = PoseMetrics(parameter_names=("r", "h"))
    for r, h in ((0.012, 0.007), (0.010, 0.011)):
        found = torch.tensor([r, h]).expand(4, 2)
        metric.update(SPACE, truth(), results(), torch.full((3, 2), 0.010), found)
    scores = metric.compute()
    assert scores["parameter_error_mm/r"] == pytest.approx(1.0, rel=1e-5)
    assert scores["parameter_error_mm/h"] == pytest.approx(2.0, rel=1e-5)
    assert scores["parameter_error_mm"] == pytest.approx(1.5, rel=1e-5)
    keys = list(scores)
    first = keys.index("parameter_error_mm")
    assert keys[first + 1 : first + 3] == ["parameter_error_mm/r", "parameter_error_mm/h"]


def test_names_change_nothing_else():
    plain, named = PoseMetrics(), PoseMetrics(parameter_names=("r", "h"))
    for metric in (plain, named):
        metric.update(SPACE, truth(), results(), torch.full((3, 2), 0.010), torch.full((4, 2), 0.011))
    scores = named.compute()
    assert {key: value for key, value in scores.items() if "/" not in key} == plain.compute()


@pytest.mark.parametrize("found", [results(), nothing()])
def test_a_method_without_sizes_and_one_that_found_nothing_have_no_error_of_a_parameter(found):
    metric = PoseMetrics(parameter_names=("r",))
    unknown = torch.full((len(found.score), 1), math.nan)
    metric.update(SPACE, truth(), found, torch.full((3, 1), 0.010), unknown)
    assert "parameter_error_mm/r" not in metric.compute()
    assert math.isnan(metric.compute()["parameter_error_mm"])


def test_a_parameter_that_some_results_lack_has_no_mean():
    metric = PoseMetrics(parameter_names=("r", "h"))
    for h in (0.012, math.nan):
        found = torch.tensor([0.011, h]).expand(4, 2)
        metric.update(SPACE, truth(), results(), torch.full((3, 2), 0.010), found)
    scores = metric.compute()
    assert scores["parameter_error_mm/r"] == pytest.approx(1.0, rel=1e-5)
    assert math.isnan(scores["parameter_error_mm/h"]) and math.isnan(scores["parameter_error_mm"])


def test_parameters_without_names_of_their_own_are_refused_and_leave_nothing_behind():
    metric = PoseMetrics(parameter_names=("r", "h"))
    with pytest.raises(ValueError, match="3 parameters, expected r, h"):
        metric.update(SPACE, truth(), results(), torch.zeros(3, 3), torch.zeros(4, 3))
    metric.update(SPACE, truth(), results(), torch.zeros(3, 2), torch.zeros(4, 2))
    assert metric.compute()["scenes"] == 1


def test_gathered_errors_survive_a_copy_and_a_reset():
    metric = PoseMetrics(parameter_names=("r",))
    metric.update(SPACE, truth(), results(), torch.full((3, 1), 0.010), torch.full((4, 1), 0.013))
    again = pickle.loads(pickle.dumps(metric))
    assert again.compute()["parameter_error_mm/r"] == pytest.approx(3.0, rel=1e-5)
    metric.reset()
    metric.update(SPACE, truth(), results(), torch.full((3, 1), 0.010), torch.full((4, 1), 0.011))
    assert metric.compute()["parameter_error_mm/r"] == pytest.approx(1.0, rel=1e-5)
