"""Learning rate as a multiple of the optimiser's own, by step."""

import math
from dataclasses import dataclass
from typing import Protocol


class Schedule(Protocol):
    """A factor on the learning rate."""

    def factor(self, step: int, total_steps: int) -> float:
        """Factor at optimiser step `step` of `total_steps`."""
        ...


@dataclass(frozen=True)
class StepDecay:
    """Staircase: multiply by `gamma` every `every` steps, not below `floor`.

    The paper has 0.5 every 200,000 steps; the released code 0.7 every 200,000 samples down to 0.01.
    """

    every: int
    gamma: float
    floor: float = 0.0

    def factor(self, step: int, total_steps: int) -> float:
        """γ^⌊step / every⌋."""
        return max(self.gamma ** (step // self.every), self.floor)


@dataclass(frozen=True)
class WarmupCosine:
    """Linear warm-up over a share of the steps, then half a cosine down to `floor`."""

    warmup: float
    floor: float

    def factor(self, step: int, total_steps: int) -> float:
        """From 0 up to 1 and down to `floor`."""
        rising = max(1, round(self.warmup * total_steps))
        if step < rising:
            return (step + 1) / rising
        progress = min(1.0, (step - rising) / max(1, total_steps - rising))
        return self.floor + (1 - self.floor) * (1 + math.cos(math.pi * progress)) / 2
