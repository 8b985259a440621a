"""BOP's models_info.json: every symmetry that it names is one, sizes and diameters are the mesh's."""

import json
from itertools import product

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from pnet.data.export.bop_models import add_model, model_sizes, model_symmetries
from pnet.data.export.object_scenes import object_scenes
from pnet.geometry.symmetry import RevolutionSymmetry, SphericalSymmetry, cyclic
from pnet.parts.base import ParametricPart
from pnet.parts.primitives import Plane
from pnet.parts.selection import Keypoint
from pnet.parts.solids import cylinder
from pnet.parts.tless20 import TLess20
from pnet.parts.tn06 import TN06
from pnet.parts.tn34 import TN34


class Disc(ParametricPart):
    """Both ends alike."""

    name = "disc"
    parameter_names = ("h",)
    symmetry = RevolutionSymmetry(rotoreflection=True)
    keypoints = (Keypoint("face", "centroid", Plane("z"), "h", factor=0.5),)

    def solid(self, parameters):
        (h,) = self.split(parameters)
        return cylinder(0.01 + 0 * h, -h / 2, h / 2)


SECTIONS = 96
PARTS = {
    "dihedral": TN06({"r": [5], "h": [7], "d": [12]}, sections=SECTIONS),
    "revolution": TN34({"r": [15], "h": [12]}, sections=SECTIONS),
    "equal ends": Disc({"h": [12]}, sections=SECTIONS),
    "cyclic": TLess20({"l": [30], "w": [20], "b": [10], "r": [9], "h": [20]}, sections=SECTIONS),
}


