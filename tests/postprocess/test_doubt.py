"""What the network says of its own errors: in the vote, the shared sizes, the fit's weights, the score."""

import math
from dataclasses import replace

import pytest
import torch
from tests.postprocess.test_folded_vote import FOLDED, surface_votes
from tests.postprocess.test_pipeline import RECOVERY, paired, predict, recover
from tests.postprocess.test_vote import three_votes_of_two_flanges

from pnet.postprocess.folded_vote import FoldedVote
from pnet.postprocess.pipeline import PoseRecovery
from pnet.postprocess.vote import InstanceVotes, MeanVote


def agreed_on(part, n: int = 2) -> InstanceVotes:
    """n instances of part objects, their keypoints in the camera's frame as in their own."""
    sizes = torch.from_numpy(part.grids["L"][:n])
    keypoints = part.chain.keypoints_from_parameters(sizes)
    zero = torch.zeros(n, 3).double()
    return InstanceVotes(zero, keypoints, sizes, torch.zeros(n, 1 + len(part.chain)).double())


def test_the_mean_vote_takes_the_sizes_that_are_said_and_means_of_doubt(tn34):
    votes = three_votes_of_two_flanges()
    doubt = torch.arange(18.0).view(3, 6).double()
    sizes = torch.tensor([[11.0, 8], [15, 9], [20, 14]]).double()
    plain = MeanVote()(tn34, votes)
    agreed = MeanVote()(tn34, replace(votes, doubt=doubt, parameters=sizes))
    assert agreed.parameters.tolist() == [[13, 8.5], [20, 14]]
    assert agreed.doubt.tolist() == [[3, 4, 5, 6, 7, 8], [12, 13, 14, 15, 16, 17]]
    assert plain.doubt is None and plain.parameters.tolist() == [[12, 10], [20, 14]]
    for name in ("centroid", "keypoints", "spread"):
        assert torch.equal(getattr(agreed, name), getattr(plain, name))


def test_votes_of_huge_doubt_do_not_move_the_sizes(any_part, random_poses, random_sizes):
    """Three of four say 1.5 times the size and doubt it; a mean of all is 1.375 times."""
    (R, t), sizes = random_poses(3), random_sizes(any_part, 3)
    votes = surface_votes(any_part, sizes, R, t, (60,) * 3)
    bad = (torch.arange(180) % 60 % 4 != 0)[:, None]
    own = sizes[votes.groups.owner]
    votes = replace(votes, parameters=torch.where(bad, 1.5 * own, own))
    lengths = 1 + len(any_part.chain) + any_part.k
    doubt = torch.where(bad, 1.0, 0.001).double().expand(180, lengths)
    sure, blind = FOLDED(any_part, replace(votes, doubt=doubt)), FOLDED(any_part, votes)
    torch.testing.assert_close(sure.parameters, sizes, rtol=3e-6, atol=0)
    torch.testing.assert_close(blind.parameters, 1.375 * sizes, rtol=1e-9, atol=0)


def test_places_are_voted_alike_whatever_the_doubt(any_part, random_poses, random_sizes):
    """A robust mode needs no weights; sizes that are measured between places neither."""
    (R, t), sizes = random_poses(4), random_sizes(any_part, 4)
    votes = surface_votes(any_part, sizes, R, t, (60, 31, 1, 80))
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(votes.keypoints.shape, generator=generator).double()
    votes = replace(votes, keypoints=votes.keypoints + 0.0005 * noise)
    spread = torch.randn(172, 1 + len(any_part.chain) + any_part.k, generator=generator).double()
    plain, doubted = FOLDED(any_part, votes), FOLDED(any_part, replace(votes, doubt=0.002 * spread.exp()))
    for name in ("centroid", "keypoints", "parameters", "spread"):
        assert torch.equal(getattr(doubted, name), getattr(plain, name))
    assert plain.doubt is None and doubted.doubt.shape == (4, spread.shape[1])


def test_equal_doubt_of_all_changes_no_size(tn34, random_poses, random_sizes):
    (R, t), sizes = random_poses(2), random_sizes(tn34, 2)
    votes = surface_votes(tn34, sizes, R, t, (40, 9))
    said = sizes[votes.groups.owner] * (
        1 + 0.1 * torch.rand(49, 2, generator=torch.Generator().manual_seed(0))
    )
    votes = replace(votes, parameters=said.double())
    doubt = torch.full((49, 6), 0.003, dtype=torch.float64)
    plain, doubted = FOLDED(tn34, votes), FOLDED(tn34, replace(votes, doubt=doubt))
    torch.testing.assert_close(doubted.parameters, plain.parameters, rtol=1e-12, atol=0)
    torch.testing.assert_close(doubted.doubt, torch.full_like(doubted.doubt, 0.003), rtol=1e-12, atol=0)


