"""Folded votes of a bar that looks much the same end for end: of four exchanges the right one is found."""

import math
from dataclasses import replace

import pytest
import torch
from tests.postprocess.test_folded_vote import FOLDED, recovered, surface_votes

from pnet.geometry.rigid import apply_pose, rotation_angle
from pnet.postprocess.folded_vote import FoldedVote, fold, likeliest
from pnet.postprocess.grouping import clusters_of
from pnet.postprocess.vote import PointVotes


def bars(n: int, seed: int = 0) -> torch.Tensor:
    """(n, 3) sizes whose large end is 10 mm high or more; the small one's is 6 mm."""
    share = torch.rand(n, 3, generator=torch.Generator().manual_seed(seed)).double()
    low, high = torch.tensor([[0.030, 0.010, 0.008], [0.048, 0.019, 0.017]]).double()
    return low + share * (high - low)


def noise_like(values: torch.Tensor, sigma: float, seed: int = 0) -> torch.Tensor:
    return sigma * torch.randn(values.shape, generator=torch.Generator().manual_seed(seed)).double()


def with_sizes(votes: PointVotes, sizes: torch.Tensor) -> PointVotes:
    return replace(votes, parameters=sizes[votes.groups.owner])


@pytest.mark.parametrize("said", [False, True], ids=["measured", "said"])
def test_exact_votes_give_the_exact_pose_and_sizes(tn42, random_poses, said):
    (R, t), sizes = random_poses(20), bars(20)
    votes = surface_votes(tn42, sizes, R, t, (60, 150, 1, 7) * 5)
    agreed = FOLDED(tn42, with_sizes(votes, sizes) if said else votes)
    assert float(rotation_angle(recovered(tn42, agreed), R).max()) < 1e-6
    torch.testing.assert_close(agreed.parameters, sizes, rtol=0, atol=1e-9)
    template = tn42.chain.keypoints_from_parameters(sizes)
    outline = [i for i, name in enumerate(tn42.chain.names) if name != "side"]  # either side may be meant
    expected = apply_pose(R, t, template)[:, outline]
    torch.testing.assert_close(agreed.keypoints[:, outline], expected, rtol=0, atol=1e-9)
    assert float(agreed.spread.max()) < 1e-9


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("said", [False, True], ids=["measured", "said"])
def test_a_millimetre_of_noise_leaves_every_one_of_sixty_bars_the_right_way_round(
    tn42, random_poses, said, seed
):
    (R, t), sizes = random_poses(60, seed), bars(60, seed)
    votes = surface_votes(tn42, sizes, R, t, (120,) * 60)
    votes = replace(votes, keypoints=votes.keypoints + noise_like(votes.keypoints, 0.001, seed))
    if said:
        votes = with_sizes(votes, sizes)
        votes = replace(votes, parameters=votes.parameters + noise_like(votes.parameters, 0.001, seed))
    agreed = FOLDED(tn42, votes)
    wrong = torch.rad2deg(rotation_angle(recovered(tn42, agreed), R))
    assert float(wrong.max()) < 10, wrong
    assert float((agreed.parameters - sizes).abs().max()) < 0.0015


@pytest.mark.parametrize("sized", [False, True], ids=["measured", "given"])
def test_the_likeliest_exchange_of_exact_keypoints_is_the_one_that_was_made(tn42, sized):
    sizes = bars(80).repeat_interleave(4, 0)
    template = tn42.chain.keypoints_from_parameters(sizes)
    meant = torch.arange(4).repeat(80)
    place, which = likeliest(tn42.chain, tn42.chain.exchanged(template, meant), sizes if sized else None)
    assert torch.equal(which, meant)
    torch.testing.assert_close(place, template, rtol=0, atol=1e-15)


