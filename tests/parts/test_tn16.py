"""The cylinder with a cone on each end."""

import math

import numpy as np
import pytest
import torch

from pnet.parts.choice import KeypointChoice
from pnet.parts.tn16 import TN16

SIZE = np.array([0.010, 0.020, 0.006])


@pytest.fixture(scope="module")
def part() -> TN16:
    return TN16({"r": [10, 8], "h": [20], "c": [6, 4]}, sections=48)


def test_the_volume_is_cylinder_and_two_cones(part):
    area = 24 * 0.010**2 * math.sin(math.pi / 24)
    assert part.mesh(SIZE).volume == pytest.approx(area * (0.020 + 2 * 0.006 / 3), rel=1e-9)
    np.testing.assert_allclose(part.mesh(SIZE).bounds[:, 2], [-0.016, 0.016], atol=1e-9)
    assert part.mesh(SIZE).euler_number == 2


def test_the_keypoints_are_end_rim_and_apex(part):
    found = part.chain.keypoints_from_parameters(torch.from_numpy(SIZE))
    assert part.chain.names == ["end", "rim", "apex"]
    expected = torch.tensor([[0, 0, 0.010], [0.010, 0, 0.010], [0, 0, 0.016]], dtype=torch.float64)
    torch.testing.assert_close(found, expected)


def test_rim_and_apex_follow_the_end_nearest_to_the_camera(part, rotations):
    R = rotations(60)
    labels, margin = part.chain.select(KeypointChoice(), torch.from_numpy(SIZE).expand(60, 3), R)
    side = -R[:, 2, 2].sign()
    expected = side[:, None] * torch.tensor([0.010, 0.010, 0.016], dtype=torch.float64)
    torch.testing.assert_close(labels[..., 2], expected)
    tilt = R[:, 2, 2].abs()
    torch.testing.assert_close(margin[:, 0], 0.020 * tilt)
    torch.testing.assert_close(margin[:, 1], torch.minimum(0.020 * tilt, 0.010 * (1 - tilt**2).sqrt()))


def test_the_apex_is_never_exchanged_alone(part):
    assert [len(images) for images, _ in part.chain._equivalents] == [2, 1, 2]
    assert part.chain.is_finite == [True, False, True] and len(part.chain.chiralities) == 1
