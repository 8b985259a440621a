"""What is watched during training: poses on validation scenes, throughput."""

from collections.abc import Sequence
from time import perf_counter

import lightning
import torch
from lightning.pytorch.callbacks import RichProgressBar
from lightning.pytorch.loggers import TensorBoardLogger

from pnet.engine.evaluation import SceneScorer
from pnet.engine.method import NetworkMethod
from pnet.engine.tensorboard import add_curves, add_mesh
from pnet.records import Detections, Scene


class PoseValidation(lightning.Callback):
    """AP and errors on validation scenes, precision-recall curves, and a mesh of the fullest scene.

    Args:
        estimator: shares the network that is trained. scenes: validation scenes.
        points: N, the first so many of a scene's points; None: all.
        mesh_every: validations between two mesh summaries; 0: none.
    """

    def __init__(
        self,
        estimator: NetworkMethod,
        scenes: Sequence[Scene],
        points: int | None,
        mesh_every: int,
    ) -> None:
        self._estimator, self._scenes, self._points = estimator, scenes, points
        self._mesh_every, self._validations = mesh_every, 0

    def on_validation_epoch_end(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> None:
        """Recover poses from every validation scene and log how good they are."""
        if trainer.sanity_checking:
            return
        scorer = SceneScorer(self._estimator.part)
        fullest: tuple[Scene, Detections] | None = None
        sizes = []
        for index in range(len(self._scenes)):
            scene = self._scenes[index]
            cloud = torch.from_numpy(scene.points[: self._points])
            found = self._estimator.estimate(cloud[None])[0]
            scorer.add(scene, found)
            sizes.append(scene.parameters[0] if len(scene.parameters) else None)
            if fullest is None or len(scene.R) > len(fullest[0].R):
                fullest = scene, found
        values = {f"val/{name}": value for name, value in scorer.compute().items() if value == value}
        pl_module.log_dict(values, prog_bar=False)
        if isinstance(trainer.logger, TensorBoardLogger) and trainer.is_global_zero:
            writer = trainer.logger.experiment
            add_curves(writer, self._estimator.part, scorer.metrics, sizes, trainer.global_step)
            if fullest and self._mesh_every and self._validations % self._mesh_every == 0:
                add_mesh(writer, self._estimator.part, *fullest, trainer.global_step)
        self._validations += 1


class SparingBar(RichProgressBar):
    """Lightning's, which reads the losses back from the device only where it draws them."""

    SHOWN = ("train/loss", "train/scenes_per_second", "val/loss")

    def __init__(self, refresh_rate: int) -> None:
        super().__init__(refresh_rate)
        self._shown: dict[str, int | str | float | dict[str, float]] = {}

    def get_metrics(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule
    ) -> dict[str, int | str | float | dict[str, float]]:
        """What stands beside the bar: numbers of the last time that it was drawn."""
        if trainer.global_step % self.refresh_rate == 0:
            known = trainer.callback_metrics
            self._shown = {name: f"{float(known[name]):.3f}" for name in self.SHOWN if name in known}
        return self._shown


class Throughput(lightning.Callback):
    """Scenes per second of the training, kept, and logged as often as the losses.

    Attributes:
        scenes, seconds: seen and spent by the training, also before an interruption; validation left out.
    """

    def __init__(self) -> None:
        self.scenes, self.seconds = 0, 0.0
        self._start: float | None = None
        self._logged = 0, 0.0  # scenes and seconds at the last entry

    def state_dict(self) -> dict[str, float]:
        """Kept in checkpoints."""
        return {"scenes": self.scenes, "seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        """Of the checkpoint that a training goes on from."""
        self.scenes, self.seconds = int(state_dict["scenes"]), state_dict["seconds"]
        self._logged = self.scenes, self.seconds

    def on_train_batch_start(
        self, trainer: lightning.Trainer, pl_module: lightning.LightningModule, *_: object
    ) -> None:
        """Start the clock at the first batch and after each pause."""
        if self._start is None:
            self._start = perf_counter()

    def on_train_batch_end(
        self,
        trainer: lightning.Trainer,
        pl_module: lightning.LightningModule,
        outputs: object,
        batch: object,
        index: int,
    ) -> None:
        """Count a batch; the time includes loading the next one."""
        now = perf_counter()
        size = len(batch.points) * trainer.world_size  # type: ignore[attr-defined]
        self.scenes += size
        if self._start is not None:
            self.seconds += now - self._start
        self._start = now
        # a logged number goes to the device, and waits for it
        if trainer.global_step % trainer.log_every_n_steps == 0:  # type: ignore[attr-defined]
            scenes, seconds = self.scenes - self._logged[0], self.seconds - self._logged[1]
            pl_module.log("train/scenes_per_second", scenes / max(seconds, 1e-9))
            self._logged = self.scenes, self.seconds

    def on_validation_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Stop the clock."""
        self._start = None
