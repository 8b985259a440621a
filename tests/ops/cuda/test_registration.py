"""What torch calls on CUDA: the registered functions, given tensors as networks have them, not in one row."""

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from pnet.ops import gathering, grouping, neighbours, sampling  # noqa: F401  they register
from pnet.ops.operators import KERNELS, OPERATORS, plain_operators

B, N, M, K, C = 3, 9, 7, 4, 5
G = torch.Generator().manual_seed(0)
ROWS = torch.randn(B, C, N, generator=G).mT
INDEX = torch.randint(0, N, (B, K, M), generator=G).mT
WEIGHT = torch.rand(1, M, K, generator=G).expand(B, M, K)
GRAD = torch.randn(B, M, 1, generator=G).expand(B, M, C)
GROUPS = torch.randn(B, M, C, K, generator=G).mT
POINTS = torch.rand(B, 2 * N, 3, generator=G)[:, :N] + torch.arange(B)[:, None, None]
WINNER = OPERATORS["gather_max"](ROWS, INDEX)[1].mT.contiguous().mT
PLACE = OPERATORS["group_max"](GROUPS)[1]

CALLS = [
    ("gather_sum", (ROWS, INDEX, None)),
    ("gather_sum", (ROWS, INDEX, WEIGHT)),
    ("scatter_sum", (GRAD, INDEX, None, N)),
    ("scatter_sum", (GRAD, INDEX, WEIGHT, N)),
    ("gather_max", (ROWS, INDEX)),
    ("scatter_max", (GRAD, WINNER, INDEX, N)),
    ("group_max", (GROUPS,)),
    ("ungroup_max", (GRAD, PLACE, K)),
    ("ball_query", (POINTS, POINTS[:, :3], 0.1, 4)),
    ("nearest", (POINTS, POINTS[:, :3], 3)),
    ("octants", (POINTS, 0.3)),
    ("farthest_points", (POINTS, 11, 2)),
]


def all_of(result) -> tuple[torch.Tensor, ...]:
    return result if isinstance(result, tuple) else (result,)


def test_every_operator_has_a_kernel_and_is_tried_here():
    assert {name for name, _ in CALLS} == set(KERNELS["cuda"]) == set(OPERATORS)


@pytest.mark.parametrize("name, given", CALLS, ids=lambda value: value if isinstance(value, str) else "")
def test_the_registered_function_gives_what_the_reference_and_the_fake_promise(here, name, given):
    registered = OPERATORS[name]._backend_fns["cuda"]
    found = all_of(registered(*map(here, given)))
    with plain_operators():
        expected = all_of(OPERATORS[name](*given))
    with FakeTensorMode() as mode:
        promised = [mode.from_tensor(x) if isinstance(x, torch.Tensor) else x for x in given]
        fakes = all_of(OPERATORS[name](*promised))
    for own, plain, fake in zip(found, expected, fakes, strict=True):
        torch.testing.assert_close(own.cpu(), plain)
        assert own.dtype == fake.dtype and own.shape == fake.shape and own.stride() == fake.stride()
