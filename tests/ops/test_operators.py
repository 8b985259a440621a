"""The operators as torch sees them, and the checks that all of them share."""

import math
import shutil
import subprocess
import sys
import sysconfig

import numpy as np
import pytest
import torch

from pnet.ops import neighbours, operators, sampling
from pnet.ops.gathering import gather_max, gather_rows, gather_sum
from pnet.ops.grouping import group_max
from pnet.ops.neighbours import ball_query, nearest, octants, three_nearest
from pnet.ops.operators import OPERATORS, check_clouds, plain_operators, squared, squared_distance
from pnet.ops.sampling import farthest_points

POINTS = torch.rand(2, 90, 3, generator=torch.Generator().manual_seed(0))
ROWS = torch.rand(2, 9, 5, generator=torch.Generator().manual_seed(1)) - 0.5
INDEX = torch.randint(0, 9, (2, 7, 4), generator=torch.Generator().manual_seed(2))
WEIGHT = torch.rand(2, 7, 4, generator=torch.Generator().manual_seed(3))
SPREAD = ROWS[:, :7]
WINNER = INDEX[..., :1].expand(2, 7, 5).int().contiguous()
GROUPS = torch.rand(2, 7, 4, 5, generator=torch.Generator().manual_seed(4)) - 0.5
PLACE = GROUPS.argmax(2).int()


