"""Mean shift's searches: CUDA kernels against the CPU's and plain torch."""

import pytest
import torch

from pnet.postprocess import climb as plain
from pnet.postprocess.cpu import climb as compiled
from pnet.postprocess.cuda import climb as kernels
from pnet.postprocess.kernels import Kernels, only
from pnet.postprocess.mean_shift import find_seeds

REACH, STOP = 0.006, 6e-6


def votes(bodies: int, points: int, seed: int) -> torch.Tensor:
    """(points, 3) about some places, a tenth anywhere."""
    g = torch.Generator().manual_seed(seed)
    middle = torch.rand(bodies, 3, generator=g, dtype=torch.float64) * torch.tensor([0.05, 0.05, 0.02]) + 0.5
    near = middle[torch.randint(bodies, (points,), generator=g)]
    near += 0.001 * torch.randn(points, 3, generator=g, dtype=torch.float64)
    near[: points // 10] = 0.05 * torch.rand(points // 10, 3, generator=g, dtype=torch.float64) + 0.5
    return near


@pytest.fixture(scope="module")
def scenes():
    """Two scenes of 130 votes, some of which don't count, and what they are searched by.

    In different places and of different sizes, so each has a grid of its own.
    """
    points = torch.stack([votes(3, 130, 0), 1.5 * votes(6, 130, 1) + torch.tensor([0.4, -0.9, 0.1])])
    counted = torch.rand(2, 130, generator=torch.Generator().manual_seed(2)) < 0.85
    return points, counted, find_seeds(points, counted, REACH, 4)


def test_seeds_climb_to_where_they_climb_on_the_cpu(here, scenes):
    """With seeds that see nothing, and with more than one that gets to the same mode."""
    points, counted, seeds = scenes
    seeds = torch.cat([seeds, torch.tensor([[[9.0, 9, 9]], [[0.5, -0.2, 0.5]]]).double()], 1)
    assert bool(seeds.isnan().any())
    given = points, counted, seeds, REACH, STOP, 300
    centres, intensity = (x.cpu() for x in kernels.climb(*here(*given)))
    with only(Kernels.PLAIN):
        expected = plain.climb(*given)
    for other in (compiled.climb(*given), expected):
        torch.testing.assert_close(centres, other[0], rtol=0, atol=1e-12, equal_nan=True)
        assert torch.equal(intensity, other[1])
    assert intensity[:, -1].tolist() == [0, 0] and torch.equal(centres[:, -1], seeds[:, -1])
    assert int(intensity.max()) > 20 and len(centres[0, :-1].unique(dim=0)) < seeds.shape[1] - 1


def test_seeds_that_see_the_same_points_get_the_very_same_mean(here):
    """From eight sides, so through eight different neighbourhoods of cells."""
    ball = votes(1, 60, 3)[6:]
    corner = torch.tensor([[x, y, z] for x in (-1.0, 1) for y in (-1.0, 1) for z in (-1.0, 1)]).double()
    seeds = ball.mean(0) + 0.003 * corner
    points = torch.cat([ball, ball.mean(0) + 0.05 * corner])
    everything = torch.ones(1, len(points), dtype=torch.bool)
    centres, intensity = kernels.climb(*here(points[None], everything, seeds[None], 0.012, 1e-9, 300))
    assert intensity.tolist() == [[54.0] * 8]
    assert bool((centres == centres[:, :1]).all())


def test_a_climb_ends_after_so_many_steps(here):
    points = 0.004 * torch.arange(40.0, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0, 0])
    points[20:, 0] *= 1.01  # denser on the left
    given = points[None], torch.ones(1, 40, dtype=torch.bool), points[None, ::7], 0.02, 1e-12
    for steps in (1, 2, 5):
        found, expected = kernels.climb(*here(*given, steps)), compiled.climb(*given, steps)
        torch.testing.assert_close(found[0].cpu(), expected[0], rtol=0, atol=1e-15)
        assert torch.equal(found[1].cpu(), expected[1])


def test_without_seeds_nothing_climbs(here, scenes):
    points, counted, seeds = scenes
    centres, intensity = kernels.climb(*here(points, counted, seeds[:, :0], REACH, STOP, 300))
    assert centres.shape == (2, 0, 3) and intensity.shape == (2, 0)


@pytest.mark.parametrize("s", [1, 37, 64])
@pytest.mark.parametrize("width", [0.004, 0.03, 0.2])
def test_the_same_modes_stay_as_on_the_cpu(here, s, width):
    g = torch.Generator().manual_seed(s)
    centres = width * torch.rand(3, s, 3, generator=g, dtype=torch.float64)
    centres[2] = 0.003 * torch.arange(s)[:, None] * torch.tensor([1.0, 0, 0])  # at the very limit
    seen = torch.rand(3, s, generator=g) < 0.8
    seen[1] = False
    centres[1] = torch.nan
    seen = seen.mT.contiguous().mT  # in another order in memory
    expected = compiled.distinct(centres, seen, REACH)
    assert torch.equal(kernels.distinct(*here(centres, seen, REACH)).cpu(), expected)
    with only(Kernels.PLAIN):
        assert torch.equal(plain.distinct(centres, seen, REACH), expected)


@pytest.mark.parametrize("n", [1, 130])
def test_points_go_to_the_mode_they_go_to_on_the_cpu(here, scenes, n):
    """Modes of one scene, none of the other; in a third two are equally near."""
    points = torch.cat([scenes[0], scenes[0][:1]])[:, :n]
    modes = torch.stack([scenes[0][0, 20:30], scenes[0][1, :10], scenes[0][0, [30] * 5 + [31] * 5]])
    number = torch.tensor([10, 0, 10])
    labels = kernels.nearest_mode(*here(points, modes, number, REACH)).cpu()
    assert torch.equal(labels, compiled.nearest_mode(points, modes, number, REACH))
    with only(Kernels.PLAIN):
        assert torch.equal(labels, plain.nearest_mode(points, modes, number, REACH))
    assert set(labels[1].tolist()) == {-1} and set(labels[2].tolist()) <= {-1, 0, 5}
