"""Costs of a network, against counts by hand."""

import pytest
import torch

from pnet.backbones.pointnet import PointNet
from pnet.models.parametricnet import ParametricNet
from pnet.models.summary import summarise

N = 40


@pytest.fixture
def network() -> ParametricNet:
    torch.manual_seed(0)
    backbone = PointNet([8], [16], [12, 10], scale=0.1)
    return ParametricNet(backbone, 2, hidden=[6], visibility_hidden=[5], scale=0.02, visibility=True)


def test_parameters_and_operations_are_those_by_hand(network):
    found = summarise(network, torch.rand(N, 3))
    norms = 2 * (8 + 16 + 12 + 10 + 6 + 6 + 5)
    products = 3 * 8 + 8 * 16 + 8 * 12 + 12 * 10 + 10 * 6 + 6 * 3 + 10 * 6 + 6 * 6 + 10 * 5 + 5 * 1
    of_cloud, biases = 16 * 12, 3 + 6 + 1
    assert found.parameters == norms + products + of_cloud + biases
    assert found.operations == N * products + of_cloud
    assert (found.backbone, found.points) == ("PointNet", N)


def test_what_is_kept_grows_with_the_cloud_and_counts_no_weights(network):
    small, large = (summarise(network, torch.rand(n, 3)).kept_bytes for n in (200, 400))
    channels = 3 + 8 + 16 + 12 + 10 + 6 + 6 + 5
    # at least the input of every product, and not more than a handful of copies of it
    assert 4 * channels * 200 < small < 8 * 4 * channels * 200
    assert large == pytest.approx(2 * small, rel=0.05)


def test_counting_leaves_the_network_as_it_is(network):
    before = {name: value.clone() for name, value in network.state_dict().items()}
    network.eval()
    summarise(network, torch.rand(N, 3))
    assert not network.training and all(p.grad is None for p in network.parameters())
    assert all(torch.equal(value, before[name]) for name, value in network.state_dict().items())


def test_it_reads_as_a_line(network):
    text = str(summarise(network, torch.rand(N, 3)))
    assert text.startswith("PointNet: 0.00 M parameters; a scene of 40 points takes 0.00 G multiply-adds")
