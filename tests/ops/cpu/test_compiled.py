"""Kernels, threads and forked processes."""

import multiprocessing
import os
import threading
from concurrent.futures import ThreadPoolExecutor

import numba
import pytest
import torch
from torch.utils.data import DataLoader, Dataset

from pnet.ops.cpu import compiled
from pnet.ops.cpu.compiled import in_parts, kernel
from pnet.ops.gathering import gather_max, gather_sum
from pnet.ops.neighbours import ball_query, nearest, octants
from pnet.ops.operators import plain_operators
from pnet.ops.sampling import farthest_points


def work(seed: int) -> list[torch.Tensor]:
    """Every operator on a cloud of its own."""
    g = torch.Generator().manual_seed(seed)
    points, rows = torch.rand(2, 400, 3, generator=g), torch.randn(2, 400, 8, generator=g)
    rows.requires_grad_()
    index, _ = nearest(points, points, 5)
    (gather_max(rows, index) + gather_sum(rows, index)).sum().backward()
    tables = [index, ball_query(points, points, 0.2, 6), octants(points, 0.2), farthest_points(points, 50)]
    return [*tables, rows.grad]


def same(found: list[torch.Tensor], expected: list[torch.Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


def test_the_references_say_the_same():
    with plain_operators():
        *tables, grad = work(0)
    *found, found_grad = work(0)
    assert same(found, tables)
    torch.testing.assert_close(found_grad, grad, rtol=1e-6, atol=1e-5)


def test_a_kernel_is_compiled_and_kept():
    @kernel
    def triple(x):
        return 3 * x

    assert triple(4) == 12 and isinstance(triple, numba.core.dispatcher.Dispatcher)
    assert triple.targetoptions["nogil"]


def test_without_a_place_for_its_code_a_kernel_is_compiled_all_the_same(monkeypatch):
    njit, asked = numba.njit, []

    def no_place(**options):
        asked.append(options)
        if options.get("cache"):
            raise RuntimeError("cannot cache function: no locator available")
        return njit(**options)

    monkeypatch.setattr(numba, "njit", no_place)

    @kernel
    def triple(x):
        return 3 * x

    assert asked == [{"nogil": True, "cache": True}, {"nogil": True}]
    assert triple(4) == 12


def parts_of(count: int, least: int = 1) -> list[tuple[int, int]]:
    parts, lock = [], threading.Lock()

    def run(start: int, stop: int) -> None:
        with lock:
            parts.append((start, stop))

    in_parts(run, count, least)
    return sorted(parts)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("number", [1, 2, 3, 4])
@pytest.mark.parametrize("count", [0, 1, 2, 7, 1000])
def test_parts_are_the_whole_once(number, count):
    torch.set_num_threads(number)
    parts = parts_of(count)
    assert [i for start, stop in parts for i in range(start, stop)] == list(range(count))
    assert len(parts) == max(1, min(number, count))
    sizes = [stop - start for start, stop in parts]
    assert max(sizes) - min(sizes) <= 1


@pytest.mark.usefixtures("threads")
def test_few_rows_are_not_worth_a_thread():
    torch.set_num_threads(4)
    assert len(parts_of(99, least=50)) == 1
    assert len(parts_of(100, least=50)) == 2
    assert len(parts_of(1000, least=50)) == 4


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("bad", [0, 5, 9])
def test_an_error_in_any_part_is_not_lost(bad):
    torch.set_num_threads(3)

    def run(start: int, stop: int) -> None:
        if start <= bad < stop:
            raise LookupError(f"row {bad}")

    with pytest.raises(LookupError, match=f"row {bad}"):
        in_parts(run, 10)


@pytest.mark.usefixtures("threads")
def test_a_process_keeps_one_pool_for_a_number_of_threads():
    torch.set_num_threads(3)
    parts_of(10)
    pool = compiled._pools[os.getpid(), 2]
    parts_of(10)
    assert compiled._pools[os.getpid(), 2] is pool


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("number", [1, 2])
def test_threads_that_call_at_once_get_what_is_theirs(number):
    expected = [work(seed) for seed in range(6)]
    torch.set_num_threads(number)
    with ThreadPoolExecutor(2) as pool:
        for _ in range(3):
            found = list(pool.map(work, range(6)))
            assert all(same(a, b) for a, b in zip(found, expected, strict=True))


def forked(seed: int, number: int) -> list[list]:
    torch.set_num_threads(number)
    return [t.tolist() for t in work(seed)]


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("number", [1, 2])
def test_a_forked_process_can_use_the_kernels(number):
    torch.set_num_threads(2)
    expected = [t.tolist() for t in work(3)]  # the parent's pool has run
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.apply_async(forked, (3, number)).get(timeout=60) == expected


class Works(Dataset):
    """Every item in `threads` threads, or in the worker's own number of them."""

    def __init__(self, threads: int | None) -> None:
        self._threads = threads

    def __len__(self) -> int:
        return 4

    def __getitem__(self, index: int) -> list[torch.Tensor]:
        if self._threads is not None:
            torch.set_num_threads(self._threads)
        return [t.detach() for t in work(index)]


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("number", [None, 2])
def test_a_loader_s_forked_worker_can_use_the_kernels(number):
    torch.set_num_threads(2)
    expected = [work(index) for index in range(4)]  # the parent's pool has run
    loader = DataLoader(
        Works(number), batch_size=None, num_workers=2, multiprocessing_context="fork", timeout=60
    )
    assert all(same(a, b) for a, b in zip(loader, expected, strict=True))
    assert same(work(0), expected[0])  # and the parent goes on
