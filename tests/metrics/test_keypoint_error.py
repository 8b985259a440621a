"""Distances to the nearest equivalents of true keypoints."""

import math

import pytest
import torch
from tests.conftest import Marble, load_part

from pnet.geometry.rigid import apply_pose
from pnet.geometry.symmetry import rotation_about_z
from pnet.metrics.keypoint_error import keypoint_error
from pnet.parts.tn42 import TN42

R = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64))[0]
R = R * torch.linalg.det(R)
T = torch.tensor([0.01, -0.02, 0.6], dtype=torch.float64)


def errors(part, local, parameters):
    """Of keypoints (n, m, 3) in the part frame."""
    n = len(local)
    pose = (R.expand(n, 3, 3), T.expand(n, 3))
    return keypoint_error(part.chain, parameters.expand(n, -1), *pose, apply_pose(*pose, local))


@pytest.mark.parametrize(
    "name", ["tn06", "tn16", "tn34", "tn42", "candlestick", "gear", "tless20", "tless29"]
)
def test_every_equivalent_has_no_error_and_a_shift_has_its_length(name):
    part = load_part(name)
    size = torch.from_numpy(part.part_object("L", 0))
    template = part.chain.keypoints_from_parameters(size)
    images = template @ part.chain.group.mT
    torch.testing.assert_close(errors(part, images, size), torch.zeros(images.shape[:2]).double())
    # every keypoint by itself: others may have moved, and a small shift off all circles stays what it is
    moved = images + torch.tensor([0.0, 0.0, 1e-4])
    assert errors(part, moved, size).max() <= 1e-4 + 1e-12


def test_a_turn_about_a_revolutions_axis_is_no_error(tn34):
    size = torch.from_numpy(tn34.part_object("L", 5))
    turn = rotation_about_z(torch.tensor([0.3, 2.0, -1.0], dtype=torch.float64))
    local = tn34.chain.keypoints_from_parameters(size) @ turn.mT
    torch.testing.assert_close(errors(tn34, local, size), torch.zeros(3, 3).double())
    local[:, 2] *= torch.tensor([1.1, 1.1, 1.0])  # the rim point, a tenth of the radius outwards
    torch.testing.assert_close(
        errors(tn34, local, size)[:, 2], torch.full((3,), 0.1 * float(size[0])).double()
    )


def test_any_point_of_a_sphere_will_do():
    part = Marble({"r": [10]})
    local = torch.tensor([[[0.006, 0.008, 0.0]], [[0.0, 0.0, -0.013]]], dtype=torch.float64)
    error = errors(part, local, torch.tensor([0.01]).double())
    torch.testing.assert_close(error, torch.tensor([[0.0], [0.003]]).double())


def test_each_keypoint_takes_its_own_nearest_equivalent():
    part = TN42(learning={"l": [40], "a": [16], "w": [12]})
    size = torch.from_numpy(part.part_object("L", 0))
    local = part.chain.keypoints_from_parameters(size)[None].clone()
    side = part.chain.names.index("side")
    local[0, side, 1] *= -1  # its mirror image, the others where they are
    local[0, part.chain.names.index("foot"), 0] -= 0.002
    error = errors(part, local, size)[0]
    expected = torch.zeros(5).double()
    expected[part.chain.names.index("foot")] = 0.002
    torch.testing.assert_close(error, expected)


def test_what_is_not_estimated_has_no_error(tn34):
    size = torch.from_numpy(tn34.part_object("L", 0))
    assert errors(tn34, torch.full((2, 3, 3), math.nan).double(), size).isnan().all()
    assert errors(tn34, torch.zeros(2, 0, 3).double(), size).isnan().all()
    assert errors(tn34, torch.zeros(0, 3, 3).double(), size).shape == (0, 3)
