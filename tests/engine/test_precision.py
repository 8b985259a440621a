"""In which numbers a network computes."""

from contextlib import nullcontext

import pytest
import torch

from pnet.engine.precision import Precision

A = torch.full((4, 4), 1 + 2**-9)  # bf16 keeps seven bits behind the point


def flags() -> tuple[str, bool]:
    return torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32


@pytest.fixture(autouse=True)
def _as_before():
    before = flags()
    yield
    torch.set_float32_matmul_precision(before[0])
    torch.backends.cudnn.allow_tf32 = before[1]


@pytest.mark.parametrize("name", ["32", 32, "tf32", "bf16"])
@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_a_name_is_what_it_says(name, device):
    assert Precision.of(name, device) == str(name)


@pytest.mark.parametrize("hardware, expected", [(True, "bf16"), (False, "32")])
def test_auto_is_bf16_where_the_device_multiplies_it(monkeypatch, hardware, expected):
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: hardware)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: hardware)
    assert Precision.of("auto", "cpu") == Precision.of("auto", "cuda") == expected


@pytest.mark.parametrize("setting", ["16", "half", "fp32", ""])
def test_another_name_is_refused_with_the_choices(setting):
    with pytest.raises(ValueError, match=f"trainer.precision is '{setting}', choose 32, tf32, bf16 or auto"):
        Precision.of(setting, "cpu")


def test_bf16_rounds_products_and_the_others_do_not_on_a_cpu():
    exact = 4 * (1 + 2**-9) ** 2
    for precision in (Precision.FLOAT32, Precision.TF32):
        with precision.numbers("cpu"):
            assert float((A @ A)[0, 0]) == pytest.approx(exact, abs=1e-6)
    with Precision.BF16.numbers("cpu"):
        product = A @ A
    assert product.dtype == torch.bfloat16 and float(product[0, 0]) == 4.0
    assert (A @ A).dtype == torch.float32


@pytest.mark.parametrize(
    "precision, expected",
    [
        (Precision.FLOAT32, ("highest", False)),
        (Precision.TF32, ("high", True)),
        (Precision.BF16, ("highest", False)),
    ],
)
def test_cuda_products_are_set_for_a_pass_and_put_back(monkeypatch, precision, expected):
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
    before = flags()
    with pytest.raises(KeyError), precision.numbers("cuda"):
        assert flags() == expected
        raise KeyError
    assert flags() == before
    precision.set_products("cuda")
    assert flags() == expected


def test_a_cpus_products_are_left_alone():
    before = flags()
    with Precision.TF32.numbers("cpu"):
        assert flags() == before
