"""Labels: whose instance, which of the equivalent keypoints."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pnet.data.augmentation import rotate_about_view_axis
from pnet.data.targets import instance_keypoints, point_labels
from pnet.geometry.camera import Camera
from pnet.parts.keypoints import KeypointChoice, KeypointRule
from pnet.parts.tn34 import CENTROID
from pnet.records import Scene, SceneId

R_MM, H_MM = 0.012, 0.010
CAMERA = KeypointChoice(KeypointRule.CAMERA)
CANONICAL = KeypointChoice(KeypointRule.CANONICAL)
UP_ON = np.eye(3)  # the flange's axis along the view axis
LYING = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # the flange's axis towards the camera's −y


def two_flanges() -> Scene:
    """One flange seen along its axis, one lying; three points, the second flange's first."""
    return Scene(
        points=np.array([[0.1, 0, 0.6], [0, 0, 0.6], [0.1, 0.01, 0.6]], np.float32),
        instance=np.array([1, 0, 1]),
        R=np.stack([UP_ON, LYING]),
        t=np.array([[0, 0, 0.6], [0.1, 0, 0.61]]),
        parameters=np.array([[R_MM, H_MM], [R_MM, H_MM]]),
        visibility=np.array([0.25, 0.75]),
        occlusion=np.zeros(2),
        camera=Camera(8, 8, 10.0, 10.0, 3.5, 3.5),
        part="tn34",
        id=SceneId("train", "pile", 0, 0, 2),
    )


def test_a_point_has_the_labels_of_its_own_instance(tn34):
    scene = two_flanges()
    labels = point_labels(scene, tn34.chain, CAMERA)
    torch.testing.assert_close(labels["visibility"], torch.tensor([0.75, 0.25, 0.75]))
    torch.testing.assert_close(
        labels["centroid"], torch.tensor([[0.1, 0, 0.61], [0, 0, 0.6], [0.1, 0, 0.61]])
    )
    torch.testing.assert_close(labels["points"], torch.from_numpy(scene.points))
    each = instance_keypoints(scene, tn34.chain, CAMERA).float()
    torch.testing.assert_close(labels["keypoints"], each[[1, 0, 1]])
    assert labels["parameters"].tolist() == pytest.approx(np.tile([R_MM, H_MM], (3, 1)))
    assert {value.dtype for value in labels.values()} == {torch.float32}


def test_keypoints_of_a_lying_flange_by_hand(tn34):
    base, top, rim = instance_keypoints(two_flanges(), tn34.chain, CAMERA)[1].tolist()
    # the part's z points to −y, so the base lies towards +y; the rim's nearest point lies towards −z
    assert base == pytest.approx([0.1, CENTROID * H_MM, 0.61])
    assert top == pytest.approx([0.1, CENTROID * H_MM - H_MM, 0.61])
    assert rim == pytest.approx([0.1, CENTROID * H_MM, 0.61 - R_MM])


def test_without_gu_the_rim_is_the_templates_own(tn34):
    base, _, rim = instance_keypoints(two_flanges(), tn34.chain, CANONICAL)[0].tolist()
    assert np.subtract(rim, base) == pytest.approx([R_MM, 0, 0])


@pytest.mark.parametrize(
    ("direction", "side"),
    [
        ((0, 0, 1), (0, -1, 0)),  # a tie in z: the smallest y decides
        ((0, 1, 0), (0, -1, 0)),
        ((0, -1, 0), (0, 1, 0)),
        ((1, 0, 0), (-1, 0, 0)),
        ((3, 4, 0), (-0.6, -0.8, 0)),
    ],
)
def test_the_direction_decides_where_the_rim_is(tn34, direction, side):
    choice = KeypointChoice(KeypointRule.CAMERA, direction)
    base, _, rim = instance_keypoints(two_flanges(), tn34.chain, choice)[0].tolist()
    assert np.subtract(rim, base) == pytest.approx(R_MM * np.array(side), abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_gu_labels_turn_with_the_scene(part, make_scene, seed):
    scene = make_scene(part, seed=seed)
    angle = 0.4 + seed
    turned = rotate_about_view_axis(scene, angle)
    c, s = np.cos(angle), np.sin(angle)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    expected = instance_keypoints(scene, part.chain, CAMERA) @ turn.T
    torch.testing.assert_close(instance_keypoints(turned, part.chain, CAMERA), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("choice", [CAMERA, CANONICAL, KeypointChoice(KeypointRule.CAMERA, (0, 1, 0))])
def test_labels_give_back_the_parameters(part, make_scene, choice):
    labels = point_labels(make_scene(part), part.chain, choice)
    measured = part.chain.parameters_from_keypoints(labels["centroid"], labels["keypoints"])
    torch.testing.assert_close(measured, labels["parameters"], rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("number", [-1, 2])
def test_a_point_on_no_instance_is_an_error(tn34, number):
    scene = replace(two_flanges(), instance=np.array([0, number, 1]))
    with pytest.raises(ValueError, match="train/pile_0000_part_00/002: a point names instance"):
        point_labels(scene, tn34.chain, CAMERA)


def test_a_scene_without_points_has_no_labels(tn34):
    scene = two_flanges()
    empty = replace(scene, points=scene.points[:0], instance=scene.instance[:0])
    assert point_labels(empty, tn34.chain, CAMERA)["keypoints"].shape == (0, 3, 3)
