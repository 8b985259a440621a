"""PointNet: order of points, the global feature, the split product."""

import pytest
import torch
from torch import nn

from pnet.backbones.layers import centred
from pnet.backbones.pointnet import PointNet

N = 60


def build(scale: float = 0.1) -> PointNet:
    torch.manual_seed(0)
    return PointNet([8, 6], [10, 24], [16, 12, 10], scale)


def clouds(seed: int = 0, batch: int = 2) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(batch, N, 3, generator=generator) * 0.2 + torch.tensor([0, 0, 0.6])


def test_every_point_gets_features():
    net = build()
    assert net(clouds(), {}).shape == (2, N, 10) and net.features == 10
    assert net.pyramid is None and net.tables(clouds()) == {}


def test_points_may_come_in_any_order():
    net, points = build().eval(), clouds()
    order = torch.randperm(N)
    torch.testing.assert_close(net(points[:, order], {}), net(points, {})[:, order], rtol=1e-4, atol=1e-5)


def test_the_feature_of_the_cloud_reaches_every_point():
    net, points = build().eval(), clouds()
    other = points.clone()
    # two points move oppositely, so that the mean and the others' own places stay
    other[:, 3] += torch.tensor([0.4, 0.3, -0.2])
    other[:, 7] -= torch.tensor([0.4, 0.3, -0.2])
    still = [i for i in range(N) if i not in (3, 7)]
    own, own_before = net.local(centred(other) / 0.1), net.local(centred(points) / 0.1)
    torch.testing.assert_close(own[:, still], own_before[:, still], rtol=1e-4, atol=1e-5)
    change = (net(other, {}) - net(points, {})).abs().amax(-1)
    assert bool((change > 1e-4).all())


def test_other_clouds_of_the_batch_do_not_matter_in_evaluation():
    net, points = build().eval(), clouds()
    torch.testing.assert_close(net(points[:1], {}), net(points, {})[:1], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("training", [True, False])
def test_the_split_product_is_one_product_of_both_features(training):
    net, points = build().double().train(training), clouds().double()
    local, wide, merged = net.local, net.wide, net.merged
    one = nn.Linear(6 + 24, 16, bias=False).double()
    one.weight.data = torch.cat([net.of_point.weight, net.of_cloud.weight], 1).detach()
    norm = nn.BatchNorm1d(16).double().train(training)
    norm.load_state_dict(net.norm.state_dict())
    out = net(points, {})
    own = local(centred(points) / 0.1)
    both = torch.cat([own, wide(own).amax(1, keepdim=True).expand(-1, N, -1)], -1)
    rows = norm(one(both).flatten(0, 1)).view(2, N, 16).relu()
    torch.testing.assert_close(out, merged(rows), rtol=1e-9, atol=1e-10)


def test_a_moved_cloud_has_the_same_features():
    net, points = build().eval(), clouds()
    moved = points + torch.tensor([0.25, -0.5, 0.125])
    torch.testing.assert_close(net(moved, {}), net(points, {}), rtol=1e-4, atol=1e-5)


def test_the_scale_is_a_unit_of_length():
    net, scaled, points = build().eval(), build(scale=0.2).eval(), clouds()
    torch.testing.assert_close(scaled(2 * points, {}), net(points, {}), rtol=1e-5, atol=1e-6)


def test_the_gradient_reaches_every_weight():
    net = build()
    (net(clouds(), {}) * torch.randn(10)).sum().backward()
    silent = [
        name for name, p in net.named_parameters() if p.grad is None or not bool(p.grad.abs().sum() > 0)
    ]
    assert not silent


def test_weights_travel_as_a_state_dict():
    net, other = build(), build()
    net(clouds(3), {})  # moves the running statistics
    with torch.no_grad():
        for p in net.parameters():
            p.add_(0.1)
    other.load_state_dict(net.state_dict())
    assert torch.equal(other.eval()(clouds(), {}), net.eval()(clouds(), {}))


def test_one_point_is_enough():
    out = build().eval()(clouds()[:, :1], {})
    assert out.shape == (2, 1, 10) and bool(out.isfinite().all())
