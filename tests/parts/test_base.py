"""What every template promises, and the constants of its pose distance."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from omegaconf import OmegaConf

from pnet.cli.instantiate import instantiate
from pnet.geometry.symmetry import FiniteSymmetry, RevolutionSymmetry
from pnet.parts.base import ParametricPart
from pnet.parts.choice import NearestToCamera
from pnet.parts.solids import Operation, Solid, solid
from pnet.parts.tn06 import TN06
from pnet.parts.tn34 import TN34

GRID_06 = {"r": [2.5, 7], "h": [8], "d": [12]}
GRID_34 = {"r": [12], "h": [10, 13, 16]}
TEMPLATES = sorted((Path(__file__).parents[2] / "conf" / "part").glob("*.yaml"))


@pytest.fixture(scope="module", params=TEMPLATES, ids=lambda path: path.stem)
def part(request) -> ParametricPart:
    """Every template that has a config."""
    made = instantiate(OmegaConf.load(request.param))
    assert made.name == request.param.stem
    return made


def some_objects(part) -> list[np.ndarray]:
    """The corners of every grid, metres."""
    return [grid[i] for grid in part.grids.values() for i in sorted({0, len(grid) // 3, len(grid) - 1})]


def common_volume(one: trimesh.Trimesh, other: trimesh.Trimesh) -> float:
    return trimesh.boolean.intersection([one, other], engine="manifold").volume


def hulls_of(pieces) -> list[trimesh.Trimesh]:
    """In millimetres: the boolean's precision is absolute."""
    return [trimesh.convex.convex_hull(1000 * piece) for piece in pieces]


def test_meshes_are_closed_wound_outwards_and_in_one_piece(part):
    for parameters in some_objects(part):
        mesh = part.mesh(parameters)
        assert mesh.is_watertight and mesh.is_winding_consistent
        assert mesh.volume > 0 and mesh.body_count == 1
        holes = any(operation is Operation.HOLE for operation, _ in solid(part.solid(parameters)).steps)
        assert mesh.euler_number == (0 if holes else 2)


def test_the_volume_centroid_is_the_origin(part):
    for parameters in some_objects(part):
        assert np.abs(part.mesh(parameters).center_mass).max() < 1e-9


