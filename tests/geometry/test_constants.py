"""Constants beside the data."""

import torch

from pnet.geometry.constants import converted


def test_a_constant_of_the_same_kind_is_itself():
    constant = torch.arange(3.0)
    assert converted(constant, torch.zeros(9)) is constant


def test_a_copy_is_made_once_a_kind():
    constant = torch.tensor([0.1, 0.2], dtype=torch.float64)
    single = converted(constant, torch.zeros(1))
    assert single.dtype == torch.float32 and torch.equal(single, constant.float())
    assert converted(constant, torch.ones(2, 2)) is single
    assert converted(constant, torch.zeros(1, device="meta")).device.type == "meta"
    assert converted(constant, torch.zeros(1)) is single


def test_a_copy_made_in_inference_serves_a_training():
    constant = torch.tensor([2.0, 3.0], dtype=torch.float64)
    with torch.inference_mode():
        converted(constant, torch.zeros(1))
    learnt = torch.ones(2, requires_grad=True)
    (learnt * converted(constant, learnt)).sum().backward()
    assert learnt.grad.tolist() == [2.0, 3.0]


def test_two_constants_of_one_value_do_not_share_their_copies():
    first, second = torch.zeros(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    assert converted(first, torch.zeros(1)) is not converted(second, torch.zeros(1))
