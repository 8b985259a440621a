"""Keypoints from parameters and back, and what the chain tells the fit."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from pnet.geometry.rigid import apply_pose
from pnet.geometry.symmetry import RevolutionSymmetry, SphericalSymmetry, cyclic, dihedral, reflection
from pnet.parts.choice import KeypointChoice, KeypointRule, NearestToCamera, NearestToPoint
from pnet.parts.keypoints import KeypointChain
from pnet.parts.primitives import Circle, Corner, Cylinder, Plane, Sphere
from pnet.parts.selection import Keypoint

CHOICES = {
    "equation 1": KeypointChoice(),
    "oblique": KeypointChoice(direction=(0.4, -0.7, 0.5)),
    "canonical": KeypointChoice(KeypointRule.CANONICAL),
}
NUT = torch.tensor([0.004, 0.010, 0.012], dtype=torch.float64)


@pytest.fixture(params=CHOICES.values(), ids=CHOICES.keys())
def choice(request):
    return request.param


def random_points(n: int, seed: int = 3) -> torch.Tensor:
    return 0.02 * torch.randn(n, 3, generator=torch.Generator().manual_seed(seed)).double()


def test_parameters_come_back_from_the_labels_in_any_pose(chain, choice, rotations, sizes):
    parameters, R, t = sizes(chain, 50), rotations(50), random_points(50)
    labels, _ = chain.select(choice, parameters, R)
    found = chain.parameters_from_keypoints(t, apply_pose(R, t, labels))
    torch.testing.assert_close(found, parameters, atol=1e-12, rtol=0)


def test_parameters_come_back_from_the_labels_nearest_to_a_point(chain, sizes):
    parameters = sizes(chain, 50)
    labels, _ = chain.choose(NearestToPoint(random_points(50)), chain.keypoints_from_parameters(parameters))
    found = chain.parameters_from_keypoints(torch.zeros(50, 3).double(), labels)
    torch.testing.assert_close(found, parameters, atol=1e-12, rtol=0)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(1e-4, 1.0), min_size=3, max_size=3))
def test_any_positive_parameters_come_back(declare, values):
    parameters = torch.tensor(values, dtype=torch.float64)
    for name in ("nut", "wedge", "double cone", "lug"):
        chain = declare(name)
        found = chain.parameters_from_keypoints(
            torch.zeros(3).double(), chain.keypoints_from_parameters(parameters)
        )
        torch.testing.assert_close(found, parameters, atol=1e-12, rtol=1e-12)


def test_batch_dimensions_and_dtype_are_kept(chain, choice, rotations, sizes):
    parameters, R = sizes(chain, 6), rotations(6)
    k, m = parameters.shape[1], len(chain)
    single, lead = chain.select(choice, parameters.float().reshape(2, 3, k), R.float().reshape(2, 3, 3, 3))
    assert single.shape == (2, 3, m, 3) and lead.shape == (2, 3, m)
    assert single.dtype == lead.dtype == torch.float32
    for i in range(6):
        alone, margin = chain.select(choice, parameters[i], R[i])
        torch.testing.assert_close(single[i // 3, i % 3].double(), alone, atol=1e-7, rtol=0)
        torch.testing.assert_close(lead[i // 3, i % 3].double(), margin, atol=1e-7, rtol=0)


def test_points_of_one_instance_share_its_template(chain, sizes):
    """(4, m, 3) templates against (4, 5, 3) points, as the targets need them."""
    template, points = chain.keypoints_from_parameters(sizes(chain, 4)), random_points(20).reshape(4, 5, 3)
    found, margin = chain.choose(NearestToPoint(points), template[:, None].expand(-1, 5, -1, -1))
    assert found.shape == (4, 5, len(chain), 3)
    for i, j in np.ndindex(4, 5):
        alone, lead = chain.choose(NearestToPoint(points[i, j]), template[i])
        torch.testing.assert_close(found[i, j], alone)
        torch.testing.assert_close(margin[i, j], lead)


def test_the_mean_stands_where_several_keypoints_measure_one_parameter():
    keypoints = [
        Keypoint("face", "centroid", Plane("z"), "h", 0.5),
        Keypoint("rim", "face", Circle("z"), "r"),
        Keypoint("side", "centroid", Cylinder("z"), "r", 2.0),
    ]
    chain = KeypointChain(keypoints, ["r", "h"], RevolutionSymmetry(rotoreflection=True))
    assert chain.names == ["face", "side", "rim"]  # round by round of the selection
    observed = torch.tensor([[0, 0, 0.01], [0, 0.014, 0], [0.005, 0, 0.01]], dtype=torch.float64)
    found = chain.parameters_from_keypoints(torch.zeros(3).double(), observed)
    assert found.tolist() == pytest.approx([(0.005 + 0.014 / 2) / 2, 0.02])


def test_a_corner_stands_where_it_is_declared_less_the_centroid():
    keypoints = [
        Keypoint("corner", "centroid", Corner(("a / 2", 3, "-a"))),
        Keypoint("foot", "centroid", Plane("-y", at=1)),
        Keypoint("end", "centroid", Plane("x"), "a"),
        Keypoint("top", "centroid", Plane("z"), "a"),
    ]
    centroid = [0.001, 0.002, 0.003]
    chain = KeypointChain(keypoints, ["a"], cyclic(1), None, lambda p: np.tile(centroid, (len(p), 1)))
    corner, foot, _, _ = chain.keypoints_from_parameters(torch.tensor([[0.010], [0.020]]).double()).unbind(-2)
    assert corner.flatten().tolist() == pytest.approx([0.004, 0.001, -0.013, 0.009, 0.001, -0.023])
    assert foot.flatten().tolist() == pytest.approx([0, -0.003, 0] * 2)  # the plane y = -1 mm


def test_the_canonical_labels_are_the_template_with_no_runner_up(chain, rotations, sizes):
    parameters = sizes(chain, 4)
    labels, margin = chain.select(KeypointChoice(KeypointRule.CANONICAL), parameters, rotations(4))
    assert torch.equal(labels, chain.keypoints_from_parameters(parameters)) and bool(margin.isinf().all())


def test_the_point_rule_asks_for_points(declare, rotations):
    with pytest.raises(ValueError, match="the rule 'point' needs surface points"):
        declare("nut").select(KeypointChoice(KeypointRule.POINT), NUT, rotations(1)[0])


def test_finite_labels_are_the_template_turned_and_seen_through_one_chirality(chain, rotations, sizes):
    template = chain.keypoints_from_parameters(sizes(chain, 60))[:, chain.is_finite]
    labels, _ = chain.choose(
        NearestToCamera(rotations(60)), chain.keypoints_from_parameters(sizes(chain, 60))
    )
    turned = [
        template @ (g @ chirality).T
        for chirality in chain.chiralities
        for g in chain.group
        if torch.linalg.det(g) > 0
    ]
    gap = (torch.stack(turned) - labels[:, chain.is_finite]).flatten(2).norm(dim=-1)
    assert gap.amin(0).max() < 1e-12


@pytest.mark.parametrize(
    ("name", "count"),
    [("nut", 1), ("nut with mirror", 1), ("wedge", 2), ("lug", 1), ("antiprism with inversion", 1)],
)
def test_a_mirror_makes_a_second_structure_only_where_it_moves_the_keypoints(declare, name, count):
    """A nut's mirror does what its half turns do: its label keypoints lie in a mirror plane of the nut."""
    chiralities = declare(name).chiralities
    assert [round(float(torch.linalg.det(c))) for c in chiralities] == [1, -1][:count]