def learned(rows: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    return rows.to(dtype, copy=True).requires_grad_()


def inputs(dtype: torch.dtype) -> list[tuple[str, tuple]]:
    """What every operator may be called with."""
    points, weight = POINTS.to(dtype), WEIGHT.to(dtype)
    return [
        ("ball_query", (points, points[:, :8], 0.1, 6)),
        ("nearest", (points, points[:, :8] + 0.01, 3)),
        ("octants", (points, 0.05)),
        ("farthest_points", (points, 20, 3)),
        ("farthest_points", (points[:, :4], 9, 0)),
        ("gather_sum", (learned(ROWS, dtype), INDEX, None)),
        ("gather_sum", (learned(ROWS, dtype), INDEX, weight)),
        ("gather_sum", (ROWS.to(dtype), INDEX, weight)),
        ("scatter_sum", (learned(SPREAD, dtype), INDEX, None, 9)),
        ("scatter_sum", (learned(SPREAD, dtype), INDEX, weight, 9)),
        ("gather_max", (learned(ROWS, dtype), INDEX)),
        ("gather_max", (ROWS.to(dtype), INDEX)),
        ("scatter_max", (SPREAD.to(dtype), WINNER, INDEX, 9)),
        ("group_max", (learned(GROUPS, dtype),)),
        ("group_max", (GROUPS.to(dtype),)),
        ("ungroup_max", (SPREAD.to(dtype), PLACE, 4)),
    ]


def test_every_operator_is_tried_here():
    assert {name for name, _ in inputs(torch.float32)} == set(OPERATORS)


@pytest.mark.parametrize("name, args", inputs(torch.float32) + inputs(torch.float64))
def test_torch_finds_no_fault_in_an_operator(name, args):
    torch.library.opcheck(OPERATORS[name], args)


@pytest.mark.parametrize("name, args", inputs(torch.float32))
def test_torch_finds_no_fault_in_a_reference(name, args):
    with plain_operators():
        torch.library.opcheck(OPERATORS[name], args)


def test_plain_operators_run_no_kernel_and_hand_them_back(monkeypatch):
    from pnet.ops.cpu import neighbours as kernels

    def fail(*_):
        raise LookupError("the kernel")

    monkeypatch.setattr(kernels, "octants", fail)
    with pytest.raises(LookupError):
        octants(POINTS, 0.1)
    with plain_operators():
        plain = octants(POINTS, 0.1)
    assert plain.shape == (2, 90, 8)
    with pytest.raises(LookupError):
        octants(POINTS, 0.1)
    with pytest.raises(ZeroDivisionError), plain_operators():
        raise ZeroDivisionError
    with pytest.raises(LookupError):
        octants(POINTS, 0.1)


def test_kernels_for_cuda_need_triton_a_compiler_and_pythons_headers(monkeypatch, tmp_path):
    has_toolkit = operators.has_toolkit.__wrapped__  # without its memory
    (tmp_path / "Python.h").touch()
    monkeypatch.setattr(operators, "find_spec", lambda name: name)
    monkeypatch.setattr(sysconfig, "get_paths", lambda: {"include": str(tmp_path)})
    monkeypatch.setattr(shutil, "which", lambda name: "/usr/bin/gcc" if name == "gcc" else None)
    monkeypatch.delenv("CC", raising=False)
    assert has_toolkit("cuda") and has_toolkit("cpu")
    monkeypatch.setenv("CC", "no-such-compiler")
    assert not has_toolkit("cuda") and has_toolkit("cpu")
    monkeypatch.delenv("CC")
    (tmp_path / "Python.h").unlink()
    assert not has_toolkit("cuda")
    (tmp_path / "Python.h").touch()
    monkeypatch.setattr(operators, "find_spec", lambda name: None)
    assert not has_toolkit("cuda") and not has_toolkit("cpu")


def test_a_radius_is_squared_in_the_precision_of_the_points():
    assert squared(0.1, torch.zeros(1)) == float(np.float32(0.1 * 0.1)) != 0.1 * 0.1
    assert squared(0.1, torch.zeros(1, dtype=torch.float64)) == 0.1 * 0.1
    assert squared(3, torch.zeros(1)) == 9.0


def test_squared_distances_are_summed_in_the_order_of_the_axes():
    a = torch.tensor([[1.0, 1e-4, 1e-4]])
    x, y, z = (np.float32(v) for v in a[0].tolist())
    assert float(squared_distance(a, torch.zeros(3))) == float((x * x + y * y) + z * z)
    torch.testing.assert_close(
        squared_distance(POINTS, POINTS.flip(1)), (POINTS - POINTS.flip(1)).square().sum(-1)
    )


# calls that take one cloud, or two of which the second is given
CALLS = {
    "octants": (lambda p: octants(p, 0.1), "points"),
    "farthest_points": (lambda p: farthest_points(p, 2), "points"),
    "ball_query": (lambda p: ball_query(p, POINTS, 0.1, 2), "points"),
    "ball_query's centres": (lambda p: ball_query(POINTS, p, 0.1, 2), "centres"),
    "nearest": (lambda p: nearest(p, POINTS, 1), "points"),
    "nearest's queries": (lambda p: nearest(POINTS, p, 1), "queries"),
}
BAD = {
    "four coordinates": (torch.zeros(2, 5, 4), r"shape \(2, 5, 4\), expected \(B, N, 3\)"),
    "no batch": (torch.zeros(5, 3), r"shape \(5, 3\), expected \(B, N, 3\)"),
    "no point": (torch.zeros(2, 0, 3), r"shape \(2, 0, 3\), .* at least one point"),
    "integers": (torch.zeros(2, 5, 3, dtype=torch.int64), "is torch.int64, expected float32 or float64"),
    "half": (torch.zeros(2, 5, 3, dtype=torch.float16), "is torch.float16, expected"),
    "bfloat16": (torch.zeros(2, 5, 3, dtype=torch.bfloat16), "is torch.bfloat16, expected"),
    "not a number": (torch.full((2, 5, 3), math.nan), "has NaN or infinite coordinates"),
    "infinite": (torch.full((2, 5, 3), -math.inf), "has NaN or infinite coordinates"),
}


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("bad", BAD)
def test_a_cloud_that_does_not_fit_is_named(call, bad):
    run, name = CALLS[call]
    cloud, message = BAD[bad]
    with pytest.raises(ValueError, match=f"^{name}.*{message}"):
        run(cloud)


def test_one_bad_coordinate_is_enough():
    cloud = POINTS.clone()
    cloud[1, 70, 2] = math.nan
    with pytest.raises(ValueError, match="points has NaN"):
        check_clouds(points=cloud)


@pytest.mark.parametrize("call", [lambda a, b: ball_query(a, b, 0.1, 2), lambda a, b: nearest(a, b, 2)])
def test_batches_of_different_size_are_refused(call):
    with pytest.raises(
        ValueError, match=r"differ in number or type: points \(2, 90, 3\) \S+, \w+ \(1, 90, 3\)"
    ):
        call(POINTS, POINTS[:1])


@pytest.mark.parametrize("radius", [0, 0.0, -0.5, math.nan])
@pytest.mark.parametrize("call", [lambda r: ball_query(POINTS, POINTS, r, 2), lambda r: octants(POINTS, r)])
def test_a_radius_that_is_none_is_refused(call, radius):
    with pytest.raises(ValueError, match=f"the radius is {radius}, expected more than 0 metres"):
        call(radius)


@pytest.mark.parametrize("k", [0, -3])
@pytest.mark.parametrize(
    "call", [lambda k: ball_query(POINTS, POINTS, 0.1, k), lambda k: nearest(POINTS, POINTS, k)]
)
def test_fewer_than_one_neighbour_is_refused(call, k):
    with pytest.raises(ValueError, match=f"{k} neighbours are asked for, expected at least 1"):
        call(k)


def test_more_nearest_than_there_are_points_are_refused():
    with pytest.raises(ValueError, match="91 nearest of 90 points"):
        nearest(POINTS, POINTS, 91)
    assert nearest(POINTS, POINTS, 90)[0].shape == (2, 90, 90)


@pytest.mark.parametrize("count, start", [(0, 0), (-1, 0), (3, 90), (3, -1)])
def test_a_sample_that_cannot_be_taken_is_refused(count, start):
    with pytest.raises(ValueError, match=f"cannot take {count} of 90 points from index {start} on"):
        farthest_points(POINTS, count, start)


def test_a_cloud_that_requires_a_gradient_gives_tables_without():
    points = POINTS.clone().requires_grad_()
    tables = [
        ball_query(points, points, 0.2, 4),
        *nearest(points, points, 3),
        *three_nearest(points, points),
        octants(points, 0.2),
        farthest_points(points, 9),
    ]
    assert not any(table.requires_grad for table in tables)
    fixed = POINTS
    plain = [
        ball_query(fixed, fixed, 0.2, 4),
        *nearest(fixed, fixed, 3),
        *three_nearest(fixed, fixed),
        octants(fixed, 0.2),
        farthest_points(fixed, 9),
    ]
    assert all(torch.equal(a, b) for a, b in zip(tables, plain, strict=True))


STRIDES = {
    "expanded": lambda x: x[:1].expand(3, *x.shape[1:]),
    "transposed": lambda x: x.mT.contiguous().mT,
    "sliced": lambda x: x[:, ::2],
    "strided": lambda x: x.repeat_interleave(2, 2)[..., ::2],
}


@pytest.mark.parametrize("stride", STRIDES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_how_a_tensor_lies_in_memory_does_not_matter(stride, dtype):
    change = STRIDES[stride]
    points, rows = change(POINTS.to(dtype)), change(ROWS.to(dtype))
    index, weight = change(INDEX % rows.shape[1]), change(WEIGHT)
    assert not any(tensor.is_contiguous() for tensor in (points, rows, index, weight))
    calls = [
        lambda p, r, i, w: ball_query(p, p, 0.2, 5),
        lambda p, r, i, w: torch.stack([t.to(dtype) for t in nearest(p, p, 4)]),
        lambda p, r, i, w: octants(p, 0.2),
        lambda p, r, i, w: farthest_points(p, 12),
        lambda p, r, i, w: gather_rows(r, i),
        lambda p, r, i, w: gather_sum(r, i),
        lambda p, r, i, w: gather_sum(r, i, w),
        lambda p, r, i, w: gather_max(r, i),
        lambda p, r, i, w: OPERATORS["scatter_sum"](
            r[:, : i.shape[1]], i[:, : r.shape[1]], w[:, : r.shape[1]], 9
        ),
        lambda p, r, i, w: group_max(r[:, :, None].expand(-1, -1, 3, -1)),
        lambda p, r, i, w: OPERATORS["ungroup_max"](r, r.argmax(2, keepdim=True).expand(r.shape).int(), 4),
    ]
    for call in calls:
        given, plain = (points, rows, index, weight), [t.contiguous() for t in (points, rows, index, weight)]
        assert torch.equal(call(*given), call(*plain))


def everything(points: torch.Tensor, rows: torch.Tensor, index: torch.Tensor, weight: torch.Tensor):
    """All operators, with gradients."""
    tables = [ball_query(points, points, 0.1, 9), *nearest(points, points, 5), octants(points, 0.1)]
    tables.append(farthest_points(points, 40))
    values = []
    for gather in (
        lambda r: gather_sum(r, index),
        lambda r: gather_sum(r, index, weight),
        lambda r: gather_max(r, index),
        lambda r: group_max(r.unflatten(1, (100, 7))),
    ):
        given = rows.clone().requires_grad_()
        taken = gather(given)
        taken.backward(torch.linspace(-1, 1, taken.numel(), dtype=rows.dtype).view_as(taken))
        values += [taken.detach(), given.grad]
    return tables + values


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_results_are_the_same_bits_for_any_number_of_threads(dtype):
    g = torch.Generator().manual_seed(0)
    points = torch.rand(2, 700, 3, generator=g).to(dtype)
    rows = torch.randn(2, 700, 70, generator=g).to(dtype)
    index = torch.randint(0, 50, (2, 700, 6), generator=g)
    weight = torch.rand(2, 700, 6, generator=g)
    results = []
    for number in (1, 2, 4):
        torch.set_num_threads(number)
        results.append(everything(points, rows, index, weight))
    for one, *others in zip(*results, strict=True):
        assert all(torch.equal(one, other) for other in others)


STAGES = """
import sys
import pnet.ops.neighbours, pnet.ops.sampling, pnet.ops.gathering, pnet.ops.pyramid
import pnet.backbones.pointsift, pnet.cli.app
print("numba" in sys.modules)
import torch
from pnet.ops.neighbours import octants
from pnet.ops.operators import plain_operators
with plain_operators():
    octants(torch.zeros(1, 2, 3), 1.0)
print("numba" in sys.modules)
octants(torch.zeros(1, 2, 3), 1.0)
print("numba" in sys.modules)
"""


def test_kernels_are_imported_at_their_first_use():
    command = [sys.executable, "-c", STAGES]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    # after the imports, after a reference, after a kernel
    assert done.stdout.split() == ["False", "False", "True"]


def test_an_operator_has_the_name_of_its_reference():
    assert neighbours._ball_query is OPERATORS["ball_query"]
    assert sampling._farthest_points is OPERATORS["farthest_points"]
    found = torch.ops.pnet.octants(POINTS, squared(0.1, POINTS))
    assert torch.equal(found, octants(POINTS, 0.1))


def test_clouds_of_two_precisions_are_refused():
    points = torch.rand(1, 9, 3)
    for search in (
        lambda: nearest(points, points.double(), 2),
        lambda: ball_query(points, points.double(), 1, 2),
    ):
        with pytest.raises(
            ValueError, match=r"points \(1, 9, 3\) torch.float32, \w+ \(1, 9, 3\) torch.float64"
        ):
            search()
