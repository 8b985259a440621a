"""Many fits at once on CUDA: the CPU's to the last bit, and those of scipy."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from pnet.geometry.rigid import apply_pose, fit_rigid
from pnet.postprocess.cpu import fits as compiled
from pnet.postprocess.cuda import fits as kernels
from pnet.postprocess.fit import fit_pose
from pnet.postprocess.kernels import Kernels, only


def clouds(rows: int, n: int, seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Source, noisy target and weight; metres."""
    g = torch.Generator().manual_seed(seed)
    source = 0.02 * torch.randn(rows, n, 3, dtype=torch.float64, generator=g)
    R = torch.from_numpy(Rotation.random(rows, random_state=seed).as_matrix())
    t = torch.rand(rows, 3, dtype=torch.float64, generator=g)
    noise = 0.002 * torch.randn(rows, n, 3, dtype=torch.float64, generator=g)
    return source, apply_pose(R, t, source) + noise, torch.rand(rows, n, dtype=torch.float64, generator=g)


def odd(case: str, source: torch.Tensor, target: torch.Tensor, weight: torch.Tensor):
    """Cases in which the fit is not unique, or far from fitting."""
    match case:
        case "weights zero":
            return source, target, 0 * weight
        case "some weights zero":
            return source, target, weight * (torch.arange(weight.shape[1]) < 3)
        case "one place":
            return source, target[:, :1].expand_as(target), weight
        case "one place to one place":
            return source[:, :1].expand_as(source), target[:, :1].expand_as(target), weight
        case "a line":
            along = torch.tensor([0.0, 1.0, -2.0, 3.0, 0.5], dtype=torch.float64)[: source.shape[1], None]
            return source[:, :1] * along, target, weight
        case "a line on an axis":
            return source * torch.tensor([0.0, 0, 1]), target, weight
        case "mirrored":
            return source * torch.tensor([1.0, 1, -1]), target, weight
        case "exact":
            return source, source, torch.ones_like(weight)
        case "half a turn":
            return source, source * torch.tensor([-1.0, -1, 1]), torch.ones_like(weight)
        case "no numbers":
            return source * torch.nan, target, weight
    return source, target, weight


CASES = ["usual", "weights zero", "some weights zero", "one place", "one place to one place", "a line"]
CASES += ["a line on an axis", "mirrored", "exact", "half a turn", "no numbers"]


@pytest.mark.parametrize("case", CASES)
def test_fits_are_those_of_the_cpu_to_the_last_bit(here, case):
    given = odd(case, *clouds(150, 5))
    found = [x.cpu() for x in kernels.fit_rigid_many(*here(*given))]
    for own, expected in zip(found, compiled.fit_rigid_many(*given), strict=True):
        torch.testing.assert_close(own, expected, rtol=0, atol=0, equal_nan=True)
    assert case == "no numbers" or bool(found[0].isfinite().all())


@pytest.mark.parametrize("n", [3, 4, 7])
@pytest.mark.parametrize("mirrored", [False, True])
def test_fits_are_those_of_scipy(here, n, mirrored):
    source, target, weight = odd("mirrored" if mirrored else "usual", *clouds(20, n, seed=n))
    R, t = (x.cpu() for x in kernels.fit_rigid_many(*here(source, target, weight)))
    a, b = ((weight[..., None] * x).sum(1) / weight.sum(1)[:, None] for x in (source, target))
    for i in range(20):
        moved = (target[i] - b[i]).numpy(), (source[i] - a[i]).numpy()
        expected = Rotation.align_vectors(*moved, weights=weight[i].numpy())[0].as_matrix()
        np.testing.assert_allclose(R[i].numpy(), expected, atol=1e-9)
    torch.testing.assert_close(t, b - (R @ a[..., None])[..., 0], rtol=0, atol=1e-12)


def test_a_fit_does_not_depend_on_its_neighbours(here):
    """One that takes many sweeps among others that take none."""
    source, target, weight = clouds(130, 4)
    target[:129] = source[:129]
    alone = kernels.fit_rigid_many(*here(source[-1:], target[-1:], weight[-1:]))
    among = kernels.fit_rigid_many(*here(source, target, weight))
    assert all(torch.equal(a[0], b[-1]) for a, b in zip(alone, among, strict=True))


def test_leading_dimensions_and_views_are_kept(here):
    source, target, weight = (x.view(3, 4, *x.shape[1:]) for x in clouds(12, 4))
    R, t = (x.cpu() for x in kernels.fit_rigid_many(*here(source[:1, :1].expand(3, 4, 4, 3), target, weight)))
    expected = compiled.fit_rigid_many(source[:1, :1].expand(3, 4, 4, 3), target, weight)
    assert R.shape == (3, 4, 3, 3) and torch.equal(R, expected[0]) and torch.equal(t, expected[1])
    none = kernels.fit_rigid_many(*here(source[:0], target[:0], weight[:0]))
    assert none[0].shape == (0, 4, 3, 3) and none[1].shape == (0, 4, 3)


def test_a_gradient_goes_through_the_librarys_fit(tn06):
    """The kernels know none."""
    sizes = torch.from_numpy(tn06.part_object("L", 0))[None]
    keypoints = tn06.chain.keypoints_from_parameters(sizes) + 0.5
    keypoints.requires_grad_()
    with only(Kernels.TRITON):
        R, t = fit_pose(tn06.chain, sizes, torch.full((1, 3), 0.5).double(), keypoints)
    torch.testing.assert_close(R[0], torch.eye(3).double(), rtol=0, atol=1e-9)
    (grad,) = torch.autograd.grad(t.sum(), keypoints)
    assert 0.1 < float(grad.abs().max()) < 10


def test_the_plain_twin_fits_as_well(tn06):
    source, target, weight = clouds(30, 4, seed=1)
    expected = compiled.fit_rigid_many(source, target, weight)
    for own, other in zip(fit_rigid(source, target, weight), expected, strict=True):
        torch.testing.assert_close(own, other, rtol=0, atol=1e-8)