def distance_to_surface(points, mesh):
    """(n,) distance of points to the nearest triangle, by the closest of plane, edges and corners."""
    a, b, c = (corner[None] for corner in mesh.triangles.swapaxes(0, 1))
    p = points[:, None]
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    inside = np.ones(np.broadcast_shapes(p.shape, a.shape)[:2], bool)
    nearest = np.full(inside.shape, np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        edge = end - start
        inside &= (np.cross(edge, p - start) * normal).sum(-1) >= 0
        along = np.clip(((p - start) * edge).sum(-1) / (edge * edge).sum(-1), 0, 1)
        nearest = np.minimum(nearest, np.linalg.norm(p - start - along[..., None] * edge, axis=-1))
    plane = np.abs(((p - a) * normal).sum(-1))
    return np.where(inside, plane, nearest).min(1)


def motions_of(entry):
    """Discrete symmetries and turns by some angles about the continuous ones, as 4 x 4 matrices; mm."""
    discrete = [np.eye(4), *np.reshape(entry.get("symmetries_discrete", []), (-1, 4, 4))]
    turns = [np.eye(4)]
    for one in entry.get("symmetries_continuous", []):
        for angle in (0.1, 1.0, 2.5, 4.0):
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec(angle * np.array(one["axis"])).as_matrix()
            turn[:3, 3] = np.array(one["offset"]) - turn[:3, :3] @ one["offset"]
            turns.append(turn)
    return [turn @ motion for turn, motion in product(turns, discrete)]


@pytest.fixture(scope="module")
def written(make_set, tmp_path_factory):
    """Name → entry of models_info.json and mesh, as files hold them."""

    def write(part):
        folder = tmp_path_factory.mktemp("models")
        (shown,) = object_scenes(make_set(part, drops=(1,)), part)
        add_model(folder, 1, shown)
        entry = json.loads((folder / "models_info.json").read_text())["1"]
        return entry, trimesh.load(folder / "obj_000001.ply")

    return {name: write(part) for name, part in PARTS.items()}


@pytest.mark.parametrize(
    ("name", "discrete", "axes"),
    [("dihedral", 11, 0), ("revolution", 0, 1), ("equal ends", 1, 1), ("cyclic", 1, 0)],
)
def test_every_named_symmetry_maps_the_mesh_onto_itself(written, name, discrete, axes):
    entry, mesh = written[name]
    assert len(entry.get("symmetries_discrete", [])) == discrete
    assert len(entry.get("symmetries_continuous", [])) == axes
    samples = mesh.sample(150, seed=0)
    assert distance_to_surface(samples, mesh).max() < 1e-5
    # the flats of a polygon lie so much within its circle; single precision in the file
    radius = np.linalg.norm(mesh.vertices[:, :2], axis=1).max()
    limit = 1e-5 + (radius * (1 - np.cos(np.pi / SECTIONS)) if axes else 0)
    motions = motions_of(entry)
    assert len(motions) == (discrete + 1) * (1 + 4 * axes)
    for motion in motions:
        assert np.linalg.det(motion[:3, :3]) == pytest.approx(1)
        moved = samples @ motion[:3, :3].T + motion[:3, 3]
        assert distance_to_surface(moved, mesh).max() < limit
    # half a millimetre along z, or a turn that is not named, would have been noticed
    assert distance_to_surface(np.add(samples, (0, 0, 0.5)), mesh).max() > 0.4


def test_discrete_symmetries_are_the_group_without_the_identity():
    found = np.reshape(model_symmetries(PARTS["dihedral"].symmetry)["symmetries_discrete"], (-1, 4, 4))
    assert np.abs(found - np.eye(4)).max((1, 2)).min() > 0.1
    group = np.concatenate([np.eye(4)[None], found])
    products = (group[:, None] @ group[None]).reshape(-1, 16)
    assert cdist(products, group.reshape(-1, 16)).min(1).max() < 1e-9
    assert cdist(group.reshape(-1, 16), products).min(1).max() < 1e-9
    assert "symmetries_discrete" not in model_symmetries(cyclic(1)) and model_symmetries(cyclic(1)) == {}


def test_a_sphere_has_three_continuous_axes():
    entry = model_symmetries(SphericalSymmetry())
    assert entry == {
        "symmetries_continuous": [{"axis": a, "offset": [0, 0, 0]} for a in ([1, 0, 0], [0, 1, 0], [0, 0, 1])]
    }
    ball = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    samples = ball.sample(100, seed=0)
    for motion in motions_of(entry):
        # the flats of the icosphere lie within 0.06 mm of the sphere
        assert distance_to_surface(samples @ motion[:3, :3].T, ball).max() < 0.06


@pytest.mark.parametrize("name", list(PARTS))
def test_sizes_are_those_of_the_mesh_in_millimetres(written, name):
    entry, mesh = written[name]
    assert entry["diameter"] == pytest.approx(cdist(mesh.vertices, mesh.vertices).max(), rel=1e-6)
    for axis, column in zip("xyz", mesh.vertices.T, strict=True):
        assert entry[f"min_{axis}"] == pytest.approx(column.min(), abs=1e-5)
        assert entry[f"size_{axis}"] == pytest.approx(np.ptp(column), rel=1e-6)
    part = PARTS[name]
    own = part.mesh(part.part_object("L", 0))
    np.testing.assert_allclose(mesh.triangles, 1000 * own.triangles, atol=5e-6)
    assert mesh.is_watertight
    assert entry["parameters"] == pytest.approx(
        dict(zip(part.parameter_names, 1000 * part.part_object("L", 0), strict=True))
    )


def test_the_diameter_of_a_box_is_its_diagonal():
    sizes = model_sizes(trimesh.creation.box((3.0, 4.0, 12.0)))
    assert sizes["diameter"] == pytest.approx(13)
    assert [sizes[f"min_{a}"] for a in "xyz"] == [-1.5, -2, -6]
    assert [sizes[f"size_{a}"] for a in "xyz"] == [3, 4, 12]


@pytest.mark.parametrize("content", ["[1]", '{"one": {}}'])
def test_a_file_that_is_none_is_refused(make_set, tmp_path, content):
    (tmp_path / "models_info.json").write_text(content)
    (shown,) = object_scenes(make_set(PARTS["cyclic"], drops=(1,)), PARTS["cyclic"])
    with pytest.raises(ValueError, match=r"models_info\.json: expected an object with a number for each"):
        add_model(tmp_path, 1, shown)