def test_both_structures_of_a_wedge_are_labels(declare, rotations, sizes):
    chain = declare("wedge")
    template = chain.keypoints_from_parameters(sizes(chain, 40))
    labels, _ = chain.choose(NearestToCamera(rotations(40)), template)
    sign = torch.linalg.det(labels[:, 1:]).sign() * torch.linalg.det(template[:, 1:]).sign()
    assert set(sign.tolist()) == {1.0, -1.0}


def test_placing_like_an_observation_keeps_free_keypoints_and_resets_finite_ones(declare, rotations, sizes):
    chain = declare("nut")
    parameters, R = sizes(chain, 40), rotations(40)
    observed, _ = chain.choose(NearestToCamera(R), chain.keypoints_from_parameters(parameters))
    canonical = chain.keypoints_from_parameters(parameters)
    placed = chain.place_like(canonical, observed)
    torch.testing.assert_close(placed[:, [0, 2]], canonical[:, [0, 2]])
    torch.testing.assert_close(placed[:, 1, :2], observed[:, 1, :2])
    torch.testing.assert_close(placed[:, 1, 2], canonical[:, 1, 2])


def test_placing_like_exact_template_keypoints_gives_them_back(chain, sizes):
    parameters = sizes(chain, 10)
    canonical = chain.keypoints_from_parameters(parameters)
    torch.testing.assert_close(chain.place_like(canonical, canonical), canonical)


