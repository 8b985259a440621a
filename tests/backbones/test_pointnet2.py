"""PointNet++: tables, invariances, gradients."""

import pytest
import torch
from torch.utils.data import default_collate

from pnet.backbones.pointnet2 import Level, PointNet2
from pnet.ops.gathering import gather_sum

N = 96


def build(neighbours: int = N, **changes) -> PointNet2:
    torch.manual_seed(0)
    levels = [Level(32, 0.05, neighbours, (8, 8)), Level(8, 0.15, neighbours, (8, 16))]
    return PointNet2(levels, [[16, 12], [12, 10]], **changes)


def clouds(seed: int = 0, batch: int = 2) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(batch, N, 3, generator=generator) * torch.tensor([0.1, 0.1, 0.03]) + torch.tensor(
        [0, 0, 0.6]
    )


def features(net: PointNet2, points: torch.Tensor) -> torch.Tensor:
    return net(points, net.tables(points))


def test_every_point_gets_features():
    net = build()
    assert features(net, clouds()).shape == (2, N, 10) and net.features == 10


def test_levels_are_prefixes_of_the_cloud():
    net, points = build(neighbours=4), clouds()
    tables = net.tables(points)
    shapes = {name: tuple(table.shape) for name, table in tables.items()}
    assert shapes == {
        "ball_1_0": (2, 32, 4),
        "near_1": (2, N, 3),
        "weight_1": (2, N, 3),
        "ball_2_0": (2, 8, 4),
        "near_2": (2, 32, 3),
        "weight_2": (2, 32, 3),
    }
    near = (points[0, tables["ball_1_0"][0]] - points[0, :32, None]).norm(dim=-1)
    assert float(near.max()) <= 0.05
    # a point of the level is its own nearest one there
    assert torch.equal(tables["near_1"][0, :32, 0], torch.arange(32))


def test_points_after_the_first_level_may_come_in_any_order():
    net, points = build().eval(), clouds()
    order = torch.cat([torch.arange(32), 32 + torch.randperm(N - 32)])
    torch.testing.assert_close(
        features(net, points[:, order]), features(net, points)[:, order], rtol=1e-4, atol=1e-6
    )


def test_other_clouds_of_the_batch_do_not_matter_in_evaluation():
    net, points = build().eval(), clouds()
    torch.testing.assert_close(features(net, points[:1]), features(net, points)[:1], rtol=1e-5, atol=1e-6)


def test_a_moved_cloud_has_the_same_features():
    net, points = build().eval(), clouds()
    moved = points + torch.tensor([0.25, -0.5, 0.125])
    torch.testing.assert_close(features(net, moved), features(net, points), rtol=1e-3, atol=1e-4)


def test_a_radius_scale_is_a_scale_of_the_cloud():
    points = clouds()
    plain, scaled = build().eval(), build(radius_scale=2.0).eval()
    torch.testing.assert_close(features(scaled, 2 * points), features(plain, points), rtol=1e-3, atol=1e-5)


def test_interpolating_a_constant_gives_it_back():
    tables = build().tables(clouds())
    constant = torch.full((2, 32, 5), 3.25)
    spread = gather_sum(constant, tables["near_1"], tables["weight_1"])
    torch.testing.assert_close(spread, torch.full((2, N, 5), 3.25))


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


def test_a_small_cloud_has_smaller_levels():
    net, points = build(neighbours=4).eval(), clouds()[:, :5]
    tables = net.tables(points)
    assert tables["ball_1_0"].shape == (2, 5, 4) and tables["ball_2_0"].shape == (2, 5, 4)
    assert features(net, points).shape == (2, 5, 10) and features(net, points[:, :1]).shape == (2, 1, 10)


@pytest.mark.parametrize("delayed", [True, False])
def test_scales_of_a_level_stand_side_by_side(delayed):
    torch.manual_seed(0)
    levels = [Level(32, [0.03, 0.06, 0.1], 8, [8, 12]), Level(8, [0.1, 0.2], 6, [16], delayed)]
    net, points = PointNet2(levels, [[16, 12], [12, 10]]), clouds()
    assert [step.features for step in net.abstraction] == [36, 32]
    tables = net.tables(points)
    assert [tuple(tables[f"ball_1_{s}"].shape) for s in range(3)] == [(2, 32, 8)] * 3
    assert [tuple(tables[f"ball_2_{s}"].shape) for s in range(2)] == [(2, 8, 6)] * 2
    near = (points[0, tables["ball_1_1"][0]] - points[0, :32, None]).norm(dim=-1)
    assert 0.03 < float(near.max()) <= 0.06
    assert features(net, points).shape == (2, N, 10)


def test_delayed_levels_keep_what_a_network_keeps():
    torch.manual_seed(0)
    levels = [Level(32, 0.05, N, (8, 8)), Level(8, 0.15, N, (8, 16), delayed=True)]
    net, points = PointNet2(levels, [[16, 12], [12, 10]]), clouds()
    (features(net, points) * torch.randn(10)).sum().backward()
    assert all(bool(p.grad.abs().sum() > 0) for p in net.parameters())
    net.eval()
    order = torch.cat([torch.arange(32), 32 + torch.randperm(N - 32)])
    moved = points[:, order] + torch.tensor([0.25, -0.5, 0.125])
    torch.testing.assert_close(features(net, moved), features(net, points)[:, order], rtol=1e-3, atol=1e-4)


def test_tables_found_scene_by_scene_give_the_same_features():
    net, points = build(neighbours=8).eval(), clouds(batch=3)
    each = [{name: table[0] for name, table in net.tables(cloud[None]).items()} for cloud in points]
    assert torch.equal(net(points, default_collate(each)), features(net, points))


def test_every_level_needs_its_way_up():
    with pytest.raises(ValueError, match="2 levels need as many propagation MLPs, got 1"):
        PointNet2([Level(8, 0.1, 4, [4]), Level(4, 0.1, 4, [4])], [[4]])


def test_a_delayed_level_without_features_below_has_one_layer():
    with pytest.raises(ValueError, match=r"delayed level needs features below it for its MLP \[8, 16\]"):
        PointNet2([Level(32, 0.05, 8, [8, 16], delayed=True)], [[12]])
    net = PointNet2([Level(32, 0.05, 8, [16], delayed=True)], [[12]])
    assert features(net, clouds()).shape == (2, N, 12)
