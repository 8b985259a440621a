"""The candlestick out of three cylinders."""

import math

import numpy as np
import pytest
import torch

from pnet.parts.candlestick import CUP, FOOT, STEM, Candlestick

SIZE = np.array([0.030, 0.016, 0.090])


@pytest.fixture(scope="module")
def part() -> Candlestick:
    return Candlestick({"r": [30], "c": [16], "h": [90]})


def test_volume_and_centroid_are_those_of_foot_stem_and_cup(part):
    r, c, h = SIZE
    areas = 24 * math.sin(math.pi / 24) * np.array([r, STEM * c, c]) ** 2
    ends = h * np.array([0, FOOT, 1 - CUP, 1])
    volumes = areas * np.diff(ends)
    assert part.mesh(SIZE).volume == pytest.approx(volumes.sum(), rel=1e-9)
    height = volumes @ (ends[:-1] + ends[1:]) / 2 / volumes.sum()
    np.testing.assert_allclose(part.centroid(SIZE[None])[0], [0, 0, height], atol=1e-9)
    base, top, *_ = part.chain.keypoints_from_parameters(torch.from_numpy(SIZE))
    assert (base[2].item(), top[2].item()) == pytest.approx((-height, h - height))


def test_rim_and_cup_lie_on_the_end_circles(part):
    keypoints = dict(
        zip(part.chain.names, part.chain.keypoints_from_parameters(torch.from_numpy(SIZE)), strict=True)
    )
    low, high = part.mesh(SIZE).bounds[:, 2]
    assert keypoints["rim"].tolist() == pytest.approx([0.030, 0, low])
    assert keypoints["cup"].tolist() == pytest.approx([0.016, 0, high])
