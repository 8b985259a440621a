"""The heads' shapes, scale and ranges."""

import math

import pytest
import torch

from pnet.models.heads import DoubtHead, OffsetHead, SizeHead, VisibilityHead


@pytest.mark.parametrize("scale", [1.0, 0.02])
def test_an_offset_head_adds_scaled_offsets_to_the_point(scale):
    head = OffsetHead(4, [8], targets=2, scale=scale).eval()
    with torch.no_grad():
        head.last.weight.zero_()
        head.last.bias.copy_(torch.tensor([1.0, 2, 3, 4, 5, 6]))
    points = torch.randn(2, 5, 3)
    found = head(torch.randn(2, 5, 4), points)
    assert found.shape == (2, 5, 2, 3)
    torch.testing.assert_close(found[..., 0, :], points + scale * torch.tensor([1.0, 2, 3]))
    torch.testing.assert_close(found[..., 1, :], points + scale * torch.tensor([4.0, 5, 6]))


def test_visibility_lies_between_zero_and_one():
    head = VisibilityHead(4, [8, 6])
    found = head(100 * torch.randn(2, 500, 4))
    assert found.shape == (2, 500) and 0 <= float(found.min()) < float(found.max()) <= 1
    with torch.no_grad():
        head.last.weight.zero_(), head.last.bias.zero_()
    torch.testing.assert_close(head(torch.randn(1, 3, 4)), torch.full((1, 3), 0.5))


def test_a_size_head_says_metres():
    head = SizeHead(4, [8, 6], parameters=3, scale=0.02)
    with torch.no_grad():
        head.last.weight.zero_(), head.last.bias.copy_(torch.tensor([1.0, 0.5, -2]))
    found = head(torch.randn(2, 5, 4))
    assert found.shape == (2, 5, 3)
    torch.testing.assert_close(found, torch.tensor([0.02, 0.01, -0.04]).expand(2, 5, 3))


def test_doubt_starts_from_its_scale_and_grows_by_factors():
    head = DoubtHead(4, [8], targets=3, scale=0.002)
    with torch.no_grad():
        head.last.weight.zero_(), head.last.bias.copy_(torch.tensor([0.0, math.log(5), -math.log(4)]))
    found = head(torch.randn(2, 7, 4))
    torch.testing.assert_close(found, torch.tensor([0.002, 0.010, 0.0005]).expand(2, 7, 3))


def test_doubt_stays_within_a_factor_of_a_thousand():
    """Whatever the features: never zero, by which votes are divided, nor infinite."""
    head = DoubtHead(4, [8], targets=2, scale=0.002).eval()
    with torch.no_grad():
        head.last.weight.zero_(), head.last.bias.copy_(torch.tensor([1e6, -1e6]))
    most, least = head(torch.randn(1, 1, 4)).flatten().tolist()
    assert 1.9 < most < 2.0 and 2e-6 < least < 2.1e-6
    head.last.reset_parameters()
    found = head(1e4 * torch.randn(2, 500, 4)).detach()
    assert found.shape == (2, 500, 2) and 2e-6 < float(found.min()) < float(found.max()) < 2.0


@pytest.mark.parametrize("head", [SizeHead(4, [8], 2, 0.02), DoubtHead(4, [8], 2, 0.002)])
def test_lengths_are_of_single_precision_under_autocast(head):
    with torch.autocast("cpu", torch.bfloat16):
        assert head(torch.randn(1, 3, 4)).dtype == torch.float32
