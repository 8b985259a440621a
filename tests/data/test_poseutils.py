"""The benchmark's poseutils.json."""

import json
import math
import re

import pytest
import roma
import torch

from pnet.data.poseutils import read_poseutils, write_poseutils
from pnet.geometry.pose_space import PoseSpace
from pnet.geometry.symmetry import (
    FiniteSymmetry,
    RevolutionSymmetry,
    SphericalSymmetry,
    dihedral,
)

FINITE = {
    "type": "AffinePoseUtils",
    "Lambda": [[1.0, 0, 0], [0, 2.0, 0], [0, 0, 3.0]],
    "G": [[[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]],
    "Rref2i": [[0, 1, 0], [0, 0, 1], [1, 0, 0]],
    "tref2i": [0.1, 0.2, 0.3],
    "distance_threshold": 0.01,
}
REVOLUTION = {
    "type": "RevolutionPoseUtils",
    "lambda": 0.02,
    "rotoreflection_symmetry": True,
    "distance_threshold": 0.01,
}
SPHERE = {"type": "SphericalPoseUtils", "distance_threshold": 0.01}


@pytest.fixture(autouse=True)
def seed():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        yield


def write(folder, fields):
    path = folder / "poseutils.json"
    path.write_text(json.dumps(fields))
    return path


def test_reads_a_finite_symmetry(tmp_path):
    space = read_poseutils(write(tmp_path, FINITE))
    assert isinstance(space.symmetry, FiniteSymmetry)
    assert space.symmetry.rotations.tolist() == FINITE["G"]
    assert space.scale.tolist() == FINITE["Lambda"]
    assert space.frame_R.tolist() == FINITE["Rref2i"]
    assert space.frame_t.tolist() == FINITE["tref2i"]
    assert space.distance_threshold == 0.01
    # x_inertial = 0 at the centre: R c = -t
    torch.testing.assert_close(space.centre, torch.tensor([-0.3, -0.1, -0.2]).double())


def test_reads_a_revolution_and_a_sphere_without_a_frame(tmp_path):
    revolution = read_poseutils(write(tmp_path, REVOLUTION))
    assert revolution.symmetry == RevolutionSymmetry(rotoreflection=True)
    assert float(revolution.scale) == 0.02
    sphere = read_poseutils(write(tmp_path, SPHERE))
    assert sphere.symmetry == SphericalSymmetry()
    for space in (revolution, sphere):
        assert space.frame_R.tolist() == torch.eye(3).tolist()
        assert space.frame_t.tolist() == [0, 0, 0]


def test_the_identity_comes_first_whatever_the_files_order(tmp_path):
    space = read_poseutils(write(tmp_path, FINITE | {"G": FINITE["G"][::-1]}))
    assert space.symmetry.rotations.tolist() == FINITE["G"]


def test_representatives_are_r_g_lambda_in_the_inertial_frame(tmp_path):
    space = read_poseutils(write(tmp_path, FINITE))
    R, t = roma.random_rotmat().double(), torch.rand(3).double()
    first, second = space.representatives(R, t)
    inertial = R @ torch.tensor(FINITE["Rref2i"]).double().T
    scale, half_turn = (torch.tensor(m).double() for m in (FINITE["Lambda"], FINITE["G"][1]))
    torch.testing.assert_close(first[:9], (inertial @ scale).flatten())
    torch.testing.assert_close(second[:9], (inertial @ half_turn @ scale).flatten())
    place = t - inertial @ torch.tensor(FINITE["tref2i"]).double()
    torch.testing.assert_close(first[9:], place)


@pytest.mark.parametrize("vector", [[[0.1], [0.2], [0.3]], [[0.1, 0.2, 0.3]]])
def test_the_translation_may_be_a_column_or_a_row(tmp_path, vector):
    space = read_poseutils(write(tmp_path, FINITE | {"tref2i": vector}))
    assert space.frame_t.tolist() == [0.1, 0.2, 0.3]


def test_a_group_printed_to_six_digits_is_accepted(tmp_path):
    G = [[[round(x, 6) for x in row] for row in g] for g in dihedral(6).rotations.tolist()]
    space = read_poseutils(write(tmp_path, FINITE | {"G": G}))
    torch.testing.assert_close(space.symmetry.rotations, dihedral(6).rotations, atol=2e-6, rtol=0)


@pytest.mark.parametrize(
    "symmetry",
    [dihedral(3), RevolutionSymmetry(), RevolutionSymmetry(True), SphericalSymmetry()],
    ids=["finite", "revolution", "rotoreflection", "sphere"],
)
def test_what_is_written_is_read_again(tmp_path, symmetry):
    scale = torch.rand(3, 3).double() if isinstance(symmetry, FiniteSymmetry) else torch.rand(())
    frame_R, frame_t = roma.random_rotmat().double(), torch.rand(3).double()
    space = PoseSpace(symmetry, scale.double(), frame_R, frame_t, 0.0123)
    write_poseutils(tmp_path / "poseutils.json", space)
    read = read_poseutils(tmp_path / "poseutils.json")
    assert type(read.symmetry) is type(symmetry)
    assert read.distance_threshold == space.distance_threshold
    poses = roma.random_rotmat(4).double(), torch.rand(4, 3).double()
    torch.testing.assert_close(read.representatives(*poses), space.representatives(*poses))


def drop(fields, key):
    return {name: value for name, value in fields.items() if name != key}


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ([FINITE], "holds a list"),
        (drop(FINITE, "type"), "'type' is None"),
        (FINITE | {"type": "Cube"}, "'type' is 'Cube'"),
        (drop(FINITE, "Lambda"), "'Lambda' is missing"),
        (drop(FINITE, "G"), "'G' is missing"),
        (drop(FINITE, "distance_threshold"), "'distance_threshold' is missing"),
        (drop(REVOLUTION, "lambda"), "'lambda' is missing"),
        (REVOLUTION | {"lambda": -1}, "'lambda' is -1"),
        (drop(REVOLUTION, "rotoreflection_symmetry"), "'rotoreflection_symmetry' is None"),
        (REVOLUTION | {"rotoreflection_symmetry": 1}, "'rotoreflection_symmetry' is 1"),
        (FINITE | {"Lambda": [1, 2, 3]}, "'Lambda' has shape"),
        (FINITE | {"Lambda": [[1, 2, 3], [4, 5], [6]]}, "'Lambda' is ragged"),
        (FINITE | {"Lambda": "three"}, "'Lambda' does not hold numbers"),
        (FINITE | {"G": FINITE["G"][0]}, "'G' has shape"),
        (FINITE | {"G": FINITE["G"][1:]}, "'G': .* not a group"),
        (FINITE | {"G": [[[1, 0, 0], [0, 1, 0], [0, 0, -1]]]}, "'G' is not a rotation"),
        (FINITE | {"Rref2i": [[1, 0, 0], [0, 1, 0.1], [0, 0, 1]]}, "'Rref2i' is not a rotation"),
        (FINITE | {"tref2i": [1, 2]}, "'tref2i' has shape"),
        (FINITE | {"tref2i": [1, 2, math.nan]}, "'tref2i' holds NaN"),
        (FINITE | {"distance_threshold": 0}, "'distance_threshold' is 0"),
        (FINITE | {"distance_threshold": [1]}, "'distance_threshold' has shape"),
    ],
)
def test_a_fault_names_file_and_key(tmp_path, fields, message):
    path = write(tmp_path, fields)
    with pytest.raises(ValueError, match=f"{re.escape(str(path))}.*{message}"):
        read_poseutils(path)


def test_malformed_json_names_the_file(tmp_path):
    path = tmp_path / "poseutils.json"
    path.write_text("{")
    with pytest.raises(ValueError, match=f"{re.escape(str(path))}: is not valid JSON"):
        read_poseutils(path)
