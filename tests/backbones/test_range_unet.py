"""The range-image U-Net: cells, invariances, gradients."""

import math

import pytest
import torch

from pnet.backbones.range_unet import RangeUNet, _rasterise

CELL, DEPTH, DEPTH_SCALE = 0.004, 0.6, 0.02
N = 150


def build(**changes) -> RangeUNet:
    torch.manual_seed(0)
    settings = dict(channels=[8, 12, 16], cell=CELL, depth=DEPTH, depth_scale=DEPTH_SCALE, features=10)
    return RangeUNet(**{**settings, **changes})


def clouds(seed: int = 0, batch: int = 2, width: float = 0.1) -> torch.Tensor:
    """Clouds that span exactly the same directions, so that they need the same grid."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(batch, N, 3, generator=generator) - 0.5
    points[:, 0], points[:, 1] = torch.tensor([-0.5, -0.5, 0.0]), torch.tensor([0.5, 0.5, 0.0])
    z = 0.6 + 0.05 * points[..., 2:]
    return torch.cat([points[..., :2] * (width / 0.6) * z, z], -1)


def features(net: RangeUNet, points: torch.Tensor) -> torch.Tensor:
    return net(points, net.tables(points))


def naive_tables(points: torch.Tensor, multiple: int):
    """Cell and place of every point, one point at a time."""
    angle = CELL / DEPTH
    clouds = points.double().tolist()
    seen = [[(x / z / angle, y / z / angle) for x, y, z in cloud] for cloud in clouds]
    extent = [[max(p[a] for p in cloud) - min(p[a] for p in cloud) for a in (0, 1)] for cloud in seen]
    size = [multiple * math.ceil((math.floor(max(e[a] for e in extent)) + 1) / multiple) for a in (0, 1)]
    cell, local = [], []
    for b, cloud in enumerate(seen):
        low = [min(p[a] for p in cloud) for a in (0, 1)]
        mean = sum(p[2] for p in clouds[b]) / len(cloud)
        rows, places = [], []
        for i, p in enumerate(cloud):
            place = [p[a] - low[a] + (size[a] - extent[b][a]) / 2 for a in (0, 1)]
            whole = [min(math.floor(place[a]), size[a] - 1) for a in (0, 1)]
            rows.append(whole[1] * size[0] + whole[0])
            middle = [place[a] - whole[a] - 0.5 for a in (0, 1)]
            places.append([*middle, (clouds[b][i][2] - mean) / DEPTH_SCALE])
        cell.append(rows)
        local.append(places)
    return torch.tensor(cell), torch.tensor(local), [size[1], size[0]]


def test_tables_are_those_of_the_naive_loop():
    points = torch.cat([clouds(1, 1, 0.1), clouds(2, 1, 0.16)])
    tables = build().tables(points)
    cell, local, size = naive_tables(points, 4)
    assert tables["grid"].shape == (*size, 0)
    assert float((tables["cell"] == cell).float().mean()) > 0.99  # float32 may round over an edge
    same = tables["cell"] == cell
    torch.testing.assert_close(tables["local"][same], local[same].float(), rtol=0, atol=2e-4)


def test_the_grid_is_as_large_as_the_cloud_and_a_multiple_of_the_coarsest_cell():
    rows, columns, _ = build().tables(clouds(width=0.1))["grid"].shape
    assert (rows, columns) == (28, 28)  # 0.1 / 0.004 = 25 cells and one, in fours
    assert build(channels=[8, 12, 16, 16]).tables(clouds(width=0.1))["grid"].shape == (32, 32, 0)


def test_places_lie_within_their_cells():
    local = build().tables(clouds())["local"]
    assert float(local[..., :2].abs().max()) <= 0.5 + 1e-4
    torch.testing.assert_close(local[..., 2].mean(1), torch.zeros(2), rtol=0, atol=1e-4)


def test_rasterise_takes_the_mean_of_each_cell():
    cell = torch.tensor([[0, 5, 5]])
    local = torch.tensor([[[0.1, 0.2, 1.0], [0.0, 0.4, 2.0], [0.2, 0.0, 4.0]]])
    image = _rasterise(cell, local, 2, 3)
    assert image.shape == (1, 4, 2, 3)
    torch.testing.assert_close(image[0, :, 0, 0], torch.tensor([0.1, 0.2, 1.0, 1.0]))
    torch.testing.assert_close(image[0, :, 1, 2], torch.tensor([0.1, 0.2, 3.0, 1.0]))
    assert int(image.count_nonzero()) == 8


def test_every_point_gets_features():
    assert features(build(), clouds()).shape == (2, N, 10)


def test_points_may_come_in_any_order():
    net, points, order = build().eval(), clouds(), torch.randperm(N)
    torch.testing.assert_close(
        features(net, points[:, order]), features(net, points)[:, order], rtol=1e-3, atol=1e-4
    )


def test_other_clouds_of_the_same_extent_do_not_matter_in_evaluation():
    net, points = build().eval(), clouds()
    torch.testing.assert_close(features(net, points[:1]), features(net, points)[:1], rtol=1e-4, atol=1e-5)


def test_moved_along_its_rays_a_cloud_keeps_its_cells():
    points = clouds()
    tables, moved = build().tables(points), build().tables(1.25 * points)
    assert float((tables["cell"] == moved["cell"]).float().mean()) > 0.99
    same = tables["cell"] == moved["cell"]
    expected = tables["local"] * torch.tensor([1, 1, 1.25])
    torch.testing.assert_close(moved["local"][same], expected[same], rtol=0, atol=3e-4)


def test_the_gradient_reaches_every_weight():
    net = build()
    (features(net, clouds()) * torch.randn(10)).sum().backward()
    silent = [
        name for name, p in net.named_parameters() if p.grad is None or not bool(p.grad.abs().sum() > 0)
    ]
    assert not silent


def test_weights_travel_as_a_state_dict():
    net, other = build(), build()
    features(net, clouds(3))
    with torch.no_grad():
        for p in net.parameters():
            p.add_(0.1)
    other.load_state_dict(net.state_dict())
    torch.testing.assert_close(features(other.eval(), clouds()), features(net.eval(), clouds()))


def test_one_point_is_enough():
    net = build().eval()
    assert bool(features(net, torch.tensor([[[0.01, 0.02, 0.6]]])).isfinite().all())


@pytest.mark.parametrize("changes", [{"channels": [8]}, {"cell": 0}, {"depth": -1}, {"depth_scale": 0}])
def test_sizes_that_make_no_grid_are_refused(changes):
    with pytest.raises(ValueError, match="at least two levels and positive cell, depth, depth_scale"):
        build(**changes)


def test_slopes_widen_the_first_layer_and_change_nothing_else():
    plain, seeing = ({k: tuple(v.shape) for k, v in build(slopes=s).state_dict().items()} for s in (None, 2))
    assert plain.keys() == seeing.keys()
    (wider,) = (name for name in plain if plain[name] != seeing[name])
    assert wider == next(iter(plain))
    assert plain[wider] == (8, 4, 3, 3) and seeing[wider] == (8, 7, 3, 3)


def test_what_the_slopes_say_reaches_the_first_layer():
    """With the weights of the image alone the network is the one without slopes; with others it is not."""
    plain, seeing = build().eval(), build(slopes=2).eval()
    weights = dict(plain.state_dict())
    first = next(iter(weights))
    blind = torch.cat([weights[first], torch.zeros(8, 3, 3, 3)], 1)
    seeing.load_state_dict({**weights, first: blind})
    points = clouds()
    torch.testing.assert_close(features(seeing, points), features(plain, points), rtol=0, atol=1e-5)
    seeing.load_state_dict({**weights, first: blind + 0.1})
    without = {**weights, first: weights[first] + 0.1}
    plain.load_state_dict(without)
    assert float((features(seeing, points) - features(plain, points)).detach().abs().max()) > 1e-3
