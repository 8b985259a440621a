"""Plane fits in a range image: by hand, and window by window with numpy."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pnet.backbones.slopes import RELIEF, RIDGE, SLOPE_FEATURES, SurfaceSlopes

SCALE, CELL = 0.02, 0.002  # metres a unit of depth, metres a cell


def range_image(z: torch.Tensor, seen: torch.Tensor | None = None, seed: int | None = None) -> torch.Tensor:
    """(1, 4, rows, columns) of depths (rows, columns) in units; the surface seen in the middle of every cell,
    or with a seed anywhere in it."""
    places = torch.zeros(2, *z.shape)
    if seed is not None:
        places = torch.rand(2, *z.shape, generator=torch.Generator().manual_seed(seed)) - 0.5
    seen = torch.ones_like(z) if seen is None else seen.to(z)
    return (torch.cat([places.to(z), z[None], torch.ones_like(z)[None]]) * seen)[None]


def plane(slope_x: float, slope_y: float, rows: int = 11, columns: int = 13, seed: int | None = None):
    """A plane of these slopes, metres a metre, seen where the seed says."""
    image = range_image(torch.zeros(rows, columns), seed=seed)
    y, x = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    image[0, 2] = (slope_x * (x + image[0, 0]) + slope_y * (y + image[0, 1])) * CELL / SCALE + 0.7
    return image


def naive(image: torch.Tensor, radius: int) -> np.ndarray:
    """(3, rows, columns) window by window: least squares with the ridge as two more rows."""
    x, y, z, seen = image[0].double().numpy()
    rows, columns = seen.shape
    found = np.zeros((3, rows, columns))
    for i in range(rows):
        for j in range(columns):
            window = [
                (x[a, b] + b - j, y[a, b] + a - i, z[a, b])
                for a in range(max(i - radius, 0), min(i + radius + 1, rows))
                for b in range(max(j - radius, 0), min(j + radius + 1, columns))
                if seen[a, b]
            ]
            if not window:
                continue
            cells = np.array(window)
            mean = cells.mean(0)
            ridge = np.eye(2) * math.sqrt(len(cells) * RIDGE)
            wanted = np.r_[cells[:, 2] - mean[2], 0, 0]
            slope = np.linalg.lstsq(np.r_[cells[:, :2] - mean[:2], ridge], wanted, rcond=None)[0]
            tilt = slope * SCALE / CELL
            found[:2, i, j] = tilt / math.sqrt(1 + tilt @ tilt)
            if seen[i, j]:
                off = z[i, j] - mean[2] - slope @ (np.array([x[i, j], y[i, j]]) - mean[:2])
                found[2, i, j] = math.tanh(off * SCALE / RELIEF)
    return found


@pytest.mark.parametrize("radius", [1, 2, 3])
@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.5, 0.0), (0.0, -0.3), (1.0, 2.0)])
def test_a_plane_has_its_own_normal_but_for_the_ridge(radius, slopes):
    """The columns of a window lie at −r … r: their variance is r (r + 1) / 3 square cells."""
    found = SurfaceSlopes(radius, SCALE, CELL)(plane(*slopes))[0]
    assert found.shape == (SLOPE_FEATURES, 11, 13)
    variance = radius * (radius + 1) / 3
    tilt = np.array(slopes) * variance / (variance + RIDGE)
    normal = tilt / math.sqrt(1 + tilt @ tilt)
    inner = found[:, radius:-radius, radius:-radius]
    expected = torch.tensor([*normal, 0.0])[:, None, None].expand_as(inner)
    torch.testing.assert_close(inner, expected.to(inner), rtol=0, atol=2e-4)


def test_a_slope_of_one_metre_a_metre_is_45_degrees_up_to_the_ridge():
    """Depth grows by a cell's width each cell: a tenth of a unit here."""
    image = plane(1.0, 0.0)
    assert float(image[0, 2, 0, 1] - image[0, 2, 0, 0]) == pytest.approx(CELL / SCALE)
    normal = SurfaceSlopes(5, SCALE, CELL)(image)[0, :2, 5, 6]  # variance 10, so 1% off
    assert normal.tolist() == pytest.approx([math.sin(math.atan(10 / 10.1)), 0], abs=1e-4)


@given(x=st.floats(-3, 3), y=st.floats(-3, 3), seed=st.integers(0, 10**6), radius=st.integers(1, 3))
def test_the_ridge_makes_planes_flatter_never_steeper(x, y, seed, radius):
    """With holes too; in a whole window by a share of RIDGE / (least variance + RIDGE) at most."""
    image = plane(x, y, 9, 9, seed)
    whole = SurfaceSlopes(radius, SCALE, CELL)(image)[0, :2, 4, 4].double()
    seen = torch.rand(9, 9, generator=torch.Generator().manual_seed(seed)) < 0.4
    holed = SurfaceSlopes(radius, SCALE, CELL)(image * seen)[0, :2].double()
    tilt = math.hypot(x, y)
    for normal in (whole, *holed.flatten(1).T):
        length = float(normal.norm())
        assert length / math.sqrt(1 - length**2) <= tilt + 2e-3 * (1 + tilt**2)
    least = float(torch.linalg.eigvalsh(_covariance(image, radius))[0])
    length = float(whole.norm())
    assert length / math.sqrt(1 - length**2) >= tilt * least / (least + RIDGE) - 2e-3 * (1 + tilt**2)


