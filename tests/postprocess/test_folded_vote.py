"""Voting modulo the symmetry: exact for exact votes, robust, and blind to which equivalent was meant."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pnet.geometry.rigid import apply_pose
from pnet.geometry.symmetry import SphericalSymmetry, rotation_about_z
from pnet.parts.base import ParametricPart
from pnet.parts.choice import KeypointChoice, KeypointRule
from pnet.postprocess.fit import fit_pose
from pnet.postprocess.folded_vote import FoldedVote, fold
from pnet.postprocess.grouping import clusters_of
from pnet.postprocess.vote import InstanceVotes, MeanVote, PointVotes

FOLDED = FoldedVote(hypotheses=96, votes=512, width=25.0, cut=3.0)


def surface_votes(part: ParametricPart, sizes, R, t, counts) -> PointVotes:
    """Exact votes of surface points under the rule `point`, in a random order within a cluster."""
    centroid, keypoints, owner = [], [], []
    for i, count in enumerate(counts):
        surface = torch.from_numpy(part.mesh(sizes[i].numpy()).sample(count, seed=i)).double()
        template = part.chain.keypoints_from_parameters(sizes[i]).expand(count, -1, 3)
        keypoints.append(apply_pose(R[i], t[i], part.chain.nearest(surface, template)[0]))
        centroid.append(t[i].expand(count, 3))
        owner += [i] * count
    order = torch.randperm(len(owner), generator=torch.Generator().manual_seed(0))
    return point_votes(torch.cat(centroid)[order], torch.cat(keypoints)[order], torch.tensor(owner)[order])


def point_votes(centroid, keypoints, owner) -> PointVotes:
    """All votes of points (n, ...) in any order."""
    clusters = clusters_of(owner[None])
    reliable = torch.ones(len(owner), 1 + keypoints.shape[1], dtype=torch.bool)
    return PointVotes(clusters.of(centroid[None]), clusters.of(keypoints[None]), clusters.groups, reliable)


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
    agreed = FOLDED(any_part, point_votes(t[owner], keypoints[owner], owner))
    assert error_modulo(any_part.symmetry, recovered(any_part, agreed), R) < 1e-6
    torch.testing.assert_close(agreed.parameters, sizes, rtol=0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_thirty_percent_of_wild_votes_hardly_matter(any_part, random_poses, random_sizes, error_modulo, seed):
    """Half a millimetre of noise on all, 30 mm on three tenths."""
    R, t = random_poses(5, seed)
    sizes = random_sizes(any_part, 5, seed)
    votes = surface_votes(any_part, sizes, R, t, (200,) * 5)
    generator = torch.Generator().manual_seed(seed)
    wild = torch.rand(len(votes.centroid), 1, 1, generator=generator, dtype=torch.float64) < 0.3
    noise = torch.randn(votes.keypoints.shape, generator=generator, dtype=torch.float64)
    noisy = votes.keypoints + noise * torch.where(wild, 0.03, 0.0005)
    agreed = FOLDED(any_part, replace(votes, keypoints=noisy))
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
    if len(part.chain.lookalikes) == 1:  # what is measured point by point is right even so
        torch.testing.assert_close(plain.parameters, sizes, rtol=0, atol=1e-9)
    else:  # it is not where it might be another end
        assert float((plain.parameters - sizes)[large].abs().amax(1).min()) > 0.001


def test_a_fold_carries_every_equivalent_to_the_templates_place(any_part, random_sizes):
    sizes = random_sizes(any_part, 1)
    template = any_part.chain.keypoints_from_parameters(sizes)
    turn = rotation_about_z(torch.arange(18).double())
    if any_part.symmetry == SphericalSymmetry():
        turn = torch.from_numpy(Rotation.random(18, 0).as_matrix())
    images = torch.cat([template @ G.mT for G in any_part.chain.group])[None]
    folded, which = fold(any_part.chain, template, images)
    assert not bool(which.any())  # nothing was exchanged
    torch.testing.assert_close(folded, template[:, None].expand_as(folded), rtol=0, atol=1e-12)
    if not all(any_part.chain.is_finite):  # free keypoints anywhere on their circle
        free = ~torch.tensor(any_part.chain.is_finite)
        turned = torch.where(free[:, None], template @ turn.mT, template)[None]
        torch.testing.assert_close(fold(any_part.chain, template, turned)[0][0], template.expand(18, -1, 3))


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_which_equivalent_a_noisy_vote_means_does_not_matter(any_part, random_sizes, seed):
    chain, generator = any_part.chain, torch.Generator().manual_seed(seed)
    template = chain.keypoints_from_parameters(random_sizes(any_part, 3, seed))
    noise = torch.randn(3, 20, len(chain), 3, generator=generator, dtype=torch.float64)
    local = template[:, None] + 0.0005 * noise
    element = chain.group[torch.randint(len(chain.group), (3, 20), generator=generator)]
    q = len(chain.lookalikes)
    meant = torch.randint(q, (3, 20), generator=generator)
    folded, which = fold(chain, template, chain.exchanged(local @ element.mT, meant))
    expected, own = fold(chain, template, local)
    torch.testing.assert_close(folded, expected, rtol=0, atol=1e-12)
    assert not bool(own.any()) and torch.equal(which, meant)


def test_a_fold_leaves_a_votes_error_as_large_as_it_was(tn42, random_sizes):
    """A bar's mirror image, 2 mm off: after the fold the error is mirrored too."""
    template = tn42.chain.keypoints_from_parameters(random_sizes(tn42, 1))
    off = torch.tensor([0.001, 0.002, -0.0005], dtype=torch.float64)
    mirror = torch.tensor([1.0, -1, 1], dtype=torch.float64)
    found, _ = fold(tn42.chain, template, (template * mirror + off)[:, None])
    torch.testing.assert_close(found[:, 0], template + off * mirror, rtol=0, atol=1e-15)