def test_the_centroid_is_the_same_for_many_objects_and_for_one(part):
    grid = part.grids["L"]
    centroids = part.centroid(grid)
    assert centroids.shape == (len(grid), 3)
    for i in sorted({0, len(grid) // 2, len(grid) - 1}):
        mesh = solid(part.solid(grid[i])).mesh(part.sections)
        np.testing.assert_allclose(centroids[i], mesh.center_mass, atol=1e-9)
        np.testing.assert_allclose(part.centroid(grid[i : i + 1])[0], centroids[i], atol=1e-15)


def test_exact_convex_pieces_unite_to_the_solid(part):
    for parameters in some_objects(part)[::2]:
        hulls = hulls_of(part.convex_pieces(parameters, fill_holes=False))
        volume = 1e9 * part.mesh(parameters).volume
        assert trimesh.boolean.union(hulls, engine="manifold").volume == pytest.approx(volume, rel=1e-4)
        assert sum(hull.volume for hull in hulls) == pytest.approx(volume, rel=1e-4)


def test_filled_convex_pieces_leave_out_the_holes_alone(part):
    for parameters in some_objects(part)[::2]:
        steps = solid(part.solid(parameters)).steps
        filled = Solid(tuple(step for step in steps if step[0] is not Operation.HOLE)).mesh(part.sections)
        pieces = part.convex_pieces(parameters, fill_holes=True)
        union = trimesh.boolean.union(hulls_of(pieces), engine="manifold")
        assert union.volume == pytest.approx(1e9 * filled.volume, rel=1e-4)
        np.testing.assert_allclose(union.bounds, 1000 * part.mesh(parameters).bounds, atol=1e-4)
        assert len(pieces) <= len(steps)


def test_the_symmetry_carries_the_solid_onto_itself(part):
    elements = part.chain.group.numpy()
    if isinstance(part.symmetry, RevolutionSymmetry):
        c, s = math.cos(2 * math.pi / part.sections), math.sin(2 * math.pi / part.sections)
        elements = np.concatenate([elements, [[[c, -s, 0], [s, c, 0], [0, 0, 1]]]])
    mesh = part.mesh(part.part_object("L", 0)).apply_scale(1000)
    for element in elements:
        matrix = np.eye(4)
        matrix[:3, :3] = element
        moved_mesh = mesh.copy().apply_transform(matrix)
        assert common_volume(mesh, moved_mesh) == pytest.approx(mesh.volume, rel=1e-4)


def test_every_half_turn_and_mirror_of_the_solid_is_declared(part):
    """A mirror may also do to the finite keypoints what a declared element does: then it adds nothing."""
    mesh = part.mesh(part.part_object("L", 0)).apply_scale(1000)
    template = part.chain.keypoints_from_parameters(torch.from_numpy(part.part_object("L", 0)))[
        part.chain.is_finite
    ]
    for signs in ((1, -1, -1), (-1, 1, -1), (-1, -1, 1), (-1, 1, 1), (1, -1, 1), (1, 1, -1)):
        moved = mesh.copy().apply_transform(np.diag([*signs, 1.0]))
        fits = common_volume(mesh, moved) > 0.999 * mesh.volume
        element = torch.diag(torch.tensor(signs, dtype=torch.float64))
        group = part.chain.group
        if math.prod(signs) > 0 and isinstance(part.symmetry, FiniteSymmetry):
            assert fits == bool((group - element).abs().amax((-1, -2)).min() < 1e-9)
        elif fits:
            assert (template @ group.mT - template @ element).abs().amax((-1, -2)).min() < 1e-9


def test_parameters_come_back_from_the_labels_of_every_part_object(part, rotations):
    for grid in part.grids.values():
        parameters, R = torch.from_numpy(grid), rotations(len(grid))
        labels, margin = part.chain.choose(
            NearestToCamera(R), part.chain.keypoints_from_parameters(parameters)
        )
        found = part.chain.parameters_from_keypoints(torch.zeros(len(grid), 3).double(), labels)
        torch.testing.assert_close(found, parameters, atol=1e-12, rtol=0)
        assert (margin >= 0).all()


def test_keypoints_lie_in_the_solids_bounds(part):
    for parameters in some_objects(part):
        keypoints = part.chain.keypoints_from_parameters(torch.from_numpy(parameters)).numpy()
        low, high = part.mesh(parameters).bounds
        assert (keypoints > low - 1e-9).all() and (keypoints < high + 1e-9).all()


def test_equivalent_poses_have_no_distance(part):
    space = part.pose_space(part.part_object("L", 0))
    G = part.symmetry.rotations if isinstance(part.symmetry, FiniteSymmetry) else part.chain.group
    eye, zero = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    distance = space.distance(eye, zero, G, zero.expand(len(G), 3))
    assert float(distance.max()) < 1e-6
    shifted = space.distance(eye, zero, G, torch.tensor([0.003, 0, 0.004]).double().expand(len(G), 3))
    torch.testing.assert_close(shifted, torch.full((len(G),), 0.005).double(), atol=1e-6, rtol=0)


def test_the_learning_and_generalization_grids_share_no_part_object(part):
    sets = [{tuple(p) for p in grid} for grid in part.grids.values()]
    assert [len(s) for s in sets] == [len(grid) for grid in part.grids.values()]
    assert not set.intersection(*sets) or len(sets) == 1


def test_the_first_parameter_runs_fastest_in_the_grid():
    part = TN34(GRID_34, {"r": [1, 2], "h": [3, 4]})
    expected = [[0.001, 0.003], [0.002, 0.003], [0.001, 0.004], [0.002, 0.004]]
    np.testing.assert_allclose(part.grids["G"], expected)
    np.testing.assert_allclose(part.part_object("G", 1), [0.002, 0.003])


@pytest.mark.parametrize("index", [-1, 3, 100])
def test_a_part_object_outside_the_grid_is_refused(index):
    part = TN34(GRID_34, GRID_34)
    with pytest.raises(ValueError, match=rf"tn34 has no part object {index} in grid L: choose 0 to 2"):
        part.part_object("L", index)


def test_an_unknown_grid_is_refused():
    with pytest.raises(ValueError, match=r"tn34 has no grid 'train': choose L or G"):
        TN34(GRID_34, GRID_34).part_object("train", 0)


@pytest.mark.parametrize("bad", [0.0, -3.0, math.nan, math.inf])
def test_a_grid_value_that_is_not_positive_and_finite_is_refused(bad):
    with pytest.raises(ValueError, match=rf"tn34: parameters must be positive, got .*h = {bad:g} mm"):
        TN34({"r": [12], "h": [10, bad]}, GRID_34)


@pytest.mark.parametrize("grid", [{"r": [12]}, {"r": [12], "x": [1]}, {**GRID_34, "d": [3]}])
def test_a_grid_that_names_other_parameters_is_refused(grid):
    with pytest.raises(ValueError, match=r"part.generalization names .*tn34 has \['h', 'r'\]"):
        TN34(GRID_34, grid)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_the_wrong_number_of_parameters_is_refused(count):
    part = TN34(GRID_34, GRID_34)
    with pytest.raises(ValueError, match=r"tn34 takes parameters \('r', 'h'\), got \[.*\]"):
        part.check_named(np.full(count, 0.01))


@pytest.mark.parametrize("sections", [0, 4, 50, -6])
def test_sections_that_are_no_multiple_of_six_are_refused(sections):
    with pytest.raises(ValueError, match=f"tn06: sections is {sections}, expected a multiple of 6"):
        TN06(GRID_06, GRID_06, sections)


def test_parameters_read_in_millimetres(tn06):
    assert tn06.text(np.array([0.0025, 0.008, 0.012])) == "r = 2.5 mm, h = 8 mm, d = 12 mm"
