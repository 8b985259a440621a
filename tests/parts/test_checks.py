"""The checks of `pnet-part`: sound parts pass them all, a wrong one fails the right one."""

import numpy as np
import pytest
import torch

from pnet.geometry.symmetry import cyclic
from pnet.parts.checks import check_part, random_instances, round_trip_error
from pnet.parts.solids import box
from pnet.parts.tn42 import TN42

GRID = {"l": [30, 48], "a": [10, 19], "w": [8, 17]}


def failed(part) -> list[str]:
    return [check.name for check in check_part(part, samples=50) if not check.passed]


def test_a_sound_part_passes_every_check(tn06, tn34):
    for part in (tn06, tn34, TN42(GRID)):
        assert failed(part) == []
        assert len(list(check_part(part, samples=5))) == 6


def test_a_symmetry_that_the_solid_does_not_have_is_found():
    class Wrong(TN42):
        mirror = None
        symmetry = cyclic(2)

    assert failed(Wrong(GRID)) == ["symmetry carries the solid onto itself"]


def test_pieces_that_miss_the_solid_are_found():
    class Wrong(TN42):
        def convex_pieces(self, parameters, fill_holes):
            return [0.99 * piece for piece in super().convex_pieces(parameters, fill_holes)]

    assert failed(Wrong(GRID)) == ["convex pieces make up the solid"]


def test_a_mesh_off_its_centroid_is_found():
    class Wrong(TN42):
        def mesh(self, parameters):
            return super().mesh(parameters).apply_translation([1e-6, 0, 0])

    assert "volume centroid is the origin" in failed(Wrong(GRID))


def test_an_open_mesh_is_found():
    class Wrong(TN42):
        def mesh(self, parameters):
            mesh = super().mesh(parameters)
            mesh.update_faces(np.arange(len(mesh.faces)) > 0)
            return mesh

    assert "mesh is watertight, faces wound outwards" in failed(Wrong(GRID))


def test_random_instances_are_valid_and_seeded(tn06):
    parameters, R, t = random_instances(tn06, 200, seed=3)
    assert parameters.shape == (200, 3) and R.shape == (200, 3, 3) and t.shape == (200, 3)
    for row in parameters.numpy():
        tn06.check_named(row)
    values = np.concatenate(list(tn06.grids.values()))
    assert (parameters.numpy() >= values.min(0)).all() and (parameters.numpy() <= values.max(0)).all()
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double().expand(200, 3, 3))
    again = random_instances(tn06, 200, seed=3)
    assert all(torch.equal(a, b) for a, b in zip((parameters, R, t), again, strict=True))
    assert not torch.equal(random_instances(tn06, 200, seed=4)[1], R)


def test_the_round_trip_error_is_that_of_rounding(tn06):
    assert round_trip_error(tn06, *random_instances(tn06, 100, seed=0)) < 1e-14


def test_no_valid_size_between_the_grids_ends_is_said():
    class Never(TN42):
        def check(self, parameters):
            if hasattr(self, "chain"):
                raise ValueError("never")

        def solid(self, parameters):
            length, a, w = self.split(parameters)
            return box((0 * a, length), (-w / 2, w / 2), (0 * a, a))

    with pytest.raises(ValueError, match="tn42: no valid parameters between the grids' ends"):
        random_instances(Never(GRID), 10, seed=0)


def test_a_rotation_symmetry_that_is_not_declared_is_pointed_out():
    class Plain(TN42):
        symmetry = cyclic(1)

        def solid(self, parameters):
            length, a, w = self.split(parameters)
            return box((0, length), (-w / 2, w / 2), (0, a))

    notes = [check for check in check_part(Plain(GRID), samples=5) if check.is_advice]
    assert [check.passed for check in notes] == [False]
    assert notes[0].detail == "1/2 turn about x, 1/2 turn about y, 1/2 turn about z also fits"
