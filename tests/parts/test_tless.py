"""The two electrical fittings: a cuboid with a cylinder or a second cuboid above."""

import math

import numpy as np
import pytest
import torch

from pnet.parts.choice import NearestToCamera
from pnet.parts.tless20 import TLess20
from pnet.parts.tless29 import TLess29

SIZE_20 = np.array([0.083, 0.0755, 0.025, 0.032, 0.047])
SIZE_29 = np.array([0.080, 0.048, 0.022, 0.044, 0.056])


def grid(names: str, size: np.ndarray) -> dict[str, list[float]]:
    return {name: [1000 * value] for name, value in zip(names, size, strict=True)}


@pytest.fixture(scope="module")
def tless20() -> TLess20:
    return TLess20(grid("lwbrh", SIZE_20))


@pytest.fixture(scope="module")
def tless29() -> TLess29:
    return TLess29(grid("lwbsh", SIZE_29))


def test_tless20_is_a_cuboid_and_a_cylinder(tless20):
    l, w, b, r, h = SIZE_20  # noqa: E741
    volumes = np.array([l * w * b, 24 * math.sin(math.pi / 24) * r**2 * (h - b)])
    assert tless20.mesh(SIZE_20).volume == pytest.approx(volumes.sum(), rel=1e-9)
    height = volumes @ [b / 2, (b + h) / 2] / volumes.sum()
    np.testing.assert_allclose(tless20.centroid(SIZE_20[None])[0], [0, 0, height], atol=1e-9)


def test_tless29_is_two_cuboids(tless29):
    l, w, b, s, h = SIZE_29  # noqa: E741
    volumes = np.array([l * w * b, s * w * (h - b)])
    assert tless29.mesh(SIZE_29).volume == pytest.approx(volumes.sum(), rel=1e-9)
    height = volumes @ [b / 2, (b + h) / 2] / volumes.sum()
    np.testing.assert_allclose(tless29.centroid(SIZE_29[None])[0], [0, 0, height], atol=1e-9)


@pytest.mark.parametrize("name", ["tless20", "tless29"])
def test_ends_and_sides_are_half_a_size_from_the_base(name, request):
    part = request.getfixturevalue(name)
    size = torch.from_numpy(part.part_object("L", 0))
    keypoints = dict(zip(part.chain.names, part.chain.keypoints_from_parameters(size), strict=True))
    base = keypoints["base"]
    assert (keypoints["end"] - base).tolist() == pytest.approx([float(size[0]) / 2, 0, 0])
    assert (keypoints["side"] - base).tolist() == pytest.approx([0, float(size[1]) / 2, 0])
    assert (keypoints["shoulder"] - keypoints["end"]).tolist() == pytest.approx([0, 0, float(size[2])])
    assert (keypoints["top"] - base).tolist() == pytest.approx([0, 0, float(size[4])])


@pytest.mark.parametrize("name", ["tless20", "tless29"])
def test_end_and_side_are_chosen_independently_because_of_the_mirror(name, request, rotations):
    part, R = request.getfixturevalue(name), rotations(60)
    size = torch.from_numpy(part.part_object("L", 0)).expand(60, -1)
    labels, _ = part.chain.choose(NearestToCamera(R), part.chain.keypoints_from_parameters(size))
    end, side, shoulder = (part.chain.names.index(kp) for kp in ("end", "side", "shoulder"))
    torch.testing.assert_close(labels[:, end, 0], -size[:, 0] / 2 * R[:, 2, 0].sign())
    torch.testing.assert_close(labels[:, side, 1], -size[:, 1] / 2 * R[:, 2, 1].sign())
    torch.testing.assert_close(labels[:, shoulder, :2], labels[:, end, :2])
    assert len(part.chain.chiralities) == 2


@pytest.mark.parametrize("change", [{"r": [38]}, {"b": [47]}, {"b": [50]}])
def test_a_cylinder_beside_or_under_the_cuboid_is_refused(change):
    with pytest.raises(ValueError, match="tless20: the cylinder must stand within the cuboid"):
        TLess20(grid("lwbrh", SIZE_20) | change)


@pytest.mark.parametrize("change", [{"s": [81]}, {"b": [56]}])
def test_an_upper_cuboid_that_is_longer_or_sunk_is_refused(change):
    with pytest.raises(ValueError, match="tless29: the upper cuboid must be no longer than the lower one"):
        TLess29(grid("lwbsh", SIZE_29) | change)
