"""PointSIFT: orientation encoding against gathered octants, invariances, gradients."""

import pytest
import torch
from torch import nn
from torch.utils.data import default_collate

from pnet.backbones.layers import Dense
from pnet.backbones.pointsift import Merge, OrientationEncoding, PointSIFT, ResidualEncoding, SiftLevel
from pnet.ops.neighbours import octants

N = 96
RADIUS = 0.04


def build(neighbours: int = 16, **changes) -> PointSIFT:
    torch.manual_seed(0)
    levels = [
        SiftLevel(0.03, [8], 40, 0.04, neighbours, [8, 12], [12, 10], [10]),
        SiftLevel(0.06, [12], 16, 0.08, neighbours, [12, 16], [16], [16, 14]),
        SiftLevel(0.12, [16, 20], 6, 0.2, neighbours, [20, 20], [18], [18, 18, 18], in_sequence=False),
    ]
    return PointSIFT(levels, **changes)


def clouds(seed: int = 0, batch: int = 2, n: int = N) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(batch, n, 3, generator=generator) * torch.tensor([0.1, 0.1, 0.03]) + torch.tensor(
        [0, 0, 0.6]
    )


def features(net: PointSIFT, points: torch.Tensor) -> torch.Tensor:
    return net(points, net.tables(points))


def linear_norm(layer: Dense, rows: torch.Tensor, activate: bool = True) -> torch.Tensor:
    """By torch's own functions, unfolded."""
    norm, training = layer.norm, layer.training
    kept = None if training else norm.running_mean, None if training else norm.running_var
    product = nn.functional.linear(rows, layer.linear.weight)
    out = nn.functional.batch_norm(product, *kept, norm.weight, norm.bias, training=training)
    return out.relu() if activate else out


def encoding_naive(encode: OrientationEncoding, points, given, table, radius: float, activate: bool = True):
    """Octants by their signs: concatenated along z, then y, then x."""
    B, n = points.shape[:2]
    cloud = torch.arange(B)[:, None]
    octant = {}
    for x in (0, 1):
        for y in (0, 1):
            for z in (0, 1):
                who = table[:, :, 4 * x + 2 * y + z]
                offset = (points[cloud, who] - points) / radius
                octant[x, y, z] = offset if given is None else torch.cat([offset, given[cloud, who]], -1)
    pairs = torch.stack([torch.cat([octant[x, y, 0], octant[x, y, 1]], -1) for x in (0, 1) for y in (0, 1)])
    by_z = linear_norm(encode.along_z, pairs.flatten(0, 2)).view(2, 2, B * n, -1)  # x, y
    sides = torch.stack([torch.cat([by_z[x, 0], by_z[x, 1]], -1) for x in (0, 1)])
    by_y = linear_norm(encode.along_y, sides.flatten(0, 1)).view(2, B * n, -1)  # x
    return linear_norm(encode.along_x, torch.cat([by_y[0], by_y[1]], -1), activate).view(B, n, -1)


def stirred(layer: nn.Module) -> nn.Module:
    torch.manual_seed(1)
    for module in layer.double().modules():
        if isinstance(module, nn.BatchNorm1d):
            nn.init.normal_(module.weight)
            nn.init.normal_(module.bias)
            nn.init.normal_(module.running_mean)
            nn.init.uniform_(module.running_var, 0.5, 2.0)
    return layer


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("C", [0, 5])
@pytest.mark.parametrize("activate", [True, False])
def test_an_orientation_encoding_merges_octants_along_z_then_y_then_x(training, C, activate):
    encode = stirred(OrientationEncoding(C, 6, RADIUS, activate)).train(training)
    points = (clouds().double() - torch.tensor([0.05, 0.05, 0.6])).requires_grad_()
    given = torch.randn(2, N, C).double().requires_grad_() if C else None
    table = octants(points, RADIUS)
    expected = encoding_naive(encode, points, given, table, RADIUS, activate)
    out = encode(points, given, table)
    assert out.shape == (2, N, 6) and bool((out < 0).any()) != activate
    torch.testing.assert_close(out, expected, rtol=1e-9, atol=1e-10)
    leaves = [points, *encode.parameters(), *([given] if C else [])]
    pattern = torch.linspace(-1, 1, out.numel(), dtype=out.dtype).view_as(out)
    found, wanted = (torch.autograd.grad((value * pattern).sum(), leaves) for value in (out, expected))
    for a, b in zip(found, wanted, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-9)


def silence(dense: Dense) -> None:
    """Makes a layer return zero."""
    nn.init.zeros_(dense.norm.weight)
    nn.init.zeros_(dense.norm.bias)


@pytest.mark.parametrize("C", [0, 4, 6])
def test_a_residual_encoding_adds_its_input(C):
    encode, points = ResidualEncoding(C, 6, RADIUS).eval(), clouds() - 0.1
    given = torch.randn(2, N, C) if C else None
    table = octants(points, RADIUS)
    assert (encode.match is None) == (C in (0, 6))
    inner = encode.second(points, encode.first(points, given, table), table)
    assert bool((inner < 0).any())  # the ReLU comes after the sum
    added = {0: torch.zeros(2, N, 6), 6: given}.get(C)
    added = encode.match(given) if added is None else added
    torch.testing.assert_close(encode(points, given, table), (inner + added).relu())
    silence(encode.second.along_x)
    torch.testing.assert_close(encode(points, given, table), added.relu())


