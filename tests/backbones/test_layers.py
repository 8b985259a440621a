"""The layers that backbones share."""

import torch

from pnet.backbones.layers import RowBatchNorm, centred, conv_block, shared_mlp


def test_row_batch_norm_is_over_all_rows():
    x = torch.randn(2, 5, 7, 3) * 4 + 1
    normed = RowBatchNorm(3)(x)
    torch.testing.assert_close(normed.flatten(0, -2).mean(0), torch.zeros(3), rtol=0, atol=1e-5)
    torch.testing.assert_close(normed.flatten(0, -2).std(0, correction=0), torch.ones(3), rtol=1e-4, atol=0)


def test_shared_mlp_treats_every_row_alike():
    mlp = shared_mlp([3, 8, 5]).eval()
    x = torch.randn(2, 6, 4, 3)
    assert mlp(x).shape == (2, 6, 4, 5)
    torch.testing.assert_close(mlp(x)[1, 2, 3], mlp(x[1, 2, 3][None])[0])
    assert bool((mlp(x) >= 0).all())


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