def test_unreliable_centroid_votes_do_not_count(tn34, random_poses, random_sizes):
    R, t = random_poses(1)
    sizes = random_sizes(tn34, 1)
    votes = surface_votes(tn34, sizes, R, t, (100,))
    off = torch.arange(len(votes.centroid)) % 4 == 0
    moved = votes.centroid + 0.004 * off[:, None]
    reliable = votes.reliable.clone()
    reliable[off, 0] = False
    counted = FOLDED(tn34, replace(votes, centroid=moved, reliable=reliable))
    torch.testing.assert_close(counted.centroid, t, rtol=0, atol=1e-12)
    plain = FOLDED(tn34, replace(votes, centroid=moved))
    assert float((plain.centroid - t).norm()) > 0.001


def test_only_the_first_so_many_votes_are_used(tn06, random_poses, random_sizes, error_modulo):
    R, t = random_poses(2)
    sizes = random_sizes(tn06, 2)
    votes = surface_votes(tn06, sizes, R, t, (80, 90))
    spoilt = votes.keypoints.clone()
    for i in range(2):
        spoilt[torch.nonzero(votes.groups.owner == i).squeeze(1)[20:]] = float("nan")
    few = FoldedVote(hypotheses=12, votes=20, width=25.0, cut=3.0)
    agreed = few(tn06, replace(votes, keypoints=spoilt))
    assert error_modulo(tn06.symmetry, recovered(tn06, agreed), R) < 1e-6
    torch.testing.assert_close(agreed.parameters, sizes, rtol=0, atol=1e-9)


def test_the_folded_vote_is_the_same_for_any_number_of_threads(tn06, random_poses, random_sizes):
    R, t = random_poses(6)
    votes = surface_votes(tn06, random_sizes(tn06, 6), R, t, (300, 40, 90, 150, 10, 200))
    noise = torch.randn(votes.keypoints.shape, generator=torch.Generator().manual_seed(0)).double()
    noisy = replace(votes, keypoints=votes.keypoints + 0.001 * noise)
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
