"""The layers that backbones share, against linear layers and batch norm on gathered, concatenated rows."""

import copy

import pytest
import torch
from torch import nn

from pnet.backbones.layers import (
    Dense,
    FeaturePropagation,
    RelativeDense,
    RowBatchNorm,
    SetAbstraction,
    centred,
    conv_block,
    shared_mlp,
)

RADIUS = 0.3


@pytest.fixture(autouse=True)
def seeded() -> None:
    torch.manual_seed(0)


def stirred(layer: nn.Module) -> nn.Module:
    """In double precision, with batch norms that do something."""
    layer.double()
    for module in layer.modules():
        if isinstance(module, nn.BatchNorm1d):
            nn.init.normal_(module.weight)
            nn.init.normal_(module.bias)
            nn.init.normal_(module.running_mean)
            nn.init.uniform_(module.running_var, 0.5, 2.0)
    return layer


def unfolded(linear: nn.Linear, norm: nn.BatchNorm1d) -> nn.Sequential:
    """Linear and batch norm of torch itself with the same numbers."""
    plain = nn.BatchNorm1d(norm.num_features).to(norm.weight)
    plain.load_state_dict(norm.state_dict())
    return nn.Sequential(copy.deepcopy(linear), plain).train(norm.training)


def apply(pair: nn.Sequential, rows: torch.Tensor, activate: bool = True) -> torch.Tensor:
    out = pair(rows.flatten(0, -2)).view(*rows.shape[:-1], -1)
    return out.relu() if activate else out


def gathered(points, features, index, radius: float) -> torch.Tensor:
    """[x_j − x_i; f_j] of every centre and neighbour: (B, M, k, 3 + C)."""
    cloud = torch.arange(len(points))[:, None, None]
    offset = (points[cloud, index] - points[:, : index.shape[1], None]) / radius
    return offset if features is None else torch.cat([offset, features[cloud, index]], -1)


def drawn(B=2, n=15, M=6, k=4, C=5):
    points, features = torch.randn(B, n, 3).double(), torch.randn(B, n, C).double()
    index = torch.randint(0, n, (B, M, k))
    return points.requires_grad_(), (features.requires_grad_() if C else None), index


def gradients(out: torch.Tensor, *leaves: torch.Tensor | None) -> list[torch.Tensor]:
    pattern = torch.linspace(-1, 1, out.numel(), dtype=out.dtype).view_as(out)
    return list(torch.autograd.grad((out * pattern).sum(), [leaf for leaf in leaves if leaf is not None]))


def assert_same(found, expected) -> None:
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-10)


def assert_same_statistics(norm: nn.BatchNorm1d, plain: nn.BatchNorm1d) -> None:
    assert_same([norm.running_mean, norm.running_var], [plain.running_mean, plain.running_var])
    assert int(norm.num_batches_tracked) == int(plain.num_batches_tracked)


def test_row_batch_norm_is_over_all_rows():
    x = torch.randn(2, 5, 7, 3) * 4 + 1
    normed = RowBatchNorm(3)(x)
    torch.testing.assert_close(normed.flatten(0, -2).mean(0), torch.zeros(3), rtol=0, atol=1e-5)
    torch.testing.assert_close(normed.flatten(0, -2).std(0, correction=0), torch.ones(3), rtol=1e-4, atol=0)


def test_a_folded_norm_is_the_norm_in_evaluation():
    norm = stirred(RowBatchNorm(4)).eval()
    x = torch.randn(3, 5, 4).double()
    scale, shift = norm.folded()
    torch.testing.assert_close(x * scale + shift, norm(x))


MODES = pytest.mark.parametrize("training", [True, False], ids=["training", "evaluation"])


@MODES
@pytest.mark.parametrize("activate", [True, False])
def test_a_dense_layer_is_linear_then_norm_then_relu(training, activate):
    layer = stirred(Dense(4, 6, activate)).train(training)
    plain = unfolded(layer.linear, layer.norm)
    x = torch.randn(2, 3, 7, 4).double().requires_grad_()
    out, expected = layer(x), apply(plain, x, activate)
    assert_same([out], [expected])
    assert bool((out < 0).any()) != activate
    assert_same(gradients(out, x, *layer.parameters()), gradients(expected, x, *plain.parameters()))
    assert_same_statistics(layer.norm, plain[1])


@MODES
def test_a_shared_mlp_is_one_dense_layer_after_another(training):
    mlp = stirred(shared_mlp([3, 8, 6, 5])).train(training)
    x = torch.randn(2, 9, 3).double()
    expected = x
    for layer in copy.deepcopy(mlp):
        expected = apply(unfolded(layer.linear, layer.norm), expected)
    assert len(mlp) == 3
    assert_same([mlp(x)], [expected])


def test_shared_mlp_treats_every_row_alike():
    mlp = shared_mlp([3, 8, 5]).eval()
    x = torch.randn(2, 6, 4, 3)
    assert mlp(x).shape == (2, 6, 4, 5)
    torch.testing.assert_close(mlp(x)[1, 2, 3], mlp(x[1, 2, 3][None])[0])
    assert bool((mlp(x) >= 0).all())