def test_sizes_that_are_said_are_weighed_by_their_own_doubt(tn34, random_poses):
    """Sizes of 14, 16 and 20 mm with doubt of 1, 1 and 2 mm: (14 + 16 + 20 / 4) / 2.25."""
    R, t = random_poses(1)
    sizes = torch.tensor([[0.014, 0.012]]).double()
    votes = surface_votes(tn34, sizes, R, t, (3,))
    said = torch.tensor([[0.014, 0.010], [0.016, 0.012], [0.020, 0.014]], dtype=torch.float64)
    doubt = torch.full((3, 6), 0.001, dtype=torch.float64)
    doubt[2, 4] = 0.002
    doubt[0, 5] = 0.0005
    agreed = FOLDED(tn34, replace(votes, parameters=said, doubt=doubt))
    expected = [35 / 2.25, (4 * 10 + 12 + 14) / 6]
    assert (1000 * agreed.parameters[0]).tolist() == pytest.approx(expected, abs=1e-9)
    torch.testing.assert_close(agreed.doubt[0], doubt.mean(0), rtol=1e-12, atol=0)


def test_a_small_clusters_doubt_is_that_of_its_own_points(tn34, random_poses, random_sizes):
    (R, t), sizes = random_poses(2), random_sizes(tn34, 2)
    votes = surface_votes(tn34, sizes, R, t, (2, 30))
    doubt = torch.where(votes.groups.owner == 0, 0.004, 0.001).double()[:, None].expand(32, 6)
    few = FoldedVote(8, 20, 25.0, 3.0)(tn34, replace(votes, doubt=doubt))
    expected = torch.tensor([[0.004], [0.001]]).double().expand(2, 6)
    torch.testing.assert_close(few.doubt, expected, rtol=1e-12, atol=0)


def test_weights_of_the_fit_are_the_inverse_squares_of_spread_trust_and_doubt(tn34):
    spread = torch.tensor([[0.001, 0, 0.002, 0], [0, 0, 0, 0]]).double()
    agreed = replace(agreed_on(tn34), spread=spread)
    doubt = torch.tensor([[0.001, 0.002, 0, 0.003, 9, 9], [0.001] * 4 + [9, 9]]).double()
    recovery = replace(RECOVERY, trust=0.001)
    assert RECOVERY._weight(replace(agreed, doubt=doubt)) is None
    plain = [[1 / 2e-6, 1e6, 1 / 5e-6, 1e6], [1e6] * 4]
    assert recovery._weight(agreed).tolist() == [pytest.approx(row) for row in plain]
    doubted = [[1 / 3e-6, 1 / 5e-6, 1 / 5e-6, 1 / 10e-6], [1 / 2e-6] * 4]
    assert recovery._weight(replace(agreed, doubt=doubt)).tolist() == [pytest.approx(row) for row in doubted]


def test_the_score_falls_by_e_where_the_doubt_is_that_share_of_the_part(tn34):
    """Root mean square doubt of places, by the farthest keypoint from the centroid; sizes don't count."""
    agreed = agreed_on(tn34)
    reach = agreed.keypoints.norm(dim=-1).amax(1)
    doubt = torch.zeros(2, 6).double()
    doubt[0, 0] = 0.25 * reach[0] * 2  # one of four places: the root mean square is half as much
    doubt[1, :4] = 0.5 * reach[1]
    doubt[:, 4:] = 7
    score = torch.tensor([0.8, 0.6]).double()
    recovery = replace(RECOVERY, doubtful=0.25)
    found = recovery._confidence(replace(agreed, doubt=doubt), agreed.keypoints, score)
    assert found.tolist() == pytest.approx([0.8 / math.e, 0.6 / math.e**2])
    assert RECOVERY._confidence(replace(agreed, doubt=doubt), agreed.keypoints, score) is score
    assert recovery._confidence(agreed, agreed.keypoints, score) is score


def test_shared_sizes_of_the_best_visible_are_weighed_by_doubt():
    sizes = torch.tensor([[0.010, 0.020], [0.014, 0.026], [0.050, 0.050]]).double()
    doubt = torch.tensor([[0.001, 0.003], [0.002, 0.003], [1e-5, 1e-5]]).double()
    score = torch.tensor([0.9, 0.85, 0.3]).double()
    found = RECOVERY._shared(sizes, score, doubt)
    torch.testing.assert_close(found, torch.tensor([0.0108, 0.023]).double().expand(3, 2))
    alike = RECOVERY._shared(sizes, score, torch.ones_like(doubt))
    torch.testing.assert_close(alike, sizes[:2].mean(0).expand(3, 2))
    assert RECOVERY._shared(sizes[:0], score[:0], doubt[:0]).shape == (0, 2)


