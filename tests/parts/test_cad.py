"""A CAD mesh with bounding primitives as a part of fixed size."""

import math
import sys

import numpy as np
import pytest
import torch
import trimesh

from pnet.parts.cad import CadPart, read_mesh


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """A 20 × 30 × 40 cuboid beside the origin, a cylinder and a sphere, a cuboid with a gap."""
    folder = tmp_path_factory.mktemp("meshes")
    cuboid = trimesh.creation.box([20, 30, 40]).apply_translation([5, -5, 100])
    cuboid.export(folder / "cuboid.stl")
    trimesh.creation.cylinder(radius=10, height=30, sections=48).apply_translation([0, 0, 7]).export(
        folder / "rod.ply"
    )
    trimesh.creation.icosphere(subdivisions=3, radius=8).apply_translation([1, 2, 3]).export(
        folder / "ball.obj"
    )
    trimesh.Trimesh(cuboid.vertices, cuboid.faces[1:]).export(folder / "gap.stl")
    trimesh.Trimesh(cuboid.vertices, cuboid.faces[:, ::-1]).export(folder / "inverted.off")
    (folder / "broken.stl").write_bytes(b"nonsense")
    return folder


def test_a_cuboids_sizes_are_its_parameters(meshes, rotations):
    part = CadPart("fitting", str(meshes / "cuboid.stl"))
    assert part.is_fixed and part.parameter_names == ("l", "w", "h")
    np.testing.assert_allclose(part.grids["L"], [[0.020, 0.030, 0.040]], rtol=1e-6)
    size = part.part_object("L", 0)
    mesh = part.mesh(size)
    assert 1e9 * mesh.volume == pytest.approx(24_000, rel=1e-6)
    assert np.abs(mesh.center_mass).max() < 1e-9
    corner, *ends = part.chain.keypoints_from_parameters(torch.from_numpy(size))
    torch.testing.assert_close(corner, torch.tensor([-0.010, -0.015, -0.020]).double(), atol=1e-7, rtol=0)
    for axis, end in enumerate(ends):
        expected = [-0.010, -0.015, -0.020]
        expected[axis] *= -1
        assert end.tolist() == pytest.approx(expected, abs=1e-7)


def test_a_turned_cylinders_sizes_are_its_parameters(meshes):
    part = CadPart("rod", str(meshes / "rod.ply"), bounds="cylinder", symmetry="revolution")
    sizes = dict(zip(part.parameter_names, part.part_object("L", 0).tolist(), strict=True))
    assert sizes == pytest.approx({"h": 0.030, "r": 0.010}, rel=1e-5)
    base, top, rim = part.chain.keypoints_from_parameters(torch.from_numpy(part.part_object("L", 0)))
    assert base.tolist() == pytest.approx([0, 0, -0.015], abs=1e-7)
    assert top.tolist() == pytest.approx([0, 0, 0.015], abs=1e-7)
    assert math.hypot(*rim[:2].tolist()) == pytest.approx(0.010, rel=1e-5) and rim[2] == base[2]


def test_a_spheres_radius_is_its_parameter(meshes):
    part = CadPart("ball", str(meshes / "ball.obj"), bounds="sphere", symmetry="sphere")
    assert part.part_object("L", 0).tolist() == pytest.approx([0.008], rel=1e-5)


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1e-3), ("cm", 1e-2), ("m", 1.0), ("inch", 0.0254)])
def test_units(meshes, unit, factor):
    extents = read_mesh(meshes / "cuboid.stl", unit).extents
    np.testing.assert_allclose(extents, np.array([20, 30, 40]) * factor, rtol=1e-6)


def test_a_mesh_wound_inwards_is_turned_outwards(meshes):
    assert read_mesh(meshes / "inverted.off", "mm").volume == pytest.approx(24e-6, rel=1e-6)


