"""What a network costs: weights, operations and memory, counted on one scene."""

from copy import deepcopy
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode


@dataclass(frozen=True)
class NetworkSummary:
    """Costs of one scene.

    Attributes:
        backbone: its class. parameters: learnt numbers. points: N of the scene that was counted.
        operations: multiply-adds of the matrix products and convolutions of a forward pass.
        kept_bytes: what a training step keeps from the forward for the backward pass, in float32.
    """

    backbone: str
    parameters: int
    points: int
    operations: int
    kept_bytes: int

    def __str__(self) -> str:
        return (
            f"{self.backbone}: {self.parameters / 1e6:.2f} M parameters; a scene of {self.points} points "
            f"takes {self.operations / 1e9:.2f} G multiply-adds forward and keeps "
            f"{self.kept_bytes / 2**20:.0f} MiB in float32 for the backward pass"
        )


def summarise(network: nn.Module, points: Tensor) -> NetworkSummary:
    """Count on one scene; the network stays as it is.

    Args:
        network: on any device. points: (N, 3) metres, camera frame, in sampling order.
    """
    copy = deepcopy(network).train()
    weights = {parameter.untyped_storage().data_ptr() for parameter in copy.parameters()}
    kept: dict[int, int] = {}

    def note(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        if storage.data_ptr() not in weights:
            kept[storage.data_ptr()] = storage.nbytes()
        return tensor

    device = next(network.parameters()).device
    cloud = points[None].to(device)
    counter = FlopCounterMode(display=False)
    with torch.autograd.graph.saved_tensors_hooks(note, lambda tensor: tensor), counter:
        prediction = copy(cloud)
    del prediction  # until here no storage was freed, so no address was used twice
    return NetworkSummary(
        type(network.backbone).__name__,
        sum(parameter.numel() for parameter in network.parameters()),
        len(points),
        counter.get_total_flops() // 2,
        sum(kept.values()),
    )
