"""The LightningModule: losses in, weights out."""

from collections.abc import Callable, Iterable
from typing import Any

import lightning
import torch
from torch import Tensor, nn
from torch.nn import Parameter
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from pnet.engine.precision import Precision
from pnet.engine.schedules import Schedule
from pnet.models.losses import Loss
from pnet.records import Batch

Optimization = Callable[[Iterable[Parameter]], Optimizer]
Predict = Callable[..., Any]  # points and tables to predictions


class PoseTraining(lightning.LightningModule):
    """Trains a network on labelled scenes.

    Args:
        network: points to predictions. loss: predictions and labels to losses.
        optimizer: makes an optimiser of parameters. schedule: learning rate by step.
        precision: of the network.
        identity: plain values kept in every checkpoint, by which `check_identity` knows its own.
        compiled: let torch.compile make the network's code, for the training steps.
    """

    def __init__(
        self,
        network: nn.Module,
        loss: Loss,
        optimizer: Optimization,
        schedule: Schedule,
        precision: Precision,
        identity: dict[str, str],
        compiled: bool = False,
    ) -> None:
        super().__init__()
        self.network = network
        # in a tuple, so that it is no submodule: checkpoints know the network alone
        self._trained: tuple[Predict] = (torch.compile(network) if compiled else network,)
        self.loss = loss
        self._optimizer, self._schedule = optimizer, schedule
        self._precision, self.identity = precision, identity

    def training_step(self, batch: Batch, index: int) -> Tensor:
        """Loss of a batch; each module's own is logged."""
        losses = self._losses(self._trained[0], batch)
        self._log("train", losses, len(batch.points))
        for tag, value in self.loss.remarks(batch).items():
            self.log(tag, value, batch_size=len(batch.points))
        return losses["loss"]

    def validation_step(self, batch: Batch, index: int) -> None:
        """Losses on validation scenes."""
        self._log("val", self._losses(self.network, batch), len(batch.points))

    def configure_optimizers(self) -> Any:
        """The optimiser and its schedule, stepped after every batch."""
        optimizer = self._optimizer(self.network.parameters())
        total = int(self.trainer.estimated_stepping_batches)
        schedule = LambdaLR(optimizer, lambda step: self._schedule.factor(step, total))
        return {
            "optimizer": optimizer,
            "lr_scheduler": {"scheduler": schedule, "interval": "step"},
        }

    def transfer_batch_to_device(self, batch: Batch, device: torch.device, index: int) -> Batch:
        """Lightning knows no frozen records: move each tensor."""
        return batch.map(lambda tensor: tensor.to(device, non_blocking=True))

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep what the weights belong to."""
        checkpoint["pnet"] = dict(self.identity)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse a checkpoint of another part or network."""
        check_identity(checkpoint, self.identity)

    def _losses(self, network: Predict, batch: Batch) -> dict[str, Tensor]:
        with self._precision.numbers(self.device.type):
            predicted = network(batch.points, batch.tables)
        return self.loss(predicted, batch)

    def _log(self, stage: str, losses: dict[str, Tensor], size: int) -> None:
        for name, value in losses.items():
            group = f"{stage}/loss" if name == "loss" else f"{stage}_loss/{name}"
            self.log(group, value, batch_size=size)


def check_identity(checkpoint: dict[str, Any], expected: dict[str, str]) -> None:
    """Raise ValueError where a checkpoint belongs to something else; says to what."""
    found = checkpoint.get("pnet")
    if not isinstance(found, dict):
        raise ValueError("the checkpoint was not written by pnet")
    for key, value in expected.items():
        if found.get(key) != value:
            raise ValueError(
                f"the checkpoint's {key} is {found.get(key)!r}, this configuration's is {value!r}; "
                "use the configuration that it was trained with, or another run_dir"
            )
