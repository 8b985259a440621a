"""The heads' shapes, scale and ranges."""

import pytest
import torch

from pnet.models.heads import OffsetHead, VisibilityHead


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
