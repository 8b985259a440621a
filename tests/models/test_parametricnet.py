"""The whole network on a small backbone."""

import pytest
import torch

from pnet.backbones.pointnet2 import Level, PointNet2
from pnet.models.parametricnet import ParametricNet


def build(visibility: bool = True, scale: float = 0.02, **heads) -> ParametricNet:
    torch.manual_seed(0)
    backbone = PointNet2([Level(16, 0.05, 8, [8])], [[12]])
    return ParametricNet(backbone, 3, [8], [8], scale, visibility, **heads)


@pytest.fixture
def points() -> torch.Tensor:
    return 0.1 * torch.rand(2, 40, 3, generator=torch.Generator().manual_seed(0))


def test_shapes(points):
    found = build()(points)
    assert found.centroid.shape == (2, 40, 3)
    assert found.keypoints.shape == (2, 40, 3, 3)
    assert found.visibility.shape == (2, 40)


def test_without_the_visibility_module(points):
    net = build(visibility=False)
    assert net(points).visibility is None
    assert not [name for name in net.state_dict() if name.startswith("visibility")]


def test_tables_may_be_found_beforehand(points):
    net = build().eval()
    given, own = net(points, net.backbone.tables(points)), net(points)
    assert torch.equal(given.keypoints, own.keypoints)


def test_with_scale_zero_every_point_predicts_itself(points):
    found = build(scale=0.0)(points)
    assert torch.equal(found.centroid, points)
    assert torch.equal(found.keypoints, points[:, :, None].expand(-1, -1, 3, -1))


def test_the_gradient_reaches_every_weight(points):
    net = build()
    found = net(points)
    (found.centroid.square().sum() + found.keypoints.square().sum() + found.visibility.sum()).backward()
    assert not [name for name, p in net.named_parameters() if p.grad is None or not bool(p.grad.any())]


def test_tables_may_be_given_or_found(points):
    net = build().eval()
    given = net(points, net.backbone.tables(points))
    assert torch.equal(given.keypoints, net(points).keypoints)


def test_without_their_heads_neither_sizes_nor_doubt_are_said(points):
    net = build(parameters=2)
    found = net(points)
    assert found.parameters is None and found.doubt is None
    assert not [name for name in net.state_dict() if name.startswith(("sizes", "doubt"))]


def test_doubt_is_said_of_the_centroid_every_keypoint_and_every_parameter(points):
    found = build(parameters=2, sizes=True, doubt=True)(points)
    assert found.parameters.shape == (2, 40, 2)
    assert found.doubt.shape == (2, 40, 1 + 3 + 2)
    assert float(found.doubt.detach().min()) > 0
    only = build(parameters=2, doubt=True)(points)
    assert only.parameters is None and only.doubt.shape == (2, 40, 6)


def test_the_gradient_reaches_the_weights_of_sizes_and_doubt(points):
    net = build(parameters=2, sizes=True, doubt=True)
    found = net(points)
    said = found.centroid, found.keypoints, found.visibility, found.parameters, found.doubt
    sum(value.square().sum() for value in said).backward()
    assert not [name for name, p in net.named_parameters() if p.grad is None or not bool(p.grad.any())]
