"""PPR-Net on a small backbone: shapes, and rotations that are some."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pnet.backbones.pointnet2 import Level, PointNet2
from pnet.models.pprnet import PPRNet, RotationHead


def build(visibility: bool = True, scale: float = 0.02) -> PPRNet:
    torch.manual_seed(0)
    backbone = PointNet2([Level(16, 0.05, 8, [8])], [[12]])
    return PPRNet(backbone, 3, [8], [8], scale, visibility)


def constant_head(angles: list[float]) -> RotationHead:
    """Says these angles whatever it sees."""
    head = RotationHead(4, [4]).eval()
    with torch.no_grad():
        head.last.weight.zero_()
        head.last.bias.copy_(torch.tensor(angles))
    return head


def off_a_rotation(R: torch.Tensor) -> float:
    """Largest entry of RᵀR − 1, or of det R − 1."""
    R = R.detach().double()
    square = (R.mT @ R - torch.eye(3).double()).abs().max()
    return float(max(square, (torch.linalg.det(R) - 1).abs().max()))


@pytest.fixture
def points() -> torch.Tensor:
    return 0.1 * torch.rand(2, 40, 3, generator=torch.Generator().manual_seed(0))


def test_shapes(points):
    found = build()(points)
    assert found.centroid.shape == (2, 40, 3)
    assert found.rotation.shape == (2, 40, 3, 3)
    assert found.visibility.shape == (2, 40)
    assert found.visibility.min().item() > 0 and found.visibility.max().item() < 1


def test_rotations_are_orthonormal_and_proper(points):
    found = build()(points)
    assert off_a_rotation(found.rotation) < 1e-6
    assert (found.rotation - found.rotation[0, 0]).abs().max().item() > 0.01  # each point has its own


def test_without_the_visibility_head(points):
    net = build(visibility=False)
    assert net(points).visibility is None
    assert not [name for name in net.state_dict() if name.startswith("visibility")]


def test_it_has_no_head_for_keypoints():
    heads = {name.split(".")[0] for name in build().state_dict()}
    assert heads == {"backbone", "centroid", "rotation", "visibility"}


def test_with_scale_zero_every_point_is_its_own_centroid(points):
    assert torch.equal(build(scale=0.0)(points).centroid, points)


def test_tables_may_be_given_or_found(points):
    net = build().eval()
    given, own = net(points, net.backbone.tables(points)), net(points)
    for name in ("centroid", "rotation", "visibility"):
        assert torch.equal(getattr(given, name), getattr(own, name))


def test_the_gradient_reaches_every_weight(points):
    net = build()
    found = net(points)
    weight = torch.randn(3, 3, generator=torch.Generator().manual_seed(1))
    (found.centroid.square().sum() + (weight * found.rotation).sum() + found.visibility.sum()).backward()
    assert not [name for name, p in net.named_parameters() if p.grad is None or not bool(p.grad.any())]


@given(st.tuples(*[st.floats(-4, 4, width=32)] * 3))
def test_angles_are_those_of_intrinsic_turns_about_x_y_and_z(angles):
    expected = Rotation.from_euler("XYZ", angles).as_matrix()
    found = constant_head(list(angles))(torch.zeros(1, 2, 4))[0, 1]
    np.testing.assert_allclose(found.detach().numpy(), expected, atol=2e-6)


def test_the_product_is_that_of_the_three_turns_by_hand():
    def turn(axis: int) -> torch.Tensor:
        angles = [0.0, 0.0, 0.0]
        angles[axis] = (0.3, -0.8, 2.1)[axis]
        return constant_head(angles)(torch.zeros(1, 1, 4))[0, 0]

    whole = constant_head([0.3, -0.8, 2.1])(torch.zeros(1, 1, 4))[0, 0]
    torch.testing.assert_close(whole, turn(0) @ turn(1) @ turn(2), rtol=0, atol=1e-6)
    # Ry carries z towards x: Rx(90°) Ry(90°) z = Rx(90°) x = x, while the other order gives −y
    carried = constant_head([math.pi / 2, math.pi / 2, 0])(torch.zeros(1, 1, 4))[0, 0, :, 2]
    torch.testing.assert_close(carried, torch.tensor([1.0, 0, 0]), rtol=0, atol=1e-6)


def test_under_bf16_rotations_are_float32_and_orthonormal(points):
    net = build()
    with torch.autocast("cpu", torch.bfloat16):
        found = net(points)
    assert {v.dtype for v in (found.centroid, found.rotation, found.visibility)} == {torch.float32}
    assert off_a_rotation(found.rotation) < 1e-6


def test_bf16_does_not_round_the_angles():
    """Near π a step of bfloat16 is 0.9°."""
    angles = [3.03, -2.83, 3.11]
    with torch.autocast("cpu", torch.bfloat16):
        found = constant_head(angles)(torch.zeros(1, 1, 4))[0, 0]
    np.testing.assert_allclose(
        found.detach().numpy(), Rotation.from_euler("XYZ", angles).as_matrix(), atol=1e-6
    )


def test_bf16_lets_gradients_through(points):
    net = build()
    with torch.autocast("cpu", torch.bfloat16):
        found = net(points)
    found.rotation[..., 0, 1].sum().backward()
    assert all(bool(p.grad.isfinite().all()) and bool(p.grad.any()) for p in net.rotation.parameters())