def doubted(part, scene, each: torch.Tensor):
    """Perfect predictions of a scene, with doubt (d, 1 + m + k) by body."""
    prediction = predict(scene, part)
    own = each.float()[torch.from_numpy(scene.instance)]
    return replace(prediction, doubt=own.expand(2, -1, -1).clone())


def test_surer_bodies_count_more_in_the_sizes_of_their_scene(tn34, make_scene):
    scene = make_scene(tn34, bodies=3, points=300)
    sizes = scene.parameters * [[1.0], [1.2], [1.1]]
    scene = replace(scene, parameters=sizes, visibility=torch.tensor([1.0, 0.95, 0.3]).numpy())
    each = torch.full((3, 6), 0.001)
    each[1, 4:] = 0.003
    prediction = doubted(tn34, scene, each)
    found = recover(tn34, scene, prediction, scene_parameters=True).parameters
    expected = torch.from_numpy((9 * sizes[0] + sizes[1]) / 10).expand(3, 2)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


def test_of_equally_visible_bodies_the_doubted_one_comes_last(tn34, make_scene):
    scene = replace(make_scene(tn34, bodies=3, points=600), visibility=torch.full((3,), 0.8).numpy())
    each = torch.full((3, 6), 0.0005)
    each[1] = 0.004
    prediction = doubted(tn34, scene, each)
    blind = recover(tn34, scene, prediction)
    assert blind.score.tolist() == pytest.approx([0.8] * 3, abs=1e-6)
    found = recover(tn34, scene, prediction, doubtful=0.25)
    nearest = paired(tn34, scene, found)[1]
    assert int(nearest[1]) == 2 and found.score.tolist() == sorted(found.score.tolist(), reverse=True)
    template = tn34.chain.keypoints_from_parameters(torch.from_numpy(scene.parameters[1]))
    reach = float(template.norm(dim=-1).max())
    assert float(found.score[2]) == pytest.approx(0.8 * math.exp(-0.004 / (0.25 * reach)), rel=1e-4)


@pytest.mark.parametrize("changes", [{}, {"voting": FOLDED, "radius_filter": None}], ids=["mean", "folded"])
def test_a_doubted_keypoint_does_not_drag_the_pose_along(tn34, make_scene, changes):
    """All say the rim is 6 mm farther along the axis than it is, and that they doubt it."""
    scene = make_scene(tn34, bodies=4, points=1200)
    each = torch.full((4, 6), 0.0002)
    each[:, 3] = 0.05
    prediction = doubted(tn34, scene, each)
    axis = torch.from_numpy(scene.R[scene.instance][:, :, 2]).float()
    prediction.keypoints[1, :, 2] += 0.006 * axis
    sure = paired(tn34, scene, recover(tn34, scene, prediction, trust=0.001, **changes))[0]
    blind = paired(
        tn34, scene, recover(tn34, scene, replace(prediction, doubt=None), trust=0.001, **changes)
    )[0]
    assert float(sure.max()) < float(blind.max()) / 2


@pytest.mark.parametrize("changes", [{}, {"voting": FOLDED, "radius_filter": None}], ids=["mean", "folded"])
def test_doubt_that_is_no_number_gives_no_detections(tn34, make_scene, changes):
    scene = make_scene(tn34, bodies=2)
    prediction = doubted(tn34, scene, torch.full((2, 6), 0.001))
    assert len(recover(tn34, scene, prediction, **changes).score) == 2
    prediction.doubt[1, 7, 3] = torch.nan
    assert len(recover(tn34, scene, prediction, **changes).score) == 0
    prediction = replace(prediction, doubt=None, parameters=torch.full((2, 400, 2), torch.inf))
    assert len(recover(tn34, scene, prediction, **changes).score) == 0


@pytest.mark.parametrize("changes", [{}, {"voting": FOLDED, "radius_filter": None}], ids=["mean", "folded"])
def test_sizes_that_are_said_are_those_found(tn34, make_scene, changes):
    scene = make_scene(tn34, bodies=3, points=600)
    own = torch.from_numpy(scene.parameters).float()[torch.from_numpy(scene.instance)]
    prediction = replace(predict(scene, tn34), parameters=(1.25 * own).expand(2, -1, -1))
    found = recover(tn34, scene, prediction, **changes)
    expected = torch.from_numpy(1.25 * scene.parameters)
    torch.testing.assert_close(found.parameters, expected, rtol=0, atol=1e-6)


def test_recoveries_know_no_doubt_unless_told():
    assert PoseRecovery.__dataclass_fields__["doubtful"].default is None
