"""Who does a step."""

from types import SimpleNamespace

import pytest
import torch

from pnet.postprocess import kernels
from pnet.postprocess.cpu import climb as compiled
from pnet.postprocess.kernels import Kernels, kernels_for, only, step


def on(device: str) -> SimpleNamespace:
    """All that is asked of a tensor."""
    return SimpleNamespace(device=SimpleNamespace(type=device))


def test_each_device_has_its_own(monkeypatch):
    assert kernels_for(torch.zeros(1)) is Kernels.NUMBA and kernels_for(on("mps")) is Kernels.PLAIN
    for installed, expected in ((True, Kernels.TRITON), (False, Kernels.PLAIN)):
        monkeypatch.setattr(kernels, "has_toolkit", lambda device, installed=installed: installed)
        assert kernels_for(on("cuda")) is expected


def test_others_can_be_had_and_given_back():
    with only(Kernels.PLAIN):
        with pytest.raises(ZeroDivisionError), only(Kernels.TRITON):
            assert kernels_for(torch.zeros(1)) is Kernels.TRITON
            raise ZeroDivisionError
        assert kernels_for(torch.zeros(1)) is Kernels.PLAIN
    assert kernels_for(torch.zeros(1)) is Kernels.NUMBA


def test_a_step_is_plain_where_there_is_no_kernel(monkeypatch):
    def distinct(centres, *_):
        return "plain"

    monkeypatch.setattr(compiled, "distinct", lambda *_: "compiled")
    known, unknown = step("climb", Kernels.NUMBA)(distinct), step("climb", Kernels.TRITON)(distinct)
    assert known(torch.zeros(1), 2) == "compiled" and unknown(torch.zeros(1), 2) == "plain"
    with only(Kernels.PLAIN):
        assert known(torch.zeros(1), 2) == "plain"
