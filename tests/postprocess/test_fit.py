"""The fit is exact for exact keypoints, whatever the part, the rule, the direction and the pose."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pnet.geometry.rigid import apply_pose, axis_angle_between
from pnet.geometry.symmetry import FiniteSymmetry, RevolutionSymmetry, cyclic
from pnet.parts.choice import KeypointChoice, KeypointRule, NearestToPoint
from pnet.parts.keypoints import KeypointChain
from pnet.parts.primitives import Plane
from pnet.parts.selection import Keypoint
from pnet.postprocess.fit import fit_pose

CAMERA, CANONICAL, POINT = KeypointRule.CAMERA, KeypointRule.CANONICAL, KeypointRule.POINT
CHOICES = [
    KeypointChoice(CANONICAL),
    KeypointChoice(CAMERA),
    KeypointChoice(CAMERA, (0, 1, 0)),
    KeypointChoice(CAMERA, (1, -0.5, 0.3)),
    KeypointChoice(POINT),
]
PLACES = torch.tensor([[3.0, 8, 5], [-7, 1, 4], [0.5, -6, -9], [4, -3, 7]], dtype=torch.float64) / 1000


def labels(
    part, choice: KeypointChoice, sizes: torch.Tensor, R: torch.Tensor, t: torch.Tensor
) -> torch.Tensor:
    """(n, m, 3) label keypoints, camera frame; under `point` seen from one of a few places about the part."""
    if choice.rule is POINT:
        points = PLACES[torch.arange(len(R)) % len(PLACES)]
        return apply_pose(
            R, t, part.chain.choose(NearestToPoint(points), part.chain.keypoints_from_parameters(sizes))[0]
        )
    return apply_pose(R, t, part.chain.select(choice, sizes, R)[0])


@pytest.mark.parametrize("choice", CHOICES, ids=lambda c: f"{c.rule}{c.direction}")
@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_exact_keypoints_give_the_exact_pose(
    any_part, random_poses, random_sizes, error_modulo, choice, seed
):
    R, t = random_poses(60, seed)
    sizes = random_sizes(any_part, 60, seed)
    found_R, found_t = fit_pose(any_part.chain, sizes, t, labels(any_part, choice, sizes, R, t))
    assert error_modulo(any_part.symmetry, found_R, R) < 1e-6
    assert float((found_t - t).abs().max()) < 1e-9
    assert float((torch.linalg.det(found_R) - 1).abs().max()) < 1e-9


@pytest.mark.parametrize("degrees", [0, 1e-6, 90, 180])
@pytest.mark.parametrize("axis", ["x", "y"])
def test_seen_along_its_axis_too(any_part, random_sizes, error_modulo, axis, degrees):
    """Where the label's choice is a tie, the fit must not care which way it went."""
    R = torch.from_numpy(Rotation.from_euler(axis, [degrees], degrees=True).as_matrix()).view(1, 3, 3)
    t, sizes = torch.tensor([[0.01, 0.02, 0.6]], dtype=torch.float64), random_sizes(any_part, 1)
    for choice in CHOICES:
        found_R, found_t = fit_pose(any_part.chain, sizes, t, labels(any_part, choice, sizes, R, t))
        assert error_modulo(any_part.symmetry, found_R, R) < 1e-6
        torch.testing.assert_close(found_t, t, rtol=0, atol=1e-9)


def test_noise_makes_an_error_of_its_own_size(any_part, random_poses, random_sizes, error_modulo):
    R, t = random_poses(200)
    sizes = random_sizes(any_part, 200)
    keypoints = labels(any_part, CHOICES[1], sizes, R, t)
    torch.manual_seed(0)
    noise = 1e-5 * torch.randn(200, 1 + len(any_part.chain), 3, dtype=torch.float64)
    found_R, found_t = fit_pose(any_part.chain, sizes, t + noise[:, 0], keypoints + noise[:, 1:])
    assert float((found_t - t).abs().max()) < 4e-5
    assert math.degrees(error_modulo(any_part.symmetry, found_R, R)) < 1


@pytest.mark.parametrize("name", ["brick", "tn42"])
@pytest.mark.parametrize("choice", CHOICES[1:], ids=lambda c: f"{c.rule}{c.direction}")
def test_both_chiralities_occur_and_the_better_one_is_taken(
    request, random_poses, random_sizes, error_modulo, name, choice
):
    """A brick's nearest faces, or a bar's nearer side: often the mirror image of the template's keypoints."""
    part = request.getfixturevalue(name)
    R, t = random_poses(150)
    sizes = random_sizes(part, 150)
    keypoints = labels(part, choice, sizes, R, t)
    local = (keypoints - t[:, None]) @ R
    spanned = [0, 1, 2]  # three that span the space: foot, side, toe; the three faces
    handedness = torch.linalg.det(local[:, spanned]) * torch.linalg.det(
        part.chain.keypoints_from_parameters(sizes)[:, spanned]
    )
    mirrored = handedness < 0
    assert 30 < int(mirrored.sum()) < 120
    found_R, found_t = fit_pose(part.chain, sizes, t, keypoints)
    for own in (mirrored, ~mirrored):
        assert error_modulo(part.symmetry, found_R[own], R[own]) < 1e-6
    torch.testing.assert_close(found_t, t, rtol=0, atol=1e-9)


