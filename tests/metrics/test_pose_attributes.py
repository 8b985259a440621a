"""What a true pose is like, and which part of a pose is wrong."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tests.conftest import Marble

from pnet.metrics.pose_attributes import Blame, label_margin, pose_errors, scene_attributes
from pnet.parts.choice import KeypointChoice, KeypointRule
from pnet.parts.tn42 import TN42

POINT = KeypointChoice(KeypointRule.POINT)


def rotations(*vectors):
    return torch.from_numpy(Rotation.from_rotvec(np.array(vectors, float), degrees=True).as_matrix())


def errors_of(part, turns, shifts):
    """Of results turned (in the part frame, degrees) and shifted (of the surface centroid, metres)."""
    space = part.pose_space(part.part_object("L", 0))
    n = len(turns)
    Ra = rotations([20, 30, 40]).expand(n, 3, 3)
    ta = torch.tensor([0.0, 0.0, 0.6]).double().expand(n, 3)
    Rb = Ra @ rotations(*turns)
    tb = ta + (Ra - Rb) @ space.centre + torch.tensor(shifts).double()
    return pose_errors(space, part.symmetry, Ra, ta, Rb, tb), space


@pytest.fixture(scope="module")
def bar():
    return TN42(learning={"l": [40], "a": [16], "w": [12]})


def test_the_blame_is_with_what_alone_would_mend_the_pose(bar):
    threshold = errors_of(bar, [[0, 0, 0]], [[0.0, 0, 0]])[1].distance_threshold
    most = 0.9 * threshold
    turns = [[0, 0, 0], [0, 0, 0], [180, 0, 0], [180, 0, 0]]
    errors, _ = errors_of(bar, turns, [[most, 0, 0], [0, 2 * threshold, 0], [0, 0, 0], [0, 2 * threshold, 0]])
    assert [Blame(b) for b in errors.blame] == [Blame.NONE, Blame.POSITION, Blame.ROTATION, Blame.BOTH]
    np.testing.assert_allclose(errors.position, [most, 2 * threshold, 0, 2 * threshold], atol=1e-12)
    assert errors.flip.tolist() == [False, False, True, True]


def test_position_and_rotation_can_be_beyond_only_together(bar):
    errors, space = errors_of(bar, [[0, 0, 5]], [[0.0, 0, 0]])
    angle = 5 * 0.9 * space.distance_threshold / float(errors.rotation_distance[0])
    errors, _ = errors_of(bar, [[0, 0, angle]], [[0, 0, 0.9 * space.distance_threshold]])
    assert errors.rotation_distance[0] < space.distance_threshold < errors.distance[0]
    assert errors.blame.tolist() == [Blame.SUM]


def test_squares_of_the_two_parts_add_up_to_the_distances(bar):
    turns = np.random.default_rng(0).normal(0, 60, (20, 3)).tolist()
    errors, _ = errors_of(bar, turns, np.random.default_rng(1).normal(0, 0.01, (20, 3)).tolist())
    np.testing.assert_allclose(errors.distance**2, errors.position**2 + errors.rotation_distance**2)


def test_the_turn_is_told_in_the_part_frame_modulo_symmetry(bar, tn06):
    errors, _ = errors_of(bar, [[100, 0, 0], [0, -30, 0]], [[0.0, 0, 0]] * 2)
    np.testing.assert_allclose(np.degrees(errors.turn), [[100, 0, 0], [0, -30, 0]], atol=1e-6)
    errors, _ = errors_of(tn06, [[0, 0, 80], [180, 0, 0]], [[0.0, 0, 0]] * 2)
    np.testing.assert_allclose(np.degrees(errors.turn), [[0, 0, 20], [0, 0, 0]], atol=1e-5)
    np.testing.assert_allclose(np.degrees(errors.rotation), [20, 0], atol=1e-5)


def test_turns_of_a_revolution_and_a_sphere_are_no_error(tn34):
    errors, _ = errors_of(tn34, [[0, 0, 90], [10, 0, 0]], [[0.0, 0, 0]] * 2)
    np.testing.assert_allclose(np.degrees(errors.rotation), [0, 10], atol=1e-5)
    assert np.degrees(np.linalg.norm(errors.turn, axis=1)) == pytest.approx([0, 10], abs=1e-5)
    errors, _ = errors_of(Marble({"r": [10]}), [[90, 10, 0]], [[0.0, 0, 0]])
    assert errors.rotation.tolist() == [0.0] and errors.blame.tolist() == [Blame.NONE]


def test_no_result_gives_no_errors_and_no_blame(bar):
    space = bar.pose_space(bar.part_object("L", 0))
    nan = torch.full((1, 3, 3), math.nan).double()
    errors = pose_errors(
        space, bar.symmetry, rotations([0, 0, 0]), torch.zeros(1, 3).double(), nan, nan[:, 0]
    )
    columns = (errors.distance, errors.position, errors.rotation_distance, errors.rotation)
    assert all(np.isnan(column).all() for column in columns) and np.isnan(errors.turn).all()
    assert errors.blame.tolist() == [Blame.NONE] and errors.flip.tolist() == [False]


def test_tilt_is_the_angle_to_the_line_of_sight_without_a_sign(make_scene, tn34):
    scene = make_scene(tn34, bodies=3)
    t = np.array([[0.0, 0, 0.5], [0.3, 0, 0.3], [0, 0, 0.4]])
    R = rotations([180, 0, 0], [0, 0, 0], [0, 90, 0]).numpy()
    of = scene_attributes(replace(scene, R=R, t=t), tn34, POINT)
    np.testing.assert_allclose(np.degrees(of.tilt), [0, 45, 90], atol=1e-5)
    np.testing.assert_allclose(of.neighbour, [0.1, math.hypot(0.3, 0.1), 0.1])


def test_a_single_body_has_no_neighbour_and_a_sphere_no_tilt(make_scene, tn34):
    assert np.isnan(scene_attributes(make_scene(tn34, bodies=1), tn34, POINT).neighbour).all()
    marble = Marble({"r": [10]})
    assert np.isnan(scene_attributes(make_scene(marble, bodies=2), marble, POINT).tilt).all()


def test_margins_by_points_are_medians_over_the_bodys_points(make_scene, tn06):
    from pnet.data.targets import nearest_keypoints

    scene = make_scene(tn06, bodies=3)
    margin = label_margin(scene, tn06.chain, POINT)
    each = nearest_keypoints(scene, tn06.chain)[1].numpy()
    for body in range(3):
        np.testing.assert_allclose(margin[body], np.median(each[scene.instance == body], 0))
    unseen = replace(scene, instance=np.where(scene.instance == 1, -1, scene.instance))
    assert np.isnan(label_margin(unseen, tn06.chain, POINT)[1]).all()
    np.testing.assert_allclose(label_margin(unseen, tn06.chain, POINT)[2], margin[2])


@pytest.mark.parametrize("rule", [KeypointRule.CAMERA, KeypointRule.CANONICAL])
def test_margins_of_the_other_rules_are_the_instances(make_scene, tn06, rule):
    from pnet.data.targets import instance_keypoints

    scene, choice = make_scene(tn06), KeypointChoice(rule)
    expected = instance_keypoints(scene, tn06.chain, choice)[1].numpy()
    np.testing.assert_array_equal(label_margin(scene, tn06.chain, choice), expected)
