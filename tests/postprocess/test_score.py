"""The score of an instance: by hand."""

import pytest
import torch

from pnet.postprocess.grouping import clusters_of
from pnet.postprocess.score import instance_score, sure_enough

LABELS = torch.tensor([[1, 0, -1, 1, 1, -1, -1, 0], [-1, -1, 2, -1, 2, -1, 2, 2]])
SEEN = torch.tensor([[0.5, 0.25, 1.0, 0.75, 0.25, 0.0, 1.0, 0.75], [1, 1, 0.5, 1, 1, 1, 0, 0]])


def test_it_is_the_mean_visibility_of_the_instances_points():
    score = instance_score(SEEN, clusters_of(LABELS))
    assert score.dtype == torch.float64
    assert score.tolist() == pytest.approx([0.5, 0.5, 0.375])
    assert instance_score(SEEN.square(), clusters_of(LABELS)).tolist() == pytest.approx(
        [0.3125, 0.875 / 3, 0.3125]
    )


def test_without_visibility_it_is_the_share_of_the_scenes_points():
    """Of all eight of its own scene, those of no instance too."""
    score = instance_score(None, clusters_of(LABELS))
    assert score.dtype == torch.float64 and score.tolist() == [2 / 8, 3 / 8, 4 / 8]


def test_the_order_of_points_does_not_matter():
    turned = torch.randperm(8, generator=torch.Generator().manual_seed(0))
    for seen, again in ((SEEN, SEEN[:, turned]), (None, None)):
        found = instance_score(again, clusters_of(LABELS[:, turned]))
        torch.testing.assert_close(found, instance_score(seen, clusters_of(LABELS)), rtol=0, atol=1e-12)


@pytest.mark.parametrize("seen", [SEEN, None])
def test_without_instances_there_is_no_score(seen):
    assert instance_score(seen, clusters_of(torch.full((2, 8), -1))).shape == (0,)


def test_what_reaches_the_threshold_is_sure_enough():
    score = torch.tensor([0.3, 0.45, 0.5]).double()
    threshold = float(score[1])
    assert sure_enough(score, SEEN, threshold).tolist() == [False, True, True]
    assert sure_enough(score, SEEN, 0.0).tolist() == [True] * 3
    assert sure_enough(score, SEEN, 1.0).tolist() == [False] * 3


def test_without_visibility_all_are():
    assert sure_enough(torch.tensor([0.0, 0.01]).double(), None, 0.9).tolist() == [True, True]