class Recorder(nn.Module):
    """Remembers what it was given; returns its number in every channel."""

    def __init__(self, number: int, width: int) -> None:
        super().__init__()
        self.number, self.width = number, width
        self.given: list[torch.Tensor | None] = []

    def forward(self, points, features, octants):
        self.given.append(features)
        return torch.full((*points.shape[:2], self.width), float(self.number))


@pytest.mark.parametrize("in_sequence", [True, False])
def test_merged_modules_take_each_other_s_features_or_the_same(in_sequence):
    modules = [Recorder(1, 2), Recorder(2, 3), Recorder(3, 4)]
    merge = Merge(modules, [2, 3, 4], in_sequence).eval()
    points, given = clouds(n=5), torch.zeros(2, 5, 7)
    assert merge(points, given, None).shape == (2, 5, 4)
    first, second, third = (module.given[0] for module in modules)
    assert first is given
    if in_sequence:
        assert second.tolist() == torch.full((2, 5, 2), 1.0).tolist()
        assert third.tolist() == torch.full((2, 5, 3), 2.0).tolist()
    else:
        assert second is given and third is given
    row = torch.tensor([1.0, 1, 2, 2, 2, 3, 3, 3, 3])
    torch.testing.assert_close(merge(points, given, None)[0, 0], merge.merge(row[None])[0])


def test_a_single_module_is_not_merged():
    merge = Merge([Recorder(5, 2)], [2])
    assert merge.merge is None
    assert merge(clouds(n=3), None, None).tolist() == torch.full((2, 3, 2), 5.0).tolist()


def test_every_point_gets_features():
    net = build()
    assert features(net, clouds()).shape == (2, N, 10) and net.features == 10


def test_tables_of_every_level():
    shapes = {name: tuple(table.shape) for name, table in build().tables(clouds()).items()}
    assert shapes == {
        "octants_0": (2, N, 8),
        "ball_1_0": (2, 40, 16),
        "near_1": (2, N, 3),
        "weight_1": (2, N, 3),
        "octants_1": (2, 40, 8),
        "ball_2_0": (2, 16, 16),
        "near_2": (2, 40, 3),
        "weight_2": (2, 40, 3),
        "octants_2": (2, 16, 8),
        "ball_3_0": (2, 6, 16),
        "near_3": (2, 16, 3),
        "weight_3": (2, 16, 3),
    }


def test_points_after_the_first_level_may_come_in_any_order():
    net, points = build(neighbours=N).eval(), clouds()
    order = torch.cat([torch.arange(40), 40 + torch.randperm(N - 40)])
    torch.testing.assert_close(
        features(net, points[:, order]), features(net, points)[:, order], rtol=1e-4, atol=1e-6
    )


def test_other_clouds_of_the_batch_do_not_matter_in_evaluation():
    net, points = build().eval(), clouds()
    torch.testing.assert_close(features(net, points[:1]), features(net, points)[:1], rtol=1e-5, atol=1e-6)


def test_a_moved_cloud_has_the_same_features():
    net, points = build().eval(), (1024 * clouds()).round() / 1024  # the sum below is then exact
    moved = points + torch.tensor([0.25, -0.5, 0.125])
    torch.testing.assert_close(features(net, moved), features(net, points), rtol=1e-3, atol=1e-4)


def test_a_turned_cloud_has_other_features():
    net, points = build().eval(), clouds()
    turned = points[..., [1, 0, 2]]  # octants follow the axes
    change = features(net, turned) - features(net, points)
    assert bool((change.abs() > 1e-3).any())


def test_a_radius_scale_is_a_scale_of_the_cloud():
    points = clouds()
    plain, scaled = build().eval(), build(radius_scale=2.0).eval()
    torch.testing.assert_close(features(scaled, 2 * points), features(plain, points), rtol=1e-3, atol=1e-5)


def test_the_gradient_reaches_every_weight():
    net = build()
    (features(net, clouds()) * torch.randn(10)).sum().backward()
    silent = [
        name for name, p in net.named_parameters() if p.grad is None or not bool(p.grad.abs().sum() > 0)
    ]
    assert not silent


def test_weights_travel_as_a_state_dict():
    net, other = build(), build()
    features(net, clouds(3))  # moves the running statistics
    with torch.no_grad():
        for p in net.parameters():
            p.add_(0.1)
    other.load_state_dict(net.state_dict())
    assert torch.equal(features(other.eval(), clouds()), features(net.eval(), clouds()))


@pytest.mark.parametrize("n", [1, 5, 30])
def test_a_small_cloud_has_smaller_levels(n):
    net, points = build().eval(), clouds(n=n)
    out = features(net, points)
    assert out.shape == (2, n, 10) and bool(out.isfinite().all())
    assert net.tables(points)["ball_3_0"].shape == (2, min(n, 6), 16)


def test_tables_found_scene_by_scene_give_the_same_features():
    net, points = build().eval(), clouds(batch=3)
    each = [{name: table[0] for name, table in net.tables(cloud[None]).items()} for cloud in points]
    assert torch.equal(net(points, default_collate(each)), features(net, points))


def test_the_cloud_itself_is_left_alone():
    net, points = build(), clouds()
    before = points.clone()
    features(net, points)
    assert torch.equal(points, before)
