"""Clouds of many kinds, on which every kernel has to agree with its reference."""

from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

N = 1100  # more than a ball query tries before it asks the tree


def _random(g: torch.Generator) -> Tensor:
    return torch.rand(2, N, 3, generator=g)


def _clustered(g: torch.Generator) -> Tensor:
    """Two dense groups ten metres apart and a stray point far from both."""
    points = 0.05 * torch.rand(2, N, 3, generator=g)
    points[:, N // 2 :, 0] += 10
    points[:, 300] = 100.0
    return points


def _grid(g: torch.Generator) -> Tensor:
    """Few places, so that many points coincide and most distances are ties."""
    return torch.randint(0, 7, (2, N, 3), generator=g).double()


def _rounded_grid(g: torch.Generator) -> Tensor:
    """Ties among numbers that no float holds exactly."""
    return 0.1234567 * _grid(g)


def _line(g: torch.Generator) -> Tensor:
    return torch.rand(2, N, 1, generator=g) * torch.tensor([1.0, -2.0, 0.5])


def _plane(g: torch.Generator) -> Tensor:
    return torch.rand(2, N, 3, generator=g) * torch.tensor([1.0, 1.0, 0.0])


def _far_away(g: torch.Generator) -> Tensor:
    """So far from the origin that a float32 resolves a hundredth of the cloud."""
    return 0.01 * torch.rand(2, 400, 3, generator=g) + 1000


def _one_place(g: torch.Generator) -> Tensor:
    return torch.full((2, 200, 3), 0.25)


def _few(g: torch.Generator) -> Tensor:
    return torch.rand(3, 5, 3, generator=g)


def _single(g: torch.Generator) -> Tensor:
    return torch.rand(2, 1, 3, generator=g)


KINDS = [_random, _clustered, _grid, _rounded_grid, _line, _plane, _far_away, _one_place, _few, _single]


@pytest.fixture(params=KINDS, ids=lambda make: make.__name__.strip("_"))
def kind(request: pytest.FixtureRequest) -> Tensor:
    """(B, N, 3) metres, double precision."""
    return request.param(torch.Generator().manual_seed(0)).double()


@pytest.fixture(params=[torch.float32, torch.float64], ids=["single", "double"])
def clouds(request: pytest.FixtureRequest, kind: Tensor) -> Tensor:
    """(B, N, 3) metres."""
    return kind.to(request.param)


@pytest.fixture
def threads() -> Iterator[None]:
    """Puts torch's number of threads back."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)