def test_one_chirality_alone_fails_for_the_mirrored_half(brick, random_poses, random_sizes, error_modulo):
    assert len(brick.chain.chiralities) == 2
    R, t = random_poses(100)
    sizes = random_sizes(brick, 100)
    keypoints = labels(brick, CHOICES[1], sizes, R, t)
    mirrored = torch.linalg.det((keypoints - t[:, None]) @ R) < 0

    class Half:
        """The chain without its mirror image."""

        chiralities = brick.chain.chiralities[:1]

        def __getattr__(self, name):
            return getattr(brick.chain, name)

    found_R, _ = fit_pose(Half(), sizes, t, keypoints)
    assert error_modulo(brick.symmetry, found_R[~mirrored], R[~mirrored]) < 1e-6
    assert math.degrees(error_modulo(brick.symmetry, found_R[mirrored], R[mirrored])) > 10


def test_the_mirror_may_be_a_turn_and_a_reflection_in_one(random_poses, random_sizes, error_modulo):
    """A quarter turn about z with z turned round, which is not its own inverse."""
    screw = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, -1]], dtype=torch.float64)
    keypoints = [
        Keypoint("tip", "centroid", Plane((1.0, 0.3, 0.8)), "a"),
        Keypoint("fin", "centroid", Plane((-0.2, 1.0, 0.1)), "b"),
        Keypoint("face", "centroid", Plane("z"), "c"),
    ]
    chain = KeypointChain(keypoints, ("a", "b", "c"), cyclic(2), screw)
    assert len(chain.group) == 4 and len(chain.chiralities) == 2
    R, t = random_poses(100)
    sizes = torch.tensor([0.02, 0.03, 0.01], dtype=torch.float64).expand(100, 3)
    for choice in CHOICES:
        local = chain.choose(
            NearestToPoint(PLACES[torch.arange(100) % 4]), chain.keypoints_from_parameters(sizes)
        )[0]
        if choice.rule is not POINT:
            local = chain.select(choice, sizes, R)[0]
        found_R, found_t = fit_pose(chain, sizes, t, apply_pose(R, t, local))
        assert error_modulo(cyclic(2), found_R, R) < 1e-6
        torch.testing.assert_close(found_t, t, rtol=0, atol=1e-9)


def test_an_outlier_of_little_weight_does_not_move_the_pose(part, random_poses, random_sizes, error_modulo):
    R, t = random_poses(50)
    sizes = random_sizes(part, 50)
    keypoints = labels(part, CHOICES[1], sizes, R, t)
    keypoints[:, -1] += torch.tensor([0.01, -0.02, 0.03], dtype=torch.float64)
    weight = torch.ones(50, 4, dtype=torch.float64)
    plain_R, _ = fit_pose(part.chain, sizes, t, keypoints, weight)
    weight[:, -1] = 1e-12
    found_R, found_t = fit_pose(part.chain, sizes, t, keypoints, weight)
    if isinstance(part.symmetry, RevolutionSymmetry):
        assert error_modulo(part.symmetry, found_R, R) < 1e-5
    else:  # hole and centroid hold the turn only up to the circle
        axis = axis_angle_between(found_R[..., 2], R[..., 2])
        axis = torch.minimum(axis, math.pi - axis)
        assert float(axis.max()) < 1e-5
    assert float((found_t - t).abs().max()) < 1e-6
    assert error_modulo(part.symmetry, plain_R, R) > 0.05


def test_no_weight_is_equal_weights(any_part, random_poses, random_sizes, error_modulo):
    R, t = random_poses(20)
    sizes, m = random_sizes(any_part, 20), len(any_part.chain)
    torch.manual_seed(0)
    off = 1e-3 * torch.randn(20, m, 3, dtype=torch.float64)
    keypoints = apply_pose(R, t, any_part.chain.keypoints_from_parameters(sizes)) + off
    plain = fit_pose(any_part.chain, sizes, t, keypoints)
    equal = fit_pose(any_part.chain, sizes, t, keypoints, torch.full((20, 1 + m), 7.0, dtype=torch.float64))
    torch.testing.assert_close(plain[1], equal[1])
    assert error_modulo(any_part.symmetry, plain[0], equal[0]) < 1e-7
    if isinstance(any_part.symmetry, FiniteSymmetry):  # else the turn is free, and rounding decides
        torch.testing.assert_close(plain[0], equal[0])


def test_a_spoilt_instance_does_not_touch_those_beside_it(any_part, random_poses, random_sizes):
    R, t = random_poses(6)
    sizes = random_sizes(any_part, 6)
    keypoints = labels(any_part, CHOICES[1], sizes, R, t)
    together = fit_pose(any_part.chain, sizes, t, keypoints)
    keypoints[3] += 0.05
    spoilt = fit_pose(any_part.chain, sizes, t, keypoints)
    others = [0, 1, 2, 4, 5]
    torch.testing.assert_close(together[0][others], spoilt[0][others])
    torch.testing.assert_close(together[1][others], spoilt[1][others])


def test_a_fit_that_needs_a_gradient_has_one(any_part, random_poses, random_sizes):
    R, t = random_poses(4)
    sizes = random_sizes(any_part, 4)
    keypoints = apply_pose(R, t, any_part.chain.keypoints_from_parameters(sizes)).requires_grad_()
    fit_pose(any_part.chain, sizes, t, keypoints)[1].sum().backward()
    assert bool(torch.isfinite(keypoints.grad).all())
