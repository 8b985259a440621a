"""In which numbers a network computes."""

from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum

import torch


class Precision(StrEnum):
    """What matrix products and convolutions are computed in; sums, norms and losses stay in float32."""

    FLOAT32 = "32"
    TF32 = "tf32"  # on CUDA: inputs of products rounded to ten bits; elsewhere the same as FLOAT32
    BF16 = "bf16"  # autocast: inputs and results of products rounded to seven bits

    @classmethod
    def of(cls, setting: str | int, device: str) -> "Precision":
        """The precision of a setting.

        Args:
            setting: one of the names, or "auto": bf16 where the device multiplies it in hardware, else 32.
            device: "cuda" or "cpu".
        """
        setting = str(setting)  # 32 comes as a number from the command line
        if setting == "auto":
            return cls.BF16 if _multiplies_bf16(device) else cls.FLOAT32
        if setting not in list(cls):
            raise ValueError(f"trainer.precision is {setting!r}, choose {', '.join(cls)} or auto")
        return cls(setting)

    def set_products(self, device: str) -> None:
        """How this process multiplies float32 numbers on CUDA, also in backward passes."""
        if device == "cuda":
            torch.set_float32_matmul_precision("high" if self is Precision.TF32 else "highest")
            torch.backends.cudnn.allow_tf32 = self is Precision.TF32

    @contextmanager
    def numbers(self, device: str) -> Iterator[None]:
        """For a network's forward pass; what was set for the process before comes back."""
        with torch.autocast(device, torch.bfloat16, enabled=self is Precision.BF16):
            if device != "cuda":
                yield
                return
            before = torch.get_float32_matmul_precision(), torch.backends.cudnn.allow_tf32
            self.set_products(device)
            try:
                yield
            finally:
                torch.set_float32_matmul_precision(before[0])
                torch.backends.cudnn.allow_tf32 = before[1]


def _multiplies_bf16(device: str) -> bool:
    if device == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return bool(torch.cpu._is_avx512_bf16_supported())
