"""Keypoints from parameters and back; the geometrically unique choice."""

import math

import pytest
import roma
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pnet.geometry.rigid import apply_pose
from pnet.geometry.symmetry import FiniteSymmetry, rotation_about_z
from pnet.parts.keypoints import Keypoint, KeypointChain, KeypointChoice, KeypointRule
from pnet.parts.orbits import RingOrbit, pair_orbit, point_orbit, polygon_orbit

CHOICES = {
    "equation 1": KeypointChoice(),
    "oblique": KeypointChoice(direction=(0.4, -0.7, 0.5)),
    "canonical": KeypointChoice(KeypointRule.CANONICAL),
}
NEAR_SIDE_UP = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))


@pytest.fixture(autouse=True)
def seed():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


@pytest.fixture(params=CHOICES.values(), ids=CHOICES.keys())
def choice(request):
    return request.param


@pytest.fixture
def cylinder() -> KeypointChain:
    """A face centre and a point on its rim; two keypoints measure the radius."""
    keypoints = [
        Keypoint("face", "centroid", pair_orbit((0, 0, 1)), "h", 0.5),
        Keypoint("rim", "face", RingOrbit(), "r"),
        Keypoint("side", "centroid", RingOrbit(), "r", 2.0),
    ]
    return KeypointChain(keypoints, ["r", "h"])