def test_keypoints_of_ones_own(meshes):
    keypoints = {
        "floor": {"from": "centroid", "plane": "-z", "at": -80},
        "top": {"from": "floor", "plane": "z", "measures": "h"},
        "side": {"from": "floor", "plane": "x", "measures": "l", "factor": 0.5},
    }
    path = str(meshes / "cuboid.stl")
    part = CadPart("own", path, symmetry={"cyclic": 2}, keypoints=keypoints, sizes={"h": 40, "l": 20})
    assert part.part_object("L", 0).tolist() == [0.040, 0.020]
    floor, top, side = part.chain.keypoints_from_parameters(torch.from_numpy(part.part_object("L", 0)))
    assert floor.tolist() == pytest.approx([0, 0, -0.020], abs=1e-7)
    assert top.tolist() == pytest.approx([0, 0, 0.020], abs=1e-7)
    assert side.tolist() == pytest.approx([0.010, 0, -0.020], abs=1e-7)
    with pytest.raises(ValueError, match="own: give sizes: with the value in mm of every parameter"):
        CadPart("own", path, keypoints=keypoints)


def test_lookalikes_of_its_keypoints(meshes):
    """An end for an end, of the bounding cuboid's keypoints."""
    path = str(meshes / "cuboid.stl")
    part = CadPart("fitting", path, lookalikes=[[["corner", "z_end"]]])
    assert part.chain.names == ["corner", "x_end", "y_end", "z_end"]
    assert part.chain.lookalikes.tolist() == [[0, 1, 2, 3], [3, 1, 2, 0]]
    assert CadPart("fitting", path).chain.lookalikes.tolist() == [[0, 1, 2, 3]]


@pytest.mark.parametrize(
    ("lookalikes", "message"),
    [
        ([["corner", "z_end"]], r"fitting: lookalikes\[0\]\[0\] is 'corner', expected a pair of keypoints"),
        ([[["corner", "foot"]]], "fitting: lookalikes exchange 'foot', which is none of the keypoints"),
    ],
)
def test_bad_lookalikes_are_named(meshes, lookalikes, message):
    with pytest.raises(ValueError, match=message):
        CadPart("fitting", str(meshes / "cuboid.stl"), lookalikes=lookalikes)


def test_the_hull_stands_for_the_mesh_in_physics(meshes):
    part = CadPart("fitting", str(meshes / "cuboid.stl"))
    (piece,) = part.convex_pieces(part.part_object("L", 0), fill_holes=True)
    assert len(piece) == 8
    np.testing.assert_allclose(piece.max(0), [0.010, 0.015, 0.020], atol=1e-7)


def test_a_missing_package_is_named_when_its_pieces_are_asked_for(meshes, monkeypatch):
    part = CadPart("fitting", str(meshes / "cuboid.stl"), collision="coacd")
    monkeypatch.setitem(sys.modules, "coacd", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'pnet\[cad\]', or collision=hull"):
        part.convex_pieces(part.part_object("L", 0), fill_holes=False)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gap.stl", "gap.stl: the mesh is not watertight"),
        ("broken.stl", "broken.stl: (not readable as a mesh|holds no triangles)"),
        ("cuboid.step", r"cuboid.step: ends in .step, expected one of .stl"),
        ("none", "none: ends in nothing, expected one of .stl"),
    ],
)
def test_a_file_that_is_no_closed_mesh_is_named(meshes, name, message):
    with pytest.raises(ValueError, match=message):
        read_mesh(meshes / name, "mm")


def test_a_missing_file_and_an_unknown_unit_are_named(meshes):
    with pytest.raises(FileNotFoundError, match=r"gone\.stl: no such file; give the mesh's path"):
        read_mesh(meshes / "gone.stl", "mm")
    with pytest.raises(ValueError, match="unit is 'ft', choose mm, cm, m, inch"):
        read_mesh(meshes / "cuboid.stl", "ft")


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ({"bounds": "cone"}, "bounds is 'cone', choose cuboid, cylinder or sphere"),
        ({"symmetry": "revolution"}, "bounds is 'cuboid', but the symmetry asks for 'cylinder'"),
        ({"bounds": "cylinder", "symmetry": "revolution"}, "lies .* mm off its z axis"),
        ({"collision": "boxes"}, "collision is 'boxes', choose hull or coacd"),
        ({"symmetry": "round"}, "symmetry is 'round', choose"),
    ],
)
def test_bounds_that_do_not_fit_are_refused(meshes, choices, message):
    with pytest.raises(ValueError, match=message):
        CadPart("fitting", str(meshes / "cuboid.stl"), **choices)