def test_the_likeliest_exchange_does_not_depend_on_pose_or_side(tn42, random_poses):
    """Keypoints turned about the centroid, and of the other side, of which the mirror image is as good."""
    sizes = bars(40)
    template = tn42.chain.keypoints_from_parameters(sizes)
    mirrored = template * torch.tensor([1.0, -1, 1]).double()
    meant = torch.arange(40) % 4
    for keypoints in (template @ random_poses(40)[0].mT, mirrored):
        assert torch.equal(likeliest(tn42.chain, tn42.chain.exchanged(keypoints, meant), None)[1], meant)


def test_without_lookalikes_nothing_is_exchanged(brick, random_sizes):
    place = brick.chain.keypoints_from_parameters(random_sizes(brick, 5))
    found, which = likeliest(brick.chain, place, None)
    assert found is place and which.tolist() == [0] * 5


def test_a_fold_undoes_the_exchange_of_every_vote(tn42):
    template = tn42.chain.keypoints_from_parameters(bars(6))
    meant = torch.arange(24).view(6, 4) % 4
    votes = tn42.chain.exchanged(template[:, None].expand(-1, 4, -1, -1), meant)
    mirror = torch.tensor([[1.0, 1, 1], [1, -1, 1]]).double()[torch.arange(4) % 2]
    folded, which = fold(tn42.chain, template, votes * mirror[:, None])
    assert torch.equal(which, meant)
    torch.testing.assert_close(folded, template[:, None].expand_as(folded), rtol=0, atol=1e-15)


def test_spread_and_doubt_stay_with_their_keypoint(tn42, random_poses):
    """The toe's votes scatter and are doubted whatever place in the label it had."""
    (R, t), sizes = random_poses(8), bars(8)
    toe = tn42.chain.names.index("toe")
    surface = surface_votes(tn42, sizes, R, t, (100,) * 8)
    owner = surface.groups.owner
    truth = apply_pose(R, t, tn42.chain.keypoints_from_parameters(sizes))[owner]
    off = noise_like(truth[:, toe], 0.001)
    truth[:, toe] += off - off.mean(0)
    doubt = torch.full((len(owner), 9), 0.001).double()
    doubt[:, 1 + toe] = 0.004
    which = torch.arange(len(owner)) % 4  # each vote exchanged in turn
    said = tn42.chain.exchanged(doubt[:, 1:6, None], which)[..., 0]
    doubt = torch.cat([doubt[:, :1], said, doubt[:, 6:]], 1)
    votes = replace(surface, keypoints=tn42.chain.exchanged(truth, which), doubt=doubt)
    agreed = FOLDED(tn42, votes)
    assert math.degrees(float(rotation_angle(recovered(tn42, agreed), R).max())) < 2
    assert agreed.spread[:, 1:].argmax(1).tolist() == [toe] * 8
    expected = torch.full((8, 9), 0.001).double()
    expected[:, 1 + toe] = 0.004
    torch.testing.assert_close(agreed.doubt, expected, rtol=1e-9, atol=0)


def test_votes_that_exchange_nothing_are_taken_as_they_are_where_the_labels_had_no_lookalikes(tn42):
    """A lookalike that fits a little better than what was said must not win: here a is said too small."""
    sizes = torch.tensor([[0.040, 0.0101, 0.012]], dtype=torch.float64)
    said = tn42.chain.keypoints_from_parameters(torch.tensor([[0.040, 0.0055, 0.012]], dtype=torch.float64))
    keypoints = said[:, None].expand(-1, 30, -1, -1).flatten(0, 1)
    centroid = torch.zeros(30, 3, dtype=torch.float64)
    groups = clusters_of(torch.zeros(1, 30, dtype=torch.int64)).groups
    reliable = torch.ones(30, 1 + len(tn42.chain), dtype=torch.bool)
    votes = PointVotes(centroid, keypoints, groups, reliable, None, sizes.expand(30, -1))
    for exchanged in (True, False):
        agreed = FoldedVote(96, 512, 25.0, 3.0, exchanged)(tn42, votes)
        order = agreed.keypoints[0, tn42.chain.names.index("foot")]
        near = bool((order - said[0, tn42.chain.names.index("foot")]).norm() < 1e-3)
        assert near is not exchanged  # the small end is said larger than the large one