def _covariance(image: torch.Tensor, radius: int) -> torch.Tensor:
    """(2, 2) of the places in the window about the cell (4, 4)."""
    y, x = torch.meshgrid(torch.arange(9), torch.arange(9), indexing="ij")
    window = slice(4 - radius, 5 + radius)
    places = torch.stack([(x + image[0, 0])[window, window], (y + image[0, 1])[window, window]])
    return torch.cov(places.flatten(1).double(), correction=0)


def test_a_step_by_hand():
    """Depths 0 0 0 | h h h. Beside the step a window has 0 0 h: mean h / 3, slope h / (2 + 3 RIDGE)."""
    h = 0.03
    z = torch.zeros(5, 6)
    z[:, 3:] = h
    found = SurfaceSlopes(1, SCALE, CELL)(range_image(z))[0, :, 2]
    tilt = h / (2 + 3 * RIDGE) * SCALE / CELL
    assert found[0, [2, 3]].tolist() == pytest.approx([tilt / math.hypot(1, tilt)] * 2, abs=1e-6)
    assert found[0, [1, 4]].tolist() == pytest.approx([0, 0], abs=1e-6)
    assert found[1].tolist() == pytest.approx([0] * 6, abs=1e-6)
    relief = math.tanh(h / 3 * SCALE / RELIEF)
    assert found[2].tolist() == pytest.approx([0, 0, -relief, relief, 0, 0], abs=1e-6)


def test_an_empty_image_has_no_slope():
    found = SurfaceSlopes(2, SCALE, CELL)(torch.zeros(2, 4, 6, 7))
    assert torch.equal(found, torch.zeros(2, 3, 6, 7))


def test_a_cell_alone_has_neither_slope_nor_relief():
    seen = torch.zeros(9, 9)
    seen[4, 4] = 1
    found = SurfaceSlopes(2, SCALE, CELL)(range_image(torch.full((9, 9), 1.5), seen, seed=0))
    torch.testing.assert_close(found, torch.zeros_like(found), rtol=0, atol=1e-4)


def test_an_empty_cell_has_the_plane_of_its_neighbours_and_no_relief():
    image = plane(0.4, -0.2)
    slopes = SurfaceSlopes(2, SCALE, CELL)
    whole = slopes(image)[0, :, 5, 6]
    image[0, :, 5, 6] = 0  # the window's middle: the other cells are spread a little more
    holed = slopes(image)[0, :, 5, 6]
    variance = 2 * 25 / 24
    tilt = torch.tensor([0.4, -0.2]) * variance / (variance + RIDGE)
    torch.testing.assert_close(holed[:2], tilt / (1 + tilt.square().sum()).sqrt(), rtol=0, atol=1e-5)
    assert float((holed[:2] - whole[:2]).abs().max()) < 0.002 and float(holed[2]) == 0


@pytest.mark.parametrize(("radius", "share"), [(1, 0.5), (2, 0.7), (2, 0.1), (3, 0.9)])
def test_windows_of_an_image_with_holes_are_those_of_numpy(radius, share):
    generator = torch.Generator().manual_seed(radius)
    z = 0.5 * torch.randn(12, 9, generator=generator)
    image = range_image(z, torch.rand(12, 9, generator=generator) < share, seed=3)
    found = SurfaceSlopes(radius, SCALE, CELL)(image)[0].double().numpy()
    np.testing.assert_allclose(found, naive(image, radius), rtol=0, atol=2e-5)


def test_a_surface_far_from_the_mean_depth_has_the_same_slopes():
    """Ten units off, where squares of depths would swamp a float32."""
    image = plane(0.3, 0.1, seed=1)
    far = image.clone()
    far[:, 2] += 10
    slopes = SurfaceSlopes(2, SCALE, CELL)
    torch.testing.assert_close(slopes(far)[:, :2], slopes(image)[:, :2], rtol=0, atol=2e-4)


def test_images_of_a_batch_do_not_touch_each_other():
    one, other = plane(0.3, 0.1, seed=1), plane(-0.6, 0.2, seed=2)
    slopes = SurfaceSlopes(2, SCALE, CELL)
    both = slopes(torch.cat([one, other]))
    torch.testing.assert_close(both, torch.cat([slopes(one), slopes(other)]), rtol=0, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_precision_of_the_image_is_kept(dtype):
    image = plane(0.3, 0.1, seed=1)
    found = SurfaceSlopes(2, SCALE, CELL).to(dtype)(image.to(dtype))
    assert found.dtype == dtype
    torch.testing.assert_close(found.float(), SurfaceSlopes(2, SCALE, CELL)(image), rtol=0, atol=1e-6)


def test_autocast_does_not_touch_the_fit():
    """Sums in bfloat16 would be off by a hundredth of the depths."""
    image = plane(0.05, -0.02, seed=1)
    slopes = SurfaceSlopes(2, SCALE, CELL)
    with torch.autocast("cpu", torch.bfloat16):
        found = slopes(image)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, slopes(image), rtol=0, atol=1e-6)


def test_there_is_nothing_to_learn_or_to_save():
    slopes = SurfaceSlopes(2, SCALE, CELL)
    assert not list(slopes.parameters()) and not slopes.state_dict()
    assert [name for name, _ in slopes.named_buffers()] == ["kernel"] and not slopes.kernel.requires_grad


@pytest.mark.parametrize("radius", [0, -1])
def test_a_window_of_one_cell_is_refused(radius):
    with pytest.raises(
        ValueError, match=rf"backbone.slopes is {radius}, expected a radius of 1 cell or more"
    ):
        SurfaceSlopes(radius, SCALE, CELL)
