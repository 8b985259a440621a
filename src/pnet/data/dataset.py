"""A torch Dataset of labelled scenes, and the order in which training sees them."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset, Sampler, default_collate

from pnet.data.augmentation import Augmentation
from pnet.data.scene_order import SceneOrder
from pnet.data.targets import point_labels, pose_labels
from pnet.data.views import SceneSource
from pnet.ops.pyramid import Tables
from pnet.parts.base import ParametricPart
from pnet.parts.choice import KeypointChoice
from pnet.parts.keypoints import KeypointChain
from pnet.records import Batch, Scene

Draw = tuple[int, int]  # scene index and place in the training: all that chance depends on, besides the seed
Item = dict[str, Tensor]  # what a scene gives a batch, by name
FindTables = Callable[[Tensor], Tables]  # clouds (B, N, 3) to what a backbone needs to know of them


class LabelledScenes(Dataset[Item]):
    """Scenes with labels, augmented by (seed, place, index) alone, so that a resumed run repeats itself.

    Args:
        scenes: where they come from. chain: the part's keypoints. choice: which equivalent is the label.
        points: take the first so many of each scene's points (they are in sampling order), or None.
        augmentation: for training, else None. seed: of the augmentation.
        posed: the part, for a method that is taught poses; None: no such labels.
    """

    def __init__(
        self,
        scenes: SceneSource,
        chain: KeypointChain,
        choice: KeypointChoice,
        points: int | None = None,
        augmentation: Augmentation | None = None,
        seed: int = 0,
        posed: ParametricPart | None = None,
    ) -> None:
        if points is not None and points > scenes.points_per_scene:
            raise ValueError(
                f"data.points is {points}, the stored scenes have {scenes.points_per_scene}; "
                "lower it or make the data with more points"
            )
        self.scenes, self.points = scenes, points
        self._chain, self._choice = chain, choice
        self._augmentation, self._seed, self._posed = augmentation, seed, posed

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, draw: Draw | int) -> Item:
        index, place = (draw, 0) if isinstance(draw, int) else draw
        chance = np.random.default_rng([self._seed, place, index, 1])  # of view and noise
        scene = first_points(self.scenes.draw(index, chance), self.points)
        if not len(scene.points):
            raise ValueError(
                f"{scene.id}: no body was measured there, so there is nothing to learn; pnet-data convert "
                "leaves such scenes out"
            )
        if self._augmentation is not None:
            scene = self._augmentation(scene, np.random.default_rng([self._seed, place, index]))
        labels = point_labels(scene, self._chain, self._choice)
        item: Item = {**labels, "scene": torch.tensor(index)}
        if self._posed is not None:
            item.update(pose_labels(scene, self._posed))
        return item


def first_points(scene: Scene, count: int | None) -> Scene:
    """The scene with its first `count` points only; None keeps all."""
    if count is None:
        return scene
    arrays = {name: getattr(scene, name) for name in ("points", "instance", "incidence", "edge")}
    return replace(scene, **{name: a[:count] for name, a in arrays.items() if a is not None})


@dataclass(frozen=True)
class Collate:
    """Stacks labelled scenes.

    Attributes:
        tables: finds the backbone's tables of the batch, here in the loader; None: the network does.
    """

    tables: FindTables | None = None

    def __call__(self, items: list[Item]) -> Batch:
        """The batch; its tables are of the points as augmented: octants follow the axes."""
        batch = Batch(**default_collate(items))
        return batch if self.tables is None else replace(batch, tables=self.tables(batch.points))


class EpochSampler(Sampler[Draw]):
    """Cuts an endless order of scenes into epochs, so that every scene of it is seen equally often.

    Args:
        order: which scene comes when. draws: how many make an epoch; None: each scene once.
        rank, world: of several processes that train together, each takes every `world`-th of world * draws.
    """

    def __init__(self, order: SceneOrder, draws: int | None = None, rank: int = 0, world: int = 1) -> None:
        self._order, self._draws = order, draws or len(order)
        self._rank, self._world = rank, world
        self._epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Called by the trainer at the start of each epoch."""
        self._epoch = epoch

    def __len__(self) -> int:
        return self._draws

    def __iter__(self) -> Iterator[Draw]:
        drawn = self._draws * self._world
        for position in range(self._epoch * drawn + self._rank, (self._epoch + 1) * drawn, self._world):
            yield self._order[position], position
