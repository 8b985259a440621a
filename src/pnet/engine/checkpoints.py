"""Checkpoints: written whole or not at all, read without running anything in them."""

import os
import pickle
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Checkpoint

NAME = "last.ckpt"


class ResumableCheckpoint(Checkpoint):
    """Writes `last.ckpt` at the end of every epoch and of the training, under a temporary name first.

    Args:
        folder: where to.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    @property
    def path(self) -> Path:
        """The checkpoint's final name."""
        return self._folder / NAME

    def on_train_epoch_end(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Save where a resumed run can go on."""
        self._folder.mkdir(parents=True, exist_ok=True)
        temporary = self._folder / f".{NAME}.part"
        try:
            trainer.save_checkpoint(temporary)  # every process calls it, the first writes
            if trainer.is_global_zero:
                os.replace(temporary, self.path)
        except OSError as fault:  # the library names a temporary file elsewhere
            temporary.unlink(missing_ok=True)
            raise OSError(f"{self.path}: could not be written ({fault.strerror or fault})") from fault
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint's plain containers onto the CPU.

    Raises:
        FileNotFoundError, ValueError: names the file and the fault.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no checkpoint there; train first with pnet-train")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, pickle.UnpicklingError, OSError, ValueError, KeyError) as fault:
        first = str(fault).splitlines()[0] if str(fault) else type(fault).__name__
        raise ValueError(f"{path}: not a readable checkpoint ({first})") from fault
    if not isinstance(content, dict) or "state_dict" not in content:
        raise ValueError(f"{path}: not a training checkpoint")
    return content