def test_placing_uses_the_templates_distances_not_the_observed_ones(chain, sizes):
    parameters = sizes(chain, 10)
    canonical = chain.keypoints_from_parameters(parameters)
    placed = chain.place_like(canonical, chain.keypoints_from_parameters(1.2 * parameters))
    torch.testing.assert_close(placed, canonical)


def test_a_free_keypoint_observed_on_its_axis_stays_where_the_template_has_it(declare):
    observed = torch.tensor([[0, 0, -0.02], [0, 0, -0.02]], dtype=torch.float64)
    flange = declare("flange")
    template = flange.keypoints_from_parameters(torch.tensor([0.01, 0.02]).double())
    placed = flange.place_like(template, observed)
    assert placed.flatten().tolist() == pytest.approx([0, 0, -0.02, 0.01, 0, -0.02])


def test_turning_back_undoes_every_free_choice(chain, rotations, sizes):
    """Labels turned back are, step by step, the template's steps under one symmetry's fixed share."""
    template = chain.keypoints_from_parameters(sizes(chain, 30))
    labels, _ = chain.choose(NearestToCamera(rotations(30)), template)
    back = chain.turn_back(labels)
    torch.testing.assert_close(chain.turn_back(back), back, atol=1e-15, rtol=1e-9)
    torch.testing.assert_close(chain.steps(back).norm(dim=-1), chain.steps(template).norm(dim=-1))
    torch.testing.assert_close(chain.turn_back(template), template, atol=1e-15, rtol=1e-9)
    if chain.names in (["end", "rim"], ["skin"]):  # nothing but the free choice was made
        torch.testing.assert_close(back, template, atol=1e-15, rtol=1e-9)


def test_turning_back_keeps_a_nuts_side_and_vertex(declare):
    labels = torch.tensor(
        [[0, 0, -0.005], [-0.0024, 0.0032, -0.005], [-0.012, 0, -0.005]], dtype=torch.float64
    )
    back = declare("nut").turn_back(labels)
    assert torch.equal(back[[0, 2]], labels[[0, 2]])
    assert back[1].tolist() == pytest.approx([0.004, 0, -0.005])


def test_a_keypoint_on_a_circle_is_not_finite_nor_is_one_that_hangs_on_it(declare):
    chain = declare("lug")
    assert dict(zip(chain.names, chain.is_finite, strict=True)) == {
        "lid": True,
        "eye": True,
        "rim": False,
        "floor": False,
    }


def test_a_sphere_has_one_keypoint_and_one_parameter(rotations):
    chain = KeypointChain([Keypoint("skin", "centroid", Sphere(), "r")], ["r"], SphericalSymmetry())
    R = rotations(5)
    labels, margin = chain.choose(
        NearestToCamera(R), chain.keypoints_from_parameters(torch.full((5, 1), 0.01).double())
    )
    torch.testing.assert_close((labels @ R.mT)[:, 0], torch.tensor([[0, 0, -0.01]]).double().expand(5, 3))
    torch.testing.assert_close(margin, torch.full((5, 1), 0.01).double())


def test_a_mirror_that_fits_no_symmetry_is_refused(declare):
    with pytest.raises(ValueError, match="not a group together"):
        KeypointChain(declare("nut").keypoints, "rhd", dihedral(6), reflection((1, 0.2, 0)))
    with pytest.raises(ValueError, match="leave it out"):
        KeypointChain(declare("flange").keypoints, "rh", RevolutionSymmetry(), reflection((1, 0, 0)))
