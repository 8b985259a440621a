"""Which equivalent is the label: against brute force, by hand-made views, and by invariance."""

import math

import pytest
import roma
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from pnet.geometry.symmetry import cyclic, rotation_about_z
from pnet.parts.choice import KeypointChoice, KeypointRule, NearestToCamera, NearestToPoint, first_by
from pnet.parts.equivalents import along_and_radial
from pnet.parts.keypoints import KeypointChain
from pnet.parts.primitives import Freedom, Plane
from pnet.parts.selection import Keypoint

TURNS = 2880
DOWN = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))  # camera looks along part -z
EYE = torch.eye(3, dtype=torch.float64)


def metres(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def equivalents(keypoint, step: Tensor, group: Tensor) -> Tensor:
    """(g, q, 3) dense sample of where each symmetry element and each turn puts a step."""
    match keypoint.primitive.freedom:
        case Freedom.NONE:
            own = step[None]
        case Freedom.TURN:
            angle = torch.arange(TURNS).double() * (2 * math.pi / TURNS)
            own = step @ roma.rotvec_to_rotmat(angle[:, None] * keypoint.primitive.axis).mT
        case Freedom.SPHERE:
            polar = torch.linspace(0, math.pi, 181).double()[:, None]
            turn = torch.linspace(0, 2 * math.pi, 361).double()
            x, y = polar.sin() * turn.cos(), polar.sin() * turn.sin()
            own = step.norm() * torch.stack([x, y, polar.cos().expand(-1, 361)], -1).flatten(0, 1)
    return own @ group.mT


def check_against_brute_force(chain, template: Tensor, found: Tensor, margin: Tensor, cost) -> None:
    """Every keypoint costs least of those that the choices before it leave, and its margin is the lead."""
    alive, places, margins = list(range(len(chain.group))), [torch.zeros(3).double()], [math.inf]
    narrowed = math.inf
    for i, keypoint in enumerate(chain.keypoints):
        step = chain.steps(template)[i]
        start = places[chain.reference[i]]
        sample = start + equivalents(keypoint, step, chain.group)
        near = float(step.norm()) * 1e-6 if keypoint.primitive.freedom is not Freedom.SPHERE else 1e-4
        least = {g: float(cost(sample[g]).min()) for g in alive}
        best = min(least.values())
        assert -near <= best - float(cost(found[i])) <= 50 * near
        gap = (sample - found[i]).norm(dim=-1).amin(-1)
        owners = [g for g in alive if gap[g] < (1e-9 if sample.shape[1] == 1 else 0.02 * step.norm())]
        assert owners and all(least[g] <= best + 50 * near for g in owners)
        lead = min((c for g, c in least.items() if g not in owners), default=math.inf) - best
        reached = [
            any((sample[g] - sample[h]).norm(dim=-1).max() < 1e-9 for h in alive) for g in range(len(sample))
        ]
        runner_up = lead if all(reached) or sample.shape[1] > 1 else min(lead, narrowed)
        narrowed = min(narrowed, lead)
        if sample.shape[1] > 1:
            costs = cost(sample[owners[0]])
            runner_up = min(runner_up, float(costs.max() - costs.min()) / 2)
        margins.append(min(runner_up, margins[chain.reference[i]]))
        assert float(margin[i]) == pytest.approx(margins[-1], abs=100 * near)
        alive, places = owners, [*places, found[i]]


def test_the_camera_rule_is_the_minimum_over_all_equivalents(chain, rotations, sizes):
    R, template = rotations(12), chain.keypoints_from_parameters(sizes(chain, 12))
    found, margin = chain.choose(NearestToCamera(R), template)
    for n in range(12):
        check_against_brute_force(chain, template[n], found[n], margin[n], lambda p, n=n: p @ R[n, 2])


def test_the_point_rule_is_the_minimum_over_all_equivalents(chain, sizes):
    template = chain.keypoints_from_parameters(sizes(chain, 12))
    points = 0.02 * torch.randn(12, 3, generator=torch.Generator().manual_seed(5)).double()
    found, margin = chain.choose(NearestToPoint(points), template)
    for n in range(12):
        check_against_brute_force(
            chain, template[n], found[n], margin[n], lambda p, n=n: (p - points[n]).norm(dim=-1)
        )


def test_the_camera_labels_are_the_same_for_every_equivalent_pose(chain, rotations, sizes, symmetries):
    R, template = rotations(20), chain.keypoints_from_parameters(sizes(chain, 20))
    labels, margin = chain.choose(NearestToCamera(R), template)
    for g in symmetries(chain):
        turned, other = chain.choose(NearestToCamera(R @ g), template)
        torch.testing.assert_close(turned @ (R @ g).mT, labels @ R.mT, atol=1e-12, rtol=0)
        torch.testing.assert_close(other, margin, atol=1e-12, rtol=0)


def test_the_point_labels_turn_with_the_point(chain, sizes, symmetries):
    template = chain.keypoints_from_parameters(sizes(chain, 20))
    points = 0.02 * torch.randn(20, 3, generator=torch.Generator().manual_seed(6)).double()
    labels, margin = chain.choose(NearestToPoint(points), template)
    for g in symmetries(chain):
        turned, other = chain.choose(NearestToPoint(points @ g.T), template)
        torch.testing.assert_close(turned, labels @ g.T, atol=1e-12, rtol=0)
        torch.testing.assert_close(other, margin, atol=1e-12, rtol=0)


def test_hole_and_vertex_stay_on_the_chosen_face(declare, rotations, sizes):
    chain = declare("nut")
    R, parameters = rotations(100), sizes(chain, 100)
    found, _ = chain.choose(NearestToCamera(R), chain.keypoints_from_parameters(parameters))
    heights = found[..., 2]
    torch.testing.assert_close(heights, heights[:, :1].expand(-1, 3), atol=1e-15, rtol=0)
    assert torch.equal(heights[:, 0] > 0, R[:, 2, 2] < 0)
    assert 20 < (heights[:, 0] > 0).sum() < 80


@pytest.mark.parametrize("body", ["antiprism", "antiprism with inversion"])
def test_the_vertex_is_one_of_the_chosen_faces_own_three(declare, rotations, sizes, body):
    """Upper vertices at 90°, 210°, 330°; lower ones turned by 60°."""
    chain = declare(body)
    R, parameters = rotations(100), sizes(chain, 100)
    found, _ = chain.choose(NearestToCamera(R), chain.keypoints_from_parameters(parameters))
    face, vertex = (found[:, chain.names.index(name)] for name in ("face", "vertex"))
    degrees = torch.atan2(vertex[:, 1], vertex[:, 0]).rad2deg().round().long() % 360
    up = R[:, 2, 2] < 0
    assert set(degrees[up].tolist()) == {90, 210, 330} and set(degrees[~up].tolist()) == {30, 150, 270}
    torch.testing.assert_close(vertex[:, 2], face[:, 2], atol=1e-15, rtol=0)


def test_the_pipe_chosen_first_binds_its_end(declare, rotations, sizes):
    """The end must close the pipe that was chosen, though the other pipe's may be nearer."""
    chain = declare("crossed pipes")
    R, parameters = rotations(200), sizes(chain, 200)
    found, _ = chain.choose(NearestToCamera(R), chain.keypoints_from_parameters(parameters))
    assert (found[:, 0] * found[:, 1]).sum(-1).abs().max() < 1e-15
    other_nearer = R[:, 2, :2].abs().argmax(-1) != found[:, 1, :2].abs().argmax(-1)
    assert other_nearer.any()


def test_seen_along_its_axis_a_hexagon_goes_by_y_then_x(declare):
    """All vertices are equally near; camera y is ∓y, two vertices tie in it, the smaller x has it."""
    chain = declare("nut")
    template = chain.keypoints_from_parameters(metres(0.004, 0.010, 0.012))
    high = 0.012 * math.sqrt(0.75)
    for view, y in ((DOWN, high), (EYE, -high)):
        found, margin = chain.choose(NearestToCamera(view), template)
        side = -view[2, 2] * 0.005
        torch.testing.assert_close(found[2], metres(-0.006, y, side), atol=1e-12, rtol=0)
        torch.testing.assert_close(found[1], metres(0, math.copysign(0.004, y), side))
        assert margin.tolist() == pytest.approx([0.010, 0, 0], abs=1e-12)


@pytest.mark.parametrize(
    ("axis_in_camera", "side"),
    [((0, 0, 1), -1), ((0, 0, -1), 1), ((0, 1, 0), -1), ((0, -1, 0), 1), ((1, 0, 0), -1), ((-1, 0, 0), 1)],
)
def test_equal_faces_seen_from_the_side_are_told_apart_by_y_then_x(declare, axis_in_camera, side):
    chain = declare("double cone")
    z = metres(*axis_in_camera)
    x = z.roll(1)
    view = torch.stack([x, torch.linalg.cross(z, x), z], -1)
    assert torch.linalg.det(view) == 1
    found, margin = chain.choose(
        NearestToCamera(view), chain.keypoints_from_parameters(metres(0.01, 0.02, 0.005))
    )
    assert found[0].tolist() == pytest.approx([0, 0, 0.01 * side])
    assert found[2].tolist() == pytest.approx([0, 0, 0.015 * side])
    assert float(margin[0]) == pytest.approx(0.02 if axis_in_camera[2] else 0)


def test_a_point_on_the_axis_takes_the_templates_own_place_on_the_circle(declare):
    chain = declare("flange")
    template = chain.keypoints_from_parameters(metres(0.01, 0.02))
    found, margin = chain.choose(NearestToPoint(metres(0, 0, 0.03)), template)
    torch.testing.assert_close(found, template)
    assert margin.tolist() == [math.inf, 0]


@settings(max_examples=30, deadline=None)
@given(st.floats(-math.pi, math.pi), st.floats(1e-3, 0.1), st.floats(-0.1, 0.1))
def test_the_nearest_point_of_a_circle_has_the_points_azimuth(declare, azimuth, radius, height):
    chain = declare("flange")
    point = metres(radius * math.cos(azimuth), radius * math.sin(azimuth), height)
    found, margin = chain.choose(NearestToPoint(point), chain.keypoints_from_parameters(metres(0.01, 0.02)))
    expected = [0.01 * math.cos(azimuth), 0.01 * math.sin(azimuth), -0.02]
    assert found[1].tolist() == pytest.approx(expected, abs=1e-12)
    near, far = (math.hypot(radius - s * 0.01, height + 0.02) for s in (1, -1))
    assert float(margin[1]) == pytest.approx((far - near) / 2, abs=1e-12)


def test_first_by_compares_key_after_key_among_the_allowed():
    keys = [torch.tensor([3.0, 1, 1, 0]), torch.tensor([0.0, 5, 4, 0])]
    index, margin = first_by(keys, torch.tensor([True, True, True, False]))
    assert (int(index), float(margin)) == (2, 0)
    index, margin = first_by(keys, torch.tensor([True, False, True, False]))
    assert (int(index), float(margin)) == (2, 2)
    index, margin = first_by(keys, torch.tensor([True, False, False, False]))
    assert (int(index), float(margin)) == (0, math.inf)


def test_the_default_choice_is_equation_1():
    assert KeypointChoice().rule is KeypointRule.CAMERA
    assert torch.equal(KeypointChoice().frame, EYE)


@settings(max_examples=30, deadline=None)
@given(st.tuples(*[st.floats(-10, 10)] * 3).filter(lambda d: math.hypot(*d) > 1e-3))
def test_the_frame_of_a_choice_is_a_rotation_with_the_direction_as_z(direction):
    frame = KeypointChoice(direction=direction).frame
    torch.testing.assert_close(frame @ frame.T, EYE, atol=1e-12, rtol=0)
    assert float(torch.linalg.det(frame)) == pytest.approx(1)
    along = torch.tensor(direction, dtype=torch.float64) / math.hypot(*direction)
    torch.testing.assert_close(frame[2], along, atol=1e-12, rtol=0)


@pytest.mark.parametrize(
    "direction", [(0.0, 0.0, 0.0), (0.0, 1.0), (math.nan, 0.0, 1.0), (0.0, math.inf, 1.0)]
)
def test_a_choice_without_a_direction_is_refused(direction):
    with pytest.raises(ValueError, match=r"targets.direction is \(.*expected three numbers"):
        KeypointChoice(direction=direction)


def test_an_oblique_choice_is_the_camera_rule_in_a_turned_camera(declare, rotations, sizes):
    chain, choice = declare("nut"), KeypointChoice(direction=(0.6, 0.0, 0.8))
    R, parameters = rotations(20), sizes(chain, 20)
    found, margin = chain.select(choice, parameters, R)
    expected, lead = chain.choose(
        NearestToCamera(choice.frame @ R), chain.keypoints_from_parameters(parameters)
    )
    assert torch.equal(found, expected) and torch.equal(margin, lead)
    along = (found @ R.mT) @ metres(0.6, 0.0, 0.8)
    for g in chain.group:
        opposite = (found[:, 0] @ g.T)[:, None] @ R.mT @ metres(0.6, 0.0, 0.8)
        assert (along[:, 0] <= opposite[:, 0] + 1e-12).all()


def test_turns_about_z_are_what_a_revolution_adds(declare):
    """The brute force above uses the primitives' own split of a step; here it is checked by hand."""
    keypoint = declare("lug").keypoints[2]
    along, radial = along_and_radial(keypoint.primitive, metres(3.0, 4.0, 5.0))
    assert along.tolist() == [0, 0, 5] and radial.tolist() == [3, 4, 0]
    turned = rotation_about_z(torch.tensor(math.pi / 2).double()) @ radial
    assert turned.tolist() == pytest.approx([-4, 3, 0])


def test_a_keypoint_bound_by_anothers_choice_is_no_surer_than_that():
    """C2: a tiny tilt exchanges both ends, and with them both sides."""
    keypoints = [Keypoint("end", "centroid", Plane("x"), "l"), Keypoint("side", "centroid", Plane("y"), "w")]
    chain = KeypointChain(keypoints, ["l", "w"], cyclic(2))
    tilt = torch.tensor([[1, 0, 1e-4], [0, 1, 0], [-1e-4, 0, 1]], dtype=torch.float64)
    _, margin = chain.choose(NearestToCamera(tilt), chain.keypoints_from_parameters(metres(0.02, 0.03)))
    assert margin.tolist() == pytest.approx([4e-6, 4e-6], rel=1e-6)
