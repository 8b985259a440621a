"""Voting modulo the symmetry: exact for exact votes, robust, and blind to which equivalent was meant."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pnet.geometry.rigid import apply_pose
from pnet.geometry.symmetry import SphericalSymmetry, rotation_about_z
from pnet.parts.base import ParametricPart
from pnet.parts.choice import KeypointChoice, KeypointRule, NearestToPoint
from pnet.postprocess.fit import fit_pose
from pnet.postprocess.folded_vote import FLOOR, ROUNDS, FoldedVote, _locate, fold, location, members
from pnet.postprocess.locations import locate
from pnet.postprocess.vote import InstanceVotes, MeanVote, PointVotes

FOLDED = FoldedVote(hypotheses=96, votes=512, width=25.0, cut=3.0)


def surface_votes(part: ParametricPart, sizes, R, t, counts) -> PointVotes:
    """Exact votes of surface points under the rule `point`, clusters mixed, some points in none."""
    centroid, keypoints, owner = [], [], []
    for i, count in enumerate(counts):
        surface = torch.from_numpy(part.mesh(sizes[i].numpy()).sample(count, seed=i)).double()
        template = part.chain.keypoints_from_parameters(sizes[i]).expand(count, -1, 3)
        keypoints.append(apply_pose(R[i], t[i], part.chain.choose(NearestToPoint(surface), template)[0]))
        centroid.append(t[i].expand(count, 3))
        owner += [i] * count
    stray = 5
    centroid.append(torch.full((stray, 3), 9.0).double())
    keypoints.append(torch.full((stray, len(part.chain), 3), 9.0).double())
    order = torch.randperm(len(owner) + stray, generator=torch.Generator().manual_seed(0))
    label = torch.tensor(owner + [-1] * stray)[order]
    reliable = (label >= 0)[:, None].expand(-1, 1 + len(part.chain))
    return PointVotes(torch.cat(centroid)[order], torch.cat(keypoints)[order], label, len(counts), reliable)


def recovered(part, agreed: InstanceVotes) -> torch.Tensor:
    return fit_pose(part.chain, agreed.parameters, agreed.centroid, agreed.keypoints)[0]


@pytest.fixture
def case(any_part, random_poses, random_sizes):
    """Four instances of unequal sizes and numbers of points, one of them of a single point."""
    R, t = random_poses(4)
    sizes = random_sizes(any_part, 4)
    return any_part, sizes, R, t, surface_votes(any_part, sizes, R, t, (300, 57, 1, 140))


def test_exact_votes_give_the_exact_pose_and_parameters(case, error_modulo):
    part, sizes, R, t, votes = case
    agreed = FOLDED(part, votes)
    assert error_modulo(part.symmetry, recovered(part, agreed), R) < 1e-6
    torch.testing.assert_close(agreed.parameters, sizes, rtol=0, atol=1e-9)
    torch.testing.assert_close(agreed.centroid, t, rtol=0, atol=1e-9)
    assert float(agreed.spread.max()) < 1e-9 and agreed.spread.shape == (4, 1 + len(part.chain))
    assert agreed.keypoints.shape == (4, len(part.chain), 3)


def test_the_keypoints_agreed_on_are_as_far_from_their_references_as_the_templates(case):
    part, sizes, _, _, votes = case
    agreed = FOLDED(part, votes)
    lengths = part.chain.steps(agreed.keypoints, agreed.centroid).norm(dim=-1)
    expected = part.chain.steps(part.chain.keypoints_from_parameters(sizes)).norm(dim=-1)
    torch.testing.assert_close(lengths, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("rule", [KeypointRule.CAMERA, KeypointRule.CANONICAL])
def test_other_rules_fold_as_well(any_part, random_poses, random_sizes, error_modulo, rule):
    R, t = random_poses(30)
    sizes = random_sizes(any_part, 30)
    keypoints = apply_pose(R, t, any_part.chain.select(KeypointChoice(rule), sizes, R)[0])
    owner = torch.arange(30).repeat_interleave(3)
    reliable = torch.ones(90, 1 + len(any_part.chain), dtype=torch.bool)
    agreed = FOLDED(any_part, PointVotes(t[owner], keypoints[owner], owner, 30, reliable))
    assert error_modulo(any_part.symmetry, recovered(any_part, agreed), R) < 1e-6
    torch.testing.assert_close(agreed.parameters, sizes, rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_thirty_percent_of_wild_votes_hardly_matter(any_part, random_poses, random_sizes, error_modulo, seed):
    """Half a millimetre of noise on all, 30 mm on three tenths."""
    R, t = random_poses(5, seed)
    sizes = random_sizes(any_part, 5, seed)
    votes = surface_votes(any_part, sizes, R, t, (200,) * 5)
    generator = torch.Generator().manual_seed(seed)
    wild = torch.rand(len(votes.owner), 1, 1, generator=generator, dtype=torch.float64) < 0.3
    noise = torch.randn(votes.keypoints.shape, generator=generator, dtype=torch.float64)
    noisy = votes.keypoints + noise * torch.where(wild, 0.03, 0.0005)
    agreed = FOLDED(any_part, PointVotes(votes.centroid, noisy, votes.owner, 5, votes.reliable))
    assert math.degrees(error_modulo(any_part.symmetry, recovered(any_part, agreed), R)) < 2.5
    assert float((agreed.parameters - sizes).abs().max()) < 0.0003


def test_votes_for_different_equivalents_meet_where_plain_means_are_far_off(case):
    """Points all around vote for all faces, rims and vertices: their plain mean is near the middle."""
    part, sizes, _, _, votes = case
    assert len(part.chain.group) > 1 or not all(part.chain.is_finite)  # every part here is ambiguous
    plain, folded = MeanVote()(part, votes), FOLDED(part, votes)
    large = [0, 1, 3]
    assert float(plain.spread[large].amax(1).min()) > 0.002
    assert float(folded.spread.max()) < 1e-9
    lengths = part.chain.parameters_from_keypoints(plain.centroid, plain.keypoints)[large]
    assert float(((lengths - sizes[large]).abs() / sizes[large]).amax(1).min()) > 0.3
    # what is measured point by point is right even so
    torch.testing.assert_close(plain.parameters, sizes, rtol=0, atol=1e-9)


def test_a_fold_carries_every_equivalent_to_the_templates_place(any_part, random_sizes):
    sizes = random_sizes(any_part, 1)
    template = any_part.chain.keypoints_from_parameters(sizes)
    turn = rotation_about_z(torch.arange(18).double())
    if any_part.symmetry == SphericalSymmetry():
        turn = torch.from_numpy(Rotation.random(18, 0).as_matrix())
    images = torch.cat([template @ G.mT for G in any_part.chain.group])[None]
    folded = fold(any_part.chain, template, images)
    torch.testing.assert_close(folded, template[:, None].expand_as(folded), rtol=0, atol=1e-12)
    if not all(any_part.chain.is_finite):  # free keypoints anywhere on their circle
        free = ~torch.tensor(any_part.chain.is_finite)
        turned = torch.where(free[:, None], template @ turn.mT, template)[None]
        torch.testing.assert_close(fold(any_part.chain, template, turned)[0], template.expand(18, -1, 3))


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_which_equivalent_a_noisy_vote_means_does_not_matter(any_part, random_sizes, seed):
    chain, generator = any_part.chain, torch.Generator().manual_seed(seed)
    template = chain.keypoints_from_parameters(random_sizes(any_part, 3, seed))
    noise = torch.randn(3, 20, len(chain), 3, generator=generator, dtype=torch.float64)
    local = template[:, None] + 0.0005 * noise
    element = chain.group[torch.randint(len(chain.group), (3, 20), generator=generator)]
    folded = fold(chain, template, local @ element.mT)
    torch.testing.assert_close(folded, fold(chain, template, local), rtol=0, atol=1e-12)


def test_a_fold_leaves_a_votes_error_as_large_as_it_was(tn42, random_sizes):
    """A bar's mirror image, 2 mm off: after the fold the error is mirrored too."""
    template = tn42.chain.keypoints_from_parameters(random_sizes(tn42, 1))
    off = torch.tensor([0.001, 0.002, -0.0005], dtype=torch.float64)
    mirror = torch.tensor([1.0, -1, 1], dtype=torch.float64)
    found = fold(tn42.chain, template, (template * mirror + off)[:, None])
    torch.testing.assert_close(found[:, 0], template + off * mirror, rtol=0, atol=1e-15)


