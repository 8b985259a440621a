"""What is watched during training: poses on validation scenes, throughput."""

from collections.abc import Sequence
from time import perf_counter

import lightning
import numpy as np
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from pnet.engine.estimator import NetworkEstimator
from pnet.engine.evaluation import SceneScorer
from pnet.parts.base import ParametricPart
from pnet.records import Detections, Scene

COLOURS = 255 * np.array(
    [[0.12, 0.47, 0.71], [1, 0.5, 0.05], [0.17, 0.63, 0.17], [0.84, 0.15, 0.16], [0.58, 0.4, 0.74]]
)


class PoseValidation(lightning.Callback):
    """AP and errors on validation scenes, a precision-recall curve, and a mesh of the fullest scene.

    Args:
        estimator: shares the network that is trained. scenes: validation scenes.
        points: N, the first so many of a scene's points; None: all.
        mesh_every: validations between two mesh summaries; 0: none.
    """

    def __init__(
        self,
        estimator: NetworkEstimator,
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
        for index in range(len(self._scenes)):
            scene = self._scenes[index]
            cloud = torch.from_numpy(scene.points[: self._points])
            found = self._estimator.estimate(cloud[None].to(pl_module.device))[0]
            scorer.add(scene, found)
            if fullest is None or len(scene.R) > len(fullest[0].R):
                fullest = scene, found
        values = {f"val/{name}": value for name, value in scorer.compute().items() if value == value}
        pl_module.log_dict(values, prog_bar=False)
        if isinstance(trainer.logger, TensorBoardLogger):
            writer = trainer.logger.experiment
            _add_curve(writer, scorer, trainer.global_step)
            if fullest and self._mesh_every and self._validations % self._mesh_every == 0:
                _add_mesh(writer, self._estimator.part, *fullest, trainer.global_step)
        self._validations += 1


class Throughput(lightning.Callback):
    """Scenes per second of the training, logged and kept.

    Attributes:
        scenes, seconds: seen and spent since this process began to train, validation left out.
    """

    def __init__(self) -> None:
        self.scenes, self.seconds = 0, 0.0
        self._start: float | None = None

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
        size = len(batch.points)  # type: ignore[attr-defined]
        self.scenes += size
        if self._start is not None:
            pl_module.log("train/scenes_per_second", size / (now - self._start), prog_bar=True)
            self.seconds += now - self._start
        self._start = now

    def on_validation_start(self, trainer: lightning.Trainer, pl_module: lightning.LightningModule) -> None:
        """Stop the clock."""
        self._start = None


def _add_curve(writer: SummaryWriter, scorer: SceneScorer, step: int) -> None:
    from matplotlib.figure import Figure

    curve = scorer.metrics.curve()
    figure = Figure(figsize=(4, 4), layout="tight")
    axes = figure.subplots()
    axes.step(curve.recall, curve.precision, where="pre")
    axes.set(xlabel="recall", ylabel="precision", xlim=(0, 1.01), ylim=(0, 1.01))
    axes.grid(alpha=0.3)
    writer.add_figure("val/precision_recall", figure, step)


def _add_mesh(
    writer: SummaryWriter, part: ParametricPart, scene: Scene, found: Detections, step: int
) -> None:
    """The scene's points, and the estimated parts as meshes, in metres, with y and z up."""
    up = np.array([1.0, -1.0, -1.0])
    middle = scene.points.mean(0)
    writer.add_mesh("val/points", _batch((scene.points - middle) * up), global_step=step)
    vertices, faces, colours, first = [], [], [], 0
    for i in range(len(found.score)):
        size = found.parameters[i].numpy()
        if not (np.isfinite(size).all() and (size > 0).all()):
            continue  # early in training a vote can make no solid
        try:
            mesh = part.mesh(size)
        except ValueError:
            continue
        placed = np.asarray(mesh.vertices) @ found.R[i].numpy().T + found.t[i].numpy()
        vertices.append((placed - middle) * up)
        faces.append(np.asarray(mesh.faces) + first)
        colours.append(np.tile(COLOURS[i % len(COLOURS)], (len(placed), 1)))
        first += len(placed)
    if vertices:
        writer.add_mesh(
            "val/estimates",
            _batch(np.concatenate(vertices)),
            torch.from_numpy(np.concatenate(colours)).to(torch.uint8)[None],
            torch.from_numpy(np.concatenate(faces)).int()[None],
            global_step=step,
        )


def _batch(vertices: np.ndarray) -> Tensor:
    return torch.from_numpy(vertices).float()[None]
