import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pnet.data.public.object_frame import ObjectFrame

TURN = [[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]


@pytest.fixture
def poses():
    rng = np.random.default_rng(0)
    return Rotation.random(5, rng).as_matrix(), rng.normal(size=(5, 3))


def test_a_point_has_one_place_by_either_pose(poses):
    frame = ObjectFrame(TURN, (10, -20, 5))
    x_object = np.array([0.03, 0.01, -0.02])
    x_part = np.array(TURN) @ x_object + [0.01, -0.02, 0.005]
    R, t = frame.part_poses(*poses)
    np.testing.assert_allclose(R @ x_part + t, poses[0] @ x_object + poses[1], atol=1e-12)


def test_the_way_back_undoes_it(poses):
    frame = ObjectFrame(TURN, (10, -20, 5))
    for there, back in zip(poses, frame.object_poses(*frame.part_poses(*poses)), strict=True):
        np.testing.assert_allclose(back, there, atol=1e-12)


def test_by_default_poses_stay(poses):
    for before, after in zip(poses, ObjectFrame().part_poses(*poses), strict=True):
        np.testing.assert_array_equal(after, before)


def test_no_bodies_have_no_poses():
    R, t = ObjectFrame(TURN, (1, 2, 3)).part_poses(np.zeros((0, 3, 3)), np.zeros((0, 3)))
    assert R.shape == (0, 3, 3) and t.shape == (0, 3)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"R": [[1, 0], [0, 1]]}, "R has shape (2, 2) and t (3,), expected 3 x 3 and 3"),
        ({"t": [1, 2]}, "R has shape (3, 3) and t (2,)"),
        ({"t": 5}, "R has shape (3, 3) and t ()"),
        ({"R": [[1, 0, 0], [0, 1], [0, 0, 1]]}, "R and t must hold numbers, 3 x 3 and 3"),
        ({"R": [["a", 0, 0], [0, 1, 0], [0, 0, 1]]}, "R and t must hold numbers"),
        ({"t": [0, None, 0]}, "frame.t is [0, None, 0], expected three lengths in mm"),
        ({"R": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "frame.R: the rotation of entry 0 is none"),
        ({"R": [[1, 0, 0], [0, 1, 0], [0, 0, 1.01]]}, "frame.R: the rotation of entry 0 is none"),
        ({"R": [[float("nan"), 0, 0], [0, 1, 0], [0, 0, 1]]}, "frame.R: the rotation of entry 0 is none"),
        ({"t": [0, float("inf"), 0]}, "frame.t is [0, inf, 0], expected three lengths in mm"),
    ],
)
def test_a_frame_that_cannot_be_names_its_key(settings, message):
    with pytest.raises(ValueError) as fault:
        ObjectFrame(**settings)
    assert str(fault.value).startswith(
        ("data.source.frame.R: ", "data.source.frame.t ", "data.source.frame: ")
    )
    assert message in str(fault.value)