def test_unreliable_centroid_votes_do_not_count(tn34, random_poses, random_sizes):
    R, t = random_poses(1)
    sizes = random_sizes(tn34, 1)
    votes = surface_votes(tn34, sizes, R, t, (100,))
    off = torch.arange(len(votes.owner)) % 4 == 0
    moved = votes.centroid + 0.004 * off[:, None]
    reliable = votes.reliable.clone()
    reliable[off, 0] = False
    counted = FOLDED(tn34, PointVotes(moved, votes.keypoints, votes.owner, 1, reliable))
    torch.testing.assert_close(counted.centroid, t, rtol=0, atol=1e-12)
    plain = FOLDED(tn34, PointVotes(moved, votes.keypoints, votes.owner, 1, votes.reliable))
    assert float((plain.centroid - t).norm()) > 0.001


def test_only_the_first_so_many_votes_are_used(tn06, random_poses, random_sizes, error_modulo):
    R, t = random_poses(2)
    sizes = random_sizes(tn06, 2)
    votes = surface_votes(tn06, sizes, R, t, (80, 90))
    spoilt = votes.keypoints.clone()
    for i in range(2):
        spoilt[torch.nonzero(votes.owner == i).squeeze(1)[20:]] = float("nan")
    few = FoldedVote(hypotheses=12, votes=20, width=25.0, cut=3.0)
    agreed = few(tn06, PointVotes(votes.centroid, spoilt, votes.owner, 2, votes.reliable))
    assert error_modulo(tn06.symmetry, recovered(tn06, agreed), R) < 1e-6
    torch.testing.assert_close(agreed.parameters, sizes, rtol=0, atol=1e-9)