def random_instances(part, n: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Parameters (n, k) from 5 to 25 mm, R (n, 3, 3), t (n, 3)."""
    parameters = 0.005 + 0.02 * torch.rand(n, len(part.parameter_names), dtype=torch.float64)
    return parameters, roma.random_rotmat(n, dtype=torch.float64), 0.3 * torch.randn(n, 3).double()


def symmetries(part) -> torch.Tensor:
    """(g, 3, 3) rotations that leave the part as it is."""
    if isinstance(part.symmetry, FiniteSymmetry):
        return part.symmetry.rotations
    return rotation_about_z(2 * math.pi * torch.rand(8).double())


def test_parameters_come_back_from_the_keypoints_in_any_pose(part, choice):
    parameters, R, t = random_instances(part, 50)
    keypoints = apply_pose(R, t, part.chain.select(choice, parameters, R))
    found = part.chain.parameters_from_keypoints(t, keypoints)
    torch.testing.assert_close(found, parameters, atol=1e-12, rtol=0)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(1e-4, 1.0), min_size=3, max_size=3))
def test_any_positive_parameters_come_back(tn06, values):
    parameters = torch.tensor(values, dtype=torch.float64)
    keypoints = tn06.chain.canonical(parameters)
    found = tn06.chain.parameters_from_keypoints(torch.zeros(3).double(), keypoints)
    torch.testing.assert_close(found, parameters, atol=1e-12, rtol=1e-12)


def test_batch_dimensions_and_dtype_are_kept(part, choice):
    parameters, R, _ = random_instances(part, 6)
    k, m = parameters.shape[1], len(part.chain)
    keypoints = part.chain.select(choice, parameters.float().reshape(2, 3, k), R.float().reshape(2, 3, 3, 3))
    assert keypoints.shape == (2, 3, m, 3) and keypoints.dtype == torch.float32
    one_by_one = torch.stack([part.chain.select(choice, p, r) for p, r in zip(parameters, R, strict=True)])
    torch.testing.assert_close(keypoints.flatten(0, 1).double(), one_by_one, atol=1e-7, rtol=0)


def test_the_mean_stands_where_several_keypoints_measure_one_parameter(cylinder):
    keypoints = torch.tensor([[0, 0, 0.01], [0.005, 0, 0.01], [0, 0.014, 0]], dtype=torch.float64)
    found = cylinder.parameters_from_keypoints(torch.zeros(3).double(), keypoints)
    assert found.tolist() == pytest.approx([(0.005 + 0.014 / 2) / 2, 0.02])


def test_the_default_choice_is_equation_1(part):
    parameters, R, _ = random_instances(part, 20)
    expected = part.chain.nearest_to_camera(parameters, R)
    assert torch.equal(KeypointChoice().frame, torch.eye(3, dtype=torch.float64))
    assert torch.equal(part.chain.select(KeypointChoice(), parameters, R), expected)


@settings(max_examples=30, deadline=None)
@given(st.tuples(*[st.floats(-10, 10)] * 3).filter(lambda d: math.hypot(*d) > 1e-3))
def test_the_frame_of_a_choice_is_a_rotation_with_the_direction_as_z(direction):
    frame = KeypointChoice(direction=direction).frame
    torch.testing.assert_close(frame @ frame.T, torch.eye(3).double(), atol=1e-12, rtol=0)
    assert float(torch.linalg.det(frame)) == pytest.approx(1)
    along = torch.tensor(direction, dtype=torch.float64) / math.hypot(*direction)
    torch.testing.assert_close(frame[2], along, atol=1e-12, rtol=0)


def test_an_oblique_choice_takes_what_lies_least_far_along_its_direction(tn06):
    direction = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    parameters, R, _ = random_instances(tn06, 20)
    found = tn06.chain.select(KeypointChoice(direction=(0.6, 0.0, 0.8)), parameters, R)
    for (_, h, d), rotation, keypoints in zip(parameters, R, found, strict=True):
        hexagon = d * tn06.chain.keypoints[2].orbit.directions
        faces = torch.tensor([[0, 0, 0.5], [0, 0, -0.5]]).double() * h
        along = [(points @ rotation.T @ direction).min() for points in (faces, hexagon)]
        face, vertex = keypoints[0], keypoints[2] - keypoints[0]
        assert float(rotation @ face @ direction) == pytest.approx(float(along[0]))
        assert float(rotation @ vertex @ direction) == pytest.approx(float(along[1]))


@pytest.mark.parametrize("direction", [(0.0, 0.0, 0.0), (0.0, 1.0)])
def test_a_choice_without_a_direction_is_refused(direction):
    with pytest.raises(ValueError, match=r"targets.direction is \(0.0, .*expected three numbers"):
        KeypointChoice(direction=direction)


def test_the_unique_keypoints_do_not_depend_on_the_equivalent_pose_taken(part):
    parameters, R, _ = random_instances(part, 20)
    labels = part.chain.nearest_to_camera(parameters, R) @ R.mT
    for G in symmetries(part):
        turned = part.chain.nearest_to_camera(parameters, R @ G) @ (R @ G).mT
        torch.testing.assert_close(turned, labels, atol=1e-12, rtol=0)


def test_the_canonical_keypoints_do_depend_on_it(tn06):
    parameters, R, _ = random_instances(tn06, 1)
    G = tn06.symmetry.rotations[1]
    vertex = tn06.chain.canonical(parameters)[0, 2]
    assert torch.linalg.vector_norm(R[0] @ vertex - R[0] @ G @ vertex) > 0.9 * parameters[0, 2]


def test_hole_and_vertex_stay_on_the_face_nearest_to_the_camera(tn06):
    parameters, R, t = random_instances(tn06, 100)
    keypoints = tn06.chain.nearest_to_camera(parameters, R)
    heights = keypoints[..., 2]
    assert torch.equal(heights[:, 0], heights[:, 1]) and torch.equal(heights[:, 0], heights[:, 2])
    torch.testing.assert_close(heights[:, 0].abs(), parameters[:, 1] / 2)
    depth = apply_pose(R, t, torch.stack([keypoints[:, 0], -keypoints[:, 0]], 1))[..., 2]
    assert (depth[:, 0] < depth[:, 1]).all()
    assert (heights[:, 0] > 0).any() and (heights[:, 0] < 0).any()


def test_each_unique_keypoint_is_the_nearest_of_its_equivalents(tn06):
    """Brute force over both faces, 6 vertices and 720 points of the hole."""
    (parameters, R, _), chain = random_instances(tn06, 10), tn06.chain
    for (r, h, d), rotation, found in zip(parameters, R, chain.nearest_to_camera(parameters, R), strict=True):
        side = min((1.0, -1.0), key=lambda s, z=rotation[2, 2]: s * z)
        for radius, count, keypoint, gap in ((d, 6, found[2], 1e-12), (r, 720, found[1], 1e-6)):
            turns = rotation_about_z(2 * math.pi / count * torch.arange(count).double())
            ring = radius * turns[:, :, 0] + side * h / 2 * torch.tensor([0.0, 0, 1]).double()
            assert abs((ring @ rotation[2]).min() - keypoint @ rotation[2]) <= gap


def test_a_round_keypoint_seen_along_the_axis_goes_by_y(tn34):
    parameters = torch.tensor([0.012, 0.010], dtype=torch.float64)
    rim = tn34.chain.nearest_to_camera(parameters, NEAR_SIDE_UP)[2]
    assert rim[:2].tolist() == [0, 0.012]


def test_placing_like_an_observation_keeps_free_keypoints_and_resets_finite_ones(tn06):
    parameters, R, _ = random_instances(tn06, 40)
    observed = tn06.chain.nearest_to_camera(parameters, R)
    placed = tn06.chain.place_like(parameters, observed)
    canonical = tn06.chain.canonical(parameters)
    torch.testing.assert_close(placed[:, [0, 2]], canonical[:, [0, 2]])
    torch.testing.assert_close(placed[:, 1, :2], observed[:, 1, :2])
    torch.testing.assert_close(placed[:, 1, 2], canonical[:, 1, 2])


def test_placing_like_exact_template_keypoints_gives_them_back(part):
    parameters, _, _ = random_instances(part, 10)
    canonical = part.chain.canonical(parameters)
    torch.testing.assert_close(part.chain.place_like(parameters, canonical), canonical)


def test_placing_uses_the_given_parameters_not_the_observed_distances(tn34):
    parameters = torch.tensor([0.012, 0.010], dtype=torch.float64)
    noisy = tn34.chain.canonical(1.2 * parameters)
    torch.testing.assert_close(tn34.chain.place_like(parameters, noisy), tn34.chain.canonical(parameters))


def test_a_keypoint_on_a_ring_is_not_finite_nor_is_one_that_hangs_on_it():
    keypoints = [
        Keypoint("face", "centroid", point_orbit((0, 0, 1)), "h"),
        Keypoint("rim", "face", RingOrbit(), "r"),
        Keypoint("foot", "rim", point_orbit((0, 0, -1)), "h"),
        Keypoint("corner", "face", polygon_orbit(4), "r"),
    ]
    assert KeypointChain(keypoints, ["r", "h"]).is_finite == [True, False, False, True]


def test_the_names_come_in_order(tn06):
    assert tn06.chain.names == ["face", "hole", "vertex"]
    assert len(tn06.chain) == 3


def test_an_unknown_reference_is_named():
    with pytest.raises(ValueError, match=r"'rim' refers to 'face', which is not one of \['centroid'\]"):
        KeypointChain([Keypoint("rim", "face", RingOrbit(), "r")], ["r"])


def test_a_keypoint_cannot_refer_to_a_later_one():
    later = [
        Keypoint("rim", "face", RingOrbit(), "r"),
        Keypoint("face", "centroid", point_orbit((0, 0, 1)), "h"),
    ]
    with pytest.raises(ValueError, match="earlier keypoint"):
        KeypointChain(later, ["r", "h"])


def test_an_unknown_parameter_is_named():
    with pytest.raises(ValueError, match=r"'rim' measures 'q', which is not one of the parameters \['r'\]"):
        KeypointChain([Keypoint("rim", "centroid", RingOrbit(), "q")], ["r"])


def test_a_parameter_that_no_keypoint_measures_is_named():
    with pytest.raises(ValueError, match="no keypoint determines the parameter 'h'"):
        KeypointChain([Keypoint("rim", "centroid", RingOrbit(), "r")], ["r", "h"])
