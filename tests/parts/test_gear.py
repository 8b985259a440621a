"""The gear out of two cylinders."""

import math

import numpy as np
import pytest
import torch

from pnet.parts.gear import WHEEL, Gear

SIZE = np.array([0.057, 0.024, 0.061])


@pytest.fixture(scope="module")
def part() -> Gear:
    return Gear({"r": [57], "b": [24], "h": [61]})


def test_volume_and_centroid_are_those_of_wheel_and_hub(part):
    r, b, h = SIZE
    volumes = 24 * math.sin(math.pi / 24) * h * np.array([WHEEL * r**2, (1 - WHEEL) * b**2])
    assert part.mesh(SIZE).volume == pytest.approx(volumes.sum(), rel=1e-9)
    height = volumes @ [WHEEL / 2 * h, (1 + WHEEL) / 2 * h] / volumes.sum()
    np.testing.assert_allclose(part.centroid(SIZE[None])[0], [0, 0, height], atol=1e-9)


def test_the_rim_is_the_wheels_and_the_hub_the_tops(part):
    keypoints = dict(
        zip(part.chain.names, part.chain.keypoints_from_parameters(torch.from_numpy(SIZE)), strict=True)
    )
    low, high = part.mesh(SIZE).bounds[:, 2]
    assert keypoints["rim"].tolist() == pytest.approx([0.057, 0, low])
    assert keypoints["hub"].tolist() == pytest.approx([0.024, 0, high])


@pytest.mark.parametrize("b", [57.0, 60.0])
def test_a_hub_as_wide_as_the_wheel_is_refused(b):
    with pytest.raises(ValueError, match=rf"gear: the hub \(b = {b:g} mm\) must be narrower than the wheel"):
        Gear({"r": [57], "b": [b], "h": [61]})
