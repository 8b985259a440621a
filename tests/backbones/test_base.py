"""What holds for every backbone of conf/backbone."""

from itertools import pairwise

import pytest
import torch
from omegaconf import OmegaConf
from torch import nn
from torch.utils.data import default_collate

from pnet.backbones.base import Backbone
from pnet.backbones.pointnet import PointNet
from pnet.backbones.pointnet2 import Level, PointNet2
from pnet.backbones.pointsift import PointSIFT, SiftLevel
from pnet.cli.app import config_dir
from pnet.cli.instantiate import instantiate
from pnet.ops.operators import plain_operators

CONFIGS = sorted((config_dir() / "backbone").glob("*.yaml"))
EVERY = pytest.mark.parametrize("name", [path.stem for path in CONFIGS])


def load(name: str) -> Backbone:
    torch.manual_seed(0)
    return instantiate(OmegaConf.load(config_dir() / "backbone" / f"{name}.yaml"))


def clouds(n: int = 300, batch: int = 2, seed: int = 0) -> torch.Tensor:
    """A bin's size, in front of the camera."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(batch, n, 3, generator=generator) * torch.tensor([0.15, 0.15, 0.05])
    return points + torch.tensor([-0.07, -0.07, 0.6])


def features(net: Backbone, points: torch.Tensor) -> torch.Tensor:
    return net(points, net.tables(points))


def test_there_is_a_config_for_each_backbone():
    targets = {OmegaConf.load(path)._target_.split(".")[-1] for path in CONFIGS}
    assert targets == {"PointNet", "PointNet2", "PointSIFT", "RangeUNet"}


@EVERY
@torch.inference_mode()
def test_every_point_of_any_cloud_gets_features(name):
    net = load(name).eval()
    for n in (300, 1):
        out = features(net, clouds(n))
        assert out.shape == (2, n, net.features) and bool(out.isfinite().all())


@EVERY
@torch.no_grad()
def test_references_give_the_same_features(name):
    # in double precision: an untrained network of many norms makes much of little differences
    net, points = load(name).double(), clouds().double()
    for module in net.modules():
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
            module.momentum = 1.0
    features(net, clouds(seed=1).double())  # statistics of such clouds: features of about 1
    net.eval()
    tables = net.tables(points)
    out = net(points, tables)
    with plain_operators():
        tables_plain = net.tables(points)
        plain = net(points, tables_plain)
    assert all(torch.equal(table, tables_plain[key]) for key, table in tables.items())
    torch.testing.assert_close(out, plain, rtol=1e-5, atol=1e-5)
    assert float(out.std()) > 0.1


@EVERY
def test_a_step_of_training_reaches_every_weight(name):
    net = load(name)
    (features(net, clouds()) * torch.randn(net.features)).sum().backward()
    silent = [n for n, p in net.named_parameters() if p.grad is None or not bool(p.grad.abs().sum() > 0)]
    assert not silent


# small ones of each kind
def small_pointnet() -> PointNet:
    return PointNet([8, 6], [10, 24], [16, 12, 10], 0.1)


def small_pointnet2() -> PointNet2:
    levels = [Level(60, [0.02, 0.05], 8, [8, 12]), Level(20, 0.1, 8, [12, 16], delayed=True)]
    return PointNet2(levels, [[16, 12], [12, 10]])


def small_pointsift() -> PointSIFT:
    return PointSIFT([SiftLevel(0.03, [8, 12], 30, 0.04, 8, [12, 16], [12, 10], [10, 8], in_sequence=False)])


SMALL = pytest.mark.parametrize("make", [small_pointnet, small_pointnet2, small_pointsift])


@SMALL
@pytest.mark.parametrize("training", [True, False])
def test_a_compiled_graph_is_the_module(make, training):
    torch.manual_seed(0)
    net, points = make().train(training), clouds(100)
    tables, pattern = net.tables(points), torch.randn(2, 100, net.features)
    state = {key: value.clone() for key, value in net.state_dict().items()}

    def run(call: nn.Module):
        net.load_state_dict(state)
        if not training:
            with torch.no_grad():
                return call(points, tables), []
        out = call(points, tables)
        return out.detach(), torch.autograd.grad((out * pattern).sum(), list(net.parameters()))

    expected, expected_grads = run(net)
    try:
        out, grads = run(torch.compile(net, backend="aot_eager", fullgraph=True))
    finally:
        torch._dynamo.reset()
    torch.testing.assert_close(out, expected, rtol=1e-4, atol=1e-5)
    for grad, expected_grad in zip(grads, expected_grads, strict=True):
        torch.testing.assert_close(grad, expected_grad, rtol=1e-3, atol=1e-3)


@SMALL
def test_short_floats_train(make):
    torch.manual_seed(0)
    net, points = make(), clouds(100)
    with torch.autocast("cpu", torch.bfloat16):
        out = features(net, points)
        out.float().square().sum().backward()
    assert out.shape == (2, 100, net.features) and bool(out.isfinite().all())
    for name, p in net.named_parameters():
        assert p.grad is not None and p.grad.dtype == torch.float32, name
        assert bool(p.grad.isfinite().all()), name
    assert all(bool(buffer.isfinite().all()) for buffer in net.buffers())


@SMALL
def test_tables_found_scene_by_scene_give_the_same_features(make):
    torch.manual_seed(0)
    net, points = make().eval(), clouds(100, batch=3)
    each = [{name: table[0] for name, table in net.tables(cloud[None]).items()} for cloud in points]
    together = default_collate(each)
    assert together.keys() == net.tables(points).keys()
    assert torch.equal(net(points, together), features(net, points))


@SMALL
def test_in_double_precision_the_features_are_the_same(make):
    torch.manual_seed(0)
    net, points = make().eval(), clouds(100)
    single = features(net, points)
    double = features(net.double(), points.double())
    assert double.dtype == torch.float64
    torch.testing.assert_close(single.double(), double, rtol=1e-3, atol=1e-4)


# Learned numbers, from the widths that the configs list: every layer is a linear one without bias and a
# batch norm, two numbers a channel.


def mlp(*widths: int) -> int:
    return sum(a * b + 2 * b for a, b in pairwise(widths))


def encoding(before: int, after: int) -> int:
    """Three 1 × 2 convolutions: over pairs of neighbours with their places, then over pairs of results."""
    return 2 * (3 + before) * after + 2 * after + 2 * (2 * after * after + 2 * after)


def residual(before: int, after: int) -> int:
    match = 0 if before in (0, after) else mlp(before, after)
    return encoding(before, after) + encoding(after, after) + match


COUNTS = {
    # the merged features: [64; 1024] → 512 in two products and one norm
    "pointnet": mlp(3, 64, 64) + mlp(64, 64, 128, 1024) + (64 + 1024) * 512 + 2 * 512 + mlp(512, 256, 128),
    "pointnet2": (
        mlp(3, 32, 32, 64)
        + mlp(3 + 64, 64, 64, 128)
        + mlp(3 + 128, 128, 128, 256)
        + mlp(3 + 256, 256, 256, 512)
        + mlp(512 + 256, 256, 256)
        + mlp(256 + 128, 256, 256)
        + mlp(256 + 64, 256, 128)
        + mlp(128, 128, 128, 128)
    ),
    "pointnet2_small": (
        mlp(3, 16, 16, 32) + mlp(3 + 32, 32, 32, 64) + mlp(64 + 32, 64, 64) + mlp(64, 64, 64)
    ),
    # three scales a level, whose features stand side by side
    "pointnet2_msg": (
        3 * mlp(3, 32, 32, 64)
        + 3 * mlp(3 + 192, 64, 64, 128)
        + 3 * mlp(3 + 384, 128, 128, 256)
        + 3 * mlp(3 + 768, 256, 256, 512)
        + mlp(1536 + 768, 512, 512)
        + mlp(512 + 384, 256, 256)
        + mlp(256 + 192, 256, 128)
        + mlp(128, 128, 128, 128)
    ),
    # per level: MLP of each point, then its last layer on [place; features]
    "pointnet2_delayed": (
        mlp(3, 32, 64)
        + (mlp(64, 64) + mlp(3 + 64, 96))
        + (mlp(96, 128, 128) + mlp(3 + 128, 192))
        + (mlp(192, 256) + mlp(3 + 256, 256))
        + mlp(256 + 192, 256, 192)
        + mlp(192 + 96, 192, 128)
        + mlp(128 + 64, 128, 96)
        + mlp(96, 96, 96, 64)
    ),
    "pointsift": (
        # down: residual encodings (the third level has two and merges them), set abstraction
        residual(0, 64)
        + mlp(3 + 64, 64, 128)
        + residual(128, 128)
        + mlp(3 + 128, 128, 256)
        + (residual(256, 256) + residual(256, 512) + mlp(256 + 512, 512))
        + mlp(3 + 512, 512, 512)
        # up: propagation beside the features from before a level's encodings, encodings and their merger
        + mlp(512 + 256, 512, 512)
        + (3 * encoding(512, 512) + mlp(3 * 512, 512))
        + mlp(512 + 128, 256, 256)
        + (2 * encoding(256, 256) + mlp(2 * 256, 256))
        + mlp(256, 128, 128, 128)
        + encoding(128, 128)
    ),
}


@pytest.mark.parametrize("name", COUNTS)
def test_the_number_of_weights_is_that_of_the_widths(name):
    assert sum(p.numel() for p in load(name).parameters()) == COUNTS[name]


def test_the_numbers_of_weights_are_the_published_ones():
    # PointNet++ with these widths: 1.0 M with its head of 13 classes (PointNeXt, Qian et al. 2022, Table 1)
    head = mlp(128, 128) + 128 * 13 + 13
    assert 0.9e6 < COUNTS["pointnet2"] < COUNTS["pointnet2"] + head < 1.0e6
    assert round((COUNTS["pointnet2"] + head) / 1e6, 1) == 1.0
    # PointNet without transformation nets as a classifier of 40 shapes: 0.8 M (Qi et al. 2017)
    net = load("pointnet")
    encoder = sum(p.numel() for p in [*net.local.parameters(), *net.wide.parameters()])
    assert encoder == mlp(3, 64, 64, 64, 128, 1024)
    classifier = mlp(1024, 512, 256) + 256 * 40 + 40
    assert round((encoder + classifier) / 1e6, 1) == 0.8