@MODES
@pytest.mark.parametrize("side", [1, 2, 4])
@pytest.mark.parametrize("C", [0, 5])
def test_relative_features_are_those_of_gathered_and_concatenated_rows(training, side, C):
    points, features, index = drawn(k=8, C=C)
    layer = stirred(RelativeDense(C, 7, RADIUS, side)).train(training)
    plain = unfolded(layer.linear, layer.norm)
    out = layer(points, features, index)
    rows = gathered(points, features, index, RADIUS).unflatten(2, (-1, side)).flatten(3)
    expected = apply(plain, rows)
    assert out.shape == (2, 6, 8 // side, 7)
    assert_same([out], [expected])
    leaves = points, features
    assert_same(
        gradients(out, *leaves, *layer.parameters()), gradients(expected, *leaves, *plain.parameters())
    )
    assert_same_statistics(layer.norm, plain[1])


@MODES
@pytest.mark.parametrize("C", [0, 5])
def test_the_largest_relative_feature_is_taken_before_the_norm(training, C):
    points, features, index = drawn(C=C)
    layer = stirred(RelativeDense(C, 7, RADIUS)).train(training)
    linear, norm = plain = unfolded(layer.linear, layer.norm)
    out = layer.largest(points, features, index)
    most = linear(gathered(points, features, index, RADIUS)).amax(2)
    expected = norm(most.flatten(0, 1)).view_as(most).relu()
    assert_same([out], [expected])
    leaves = points, features
    assert_same(
        gradients(out, *leaves, *layer.parameters()), gradients(expected, *leaves, *plain.parameters())
    )
    assert_same_statistics(layer.norm, plain[1])


def test_relative_features_do_not_move_with_the_cloud():
    points, features, index = drawn()
    layer = stirred(RelativeDense(5, 7, RADIUS)).eval()
    moved = points + torch.tensor([1.0, -2.0, 3.0])
    assert_same([layer(moved, features, index)], [layer(points, features, index)])
    assert_same([layer.largest(moved, features, index)], [layer.largest(points, features, index)])


def abstraction_naive(step: SetAbstraction, points, features, tables, radii) -> torch.Tensor:
    """PointNet++'s set abstraction, scale by scale, on gathered rows."""
    scales = []
    for s, (relative, radius) in enumerate(zip(step.relative, radii, strict=True)):
        index = tables[f"ball_1_{s}"]
        first = unfolded(relative.linear, relative.norm)
        if hasattr(step, "after"):
            rows = apply(first, gathered(points, features, index, radius))
            for layer in step.after[s]:
                rows = apply(unfolded(layer.linear, layer.norm), rows)
            scales.append(rows.amax(2))
        else:
            own = features
            for layer in step.before[s]:
                own = apply(unfolded(layer.linear, layer.norm), own)
            most = first[0](gathered(points, own, index, radius)).amax(2)
            scales.append(first[1](most.flatten(0, 1)).view_as(most).relu())
    return torch.cat(scales, -1)


@MODES
@pytest.mark.parametrize("delayed, C, mlp", [
    (False, 0, [8, 6]), (False, 5, [8, 6]), (False, 5, [8]),
    (True, 0, [8]), (True, 5, [8, 6]), (True, 5, [8]),
])  # fmt: skip
@pytest.mark.parametrize("radii", [[0.3], [0.2, 0.5]])
def test_set_abstraction_is_the_naive_one(training, delayed, C, mlp, radii):
    points, features, _ = drawn(C=C)
    tables = {f"ball_1_{s}": torch.randint(0, 15, (2, 6, 4 + s)) for s in range(len(radii))}
    step = stirred(SetAbstraction(C, radii, mlp, delayed)).train(training)
    expected = abstraction_naive(copy.deepcopy(step), points, features, tables, radii)
    out = step(points, features, tables, 1)
    assert out.shape == (2, 6, step.features) and step.features == len(radii) * mlp[-1]
    assert_same([out], [expected])
    assert_same(gradients(out, points, features), gradients(expected, points, features))


@MODES
@pytest.mark.parametrize("skip", [0, 3])
def test_feature_propagation_is_the_naive_one(training, skip):
    coarse = torch.randn(2, 6, 5).double().requires_grad_()
    own = torch.randn(2, 15, skip).double() if skip else None
    near, weight = torch.randint(0, 6, (2, 15, 3)), torch.rand(2, 15, 3).double()
    weight = weight / weight.sum(-1, keepdim=True)
    step = stirred(FeaturePropagation(5, skip, [8, 7])).train(training)
    rows = torch.stack([(weight[b, :, :, None] * coarse[b, near[b]]).sum(1) for b in range(2)])
    rows = rows if own is None else torch.cat([rows, own], -1)
    for layer in copy.deepcopy(step.mlp):
        rows = apply(unfolded(layer.linear, layer.norm), rows)
    out = step(coarse, own, {"near_2": near, "weight_2": weight}, 2)
    assert out.shape == (2, 15, 7)
    assert_same([out], [rows])
    assert_same(gradients(out, coarse), gradients(rows, coarse))


def test_conv_block_keeps_or_halves_the_size():
    image = torch.randn(1, 3, 8, 16)
    assert conv_block(3, 5)(image).shape == (1, 5, 8, 16)
    assert conv_block(3, 5, 2)(image).shape == (1, 5, 4, 8)


def test_centred_keeps_the_scale():
    points = torch.randn(2, 9, 3) + torch.tensor([3.0, 0, 7])
    torch.testing.assert_close(centred(points).mean(1), torch.zeros(2, 3), rtol=0, atol=1e-5)
    torch.testing.assert_close(
        torch.cdist(centred(points), centred(points)), torch.cdist(points, points), rtol=1e-3, atol=1e-3
    )