def test_members_by_hand():
    index, valid = members(torch.tensor([1, -1, 0, 1, 1, 2, -1, 1, 0]), 3, 3)
    assert index.tolist() == [[2, 8, 2], [0, 3, 4], [5, 5, 5]]
    assert valid.tolist() == [[True, True, False], [True] * 3, [True, False, False]]
    assert members(torch.tensor([1, 0, 1]), 2, 1)[0].tolist() == [[1], [0]]
    assert members(torch.tensor([0, 0]), 1, 50)[0].tolist() == [[0, 1]]  # no wider than the largest


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6), d=st.integers(1, 5), most=st.integers(1, 12))
def test_members_against_one_cluster_at_a_time(seed, d, most):
    generator = torch.Generator().manual_seed(seed)
    owner = torch.cat([torch.arange(d), torch.randint(-1, d, (30,), generator=generator)])
    index, valid = members(owner, d, most)
    for c in range(d):
        own = torch.nonzero(owner == c).squeeze(1)[:most].tolist()
        assert index[c, valid[c]].tolist() == own
        assert set(index[c, ~valid[c]].tolist()) <= {own[0]}


def test_the_location_by_hand():
    """Median 0.01, distances 0.01, 0, 0.01; with cut 2 the weights at 1/2 are 9/16; the far one has none."""
    values = torch.tensor([[[0.0], [0.01], [0.02], [5.0]]], dtype=torch.float64)
    centre, spread = location(values, torch.ones(1, 4, dtype=torch.bool), 2.0)
    assert float(centre) == pytest.approx(0.01)
    assert float(spread) == pytest.approx(0.01 * math.sqrt(2 * 9 / 16 / (1 + 2 * 9 / 16)))


def test_the_location_leaves_invalid_entries_out():
    values = torch.tensor([[[1.0, 2.0]] * 3 + [[7.0, 7.0]] * 5, [[3.0, 4.0]] * 8], dtype=torch.float64)
    valid = torch.tensor([[True] * 3 + [False] * 5, [True] * 8])
    centre, spread = location(values, valid, 3.0)
    assert centre.tolist() == [[1, 2], [3, 4]] and spread.tolist() == [0, 0]


@pytest.mark.parametrize("wild", [0, 10, 45])
def test_the_location_of_a_cloud_is_its_middle_whatever_lies_far_off(wild):
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(1, 100, 3, generator=generator, dtype=torch.float64)
    values[:, :wild] += 1000
    centre, spread = location(values, torch.ones(1, 100, dtype=torch.bool), 3.0)
    assert float(centre.norm()) < 0.4
    assert 1 < float(spread) < 2  # √3 for the whole cloud


def test_scattered_votes_keep_their_median():
    """Two votes, each a median distance or more from the middle of a cut below one: neither counts."""
    values = torch.tensor([[[0.0, 1.0], [1.0, 0.0]]], dtype=torch.float64)
    centre, _ = location(values, torch.ones(1, 2, dtype=torch.bool), 0.5)
    assert centre.tolist() == [[0, 0]]


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    n=st.integers(1, 60),
    c=st.integers(1, 4),
    cut=st.sampled_from([0.5, 1.5, 3.0]),
)
def test_the_compiled_location_is_the_plain_one(seed, n, c, cut):
    generator = torch.Generator().manual_seed(seed)
    values = torch.randn(5, n, c, generator=generator, dtype=torch.float64)
    values[:, ::4] *= 20
    values[1] = values[1, :1]  # all equal
    valid = torch.rand(5, n, generator=generator) < 0.8
    valid[:, 0] = True
    found, expected = (run(values, valid, cut, FLOOR, ROUNDS) for run in (locate, _locate))
    torch.testing.assert_close(found[0], expected[0], rtol=0, atol=1e-9)
    torch.testing.assert_close(found[1], expected[1], rtol=0, atol=1e-9)


def test_the_folded_vote_is_the_same_for_any_number_of_threads(tn06, random_poses, random_sizes):
    R, t = random_poses(6)
    votes = surface_votes(tn06, random_sizes(tn06, 6), R, t, (300, 40, 90, 150, 10, 200))
    noise = torch.randn(votes.keypoints.shape, generator=torch.Generator().manual_seed(0)).double()
    noisy = PointVotes(votes.centroid, votes.keypoints + 0.001 * noise, votes.owner, 6, votes.reliable)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        alone = FOLDED(tn06, noisy)
        torch.set_num_threads(3)
        other = FOLDED(tn06, noisy)
    finally:
        torch.set_num_threads(before)
    for name in ("centroid", "keypoints", "parameters", "spread"):
        assert torch.equal(getattr(alone, name), getattr(other, name))
