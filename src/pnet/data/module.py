"""The LightningDataModule over a data set."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import lightning
import torch
from torch.utils.data import DataLoader

from pnet.data.augmentation import Augmentation
from pnet.data.dataset import Collate, EpochSampler, FindTables, LabelledScenes
from pnet.data.scene_order import mixed_order
from pnet.data.source import DataSource, SceneSet
from pnet.data.views import SceneSource, StoredViews, Views
from pnet.parts.base import ParametricPart
from pnet.parts.choice import KeypointChoice, KeypointRule
from pnet.parts.spread import spread_order
from pnet.scenes.noise import NoNoise, SensorNoise


@dataclass(frozen=True)
class Targets:
    """How labels are made.

    Attributes:
        rule: which of the equivalent keypoints is the label: "camera" (GU, equation 1), "canonical" (the
            ablation "w/o GU") or "point" (nearest to the surface point; needs `FoldedVote`).
        direction: of the camera rule, see `KeypointChoice`; the paper's is (0, 0, 1).
        poses: also label every point with its instance's rotation, for methods that regress it.
    """

    rule: str = "camera"
    direction: Sequence[float] = (0.0, 0.0, 1.0)
    poses: bool = False

    @property
    def choice(self) -> KeypointChoice:
        """Which equivalent keypoint is the label."""
        if self.rule not in list(KeypointRule):
            raise ValueError(f"data.targets.rule is {self.rule!r}, choose {', '.join(KeypointRule)}")
        x, y, z = self.direction if len(self.direction) == 3 else (0, 0, 0)
        return KeypointChoice(KeypointRule(self.rule), (x, y, z))


class SceneDataModule(lightning.LightningDataModule):
    """Loaders of the splits train, val, test_l, test_g.

    Args:
        part: what the scenes show. source: the data set.
        targets, augmentation: see their classes; augmentation in training only.
        points: N, the first so many of a scene's points; None: all.
        batch_size: scenes. draws: scenes of an epoch; None: each once.
        val_every: keep every so many validation scenes. workers: loader processes. seed: of order and chance.
        tables: finds the backbone's tables of clouds (B, N, 3) in the loaders; None: the network does.
        pinned: batches in page-locked memory, for a GPU.
        views: where the training's scenes come from; None: the stored ones. noise: added to them; None: none.
        clutter: share of clutter scenes among those that a training draws; None: as many as there are.
        learn: share of the training's part objects that are learnt, spread over the grid, in (0, 1] (the
            paper's Table IV: 1/3 and 1/5). At least one is.
    """

    def __init__(
        self,
        part: ParametricPart,
        source: DataSource,
        targets: Targets,
        augmentation: Augmentation,
        points: int | None,
        batch_size: int,
        draws: int | None,
        val_every: int,
        workers: int,
        seed: int,
        tables: FindTables | None = None,
        learn: float = 1.0,
        views: Views | None = None,
        noise: SensorNoise | None = None,
        clutter: float | None = None,
        pinned: bool = False,
    ) -> None:
        super().__init__()
        if not 0 < learn <= 1:
            raise ValueError(f"data.learn is {learn:g}, expected a share in (0, 1], for instance 1/3")
        if points is not None and points < 1:
            raise ValueError(f"data.points is {points}, expected at least 1, or null for all")
        if batch_size < 1:
            raise ValueError(f"data.batch_size is {batch_size}, expected at least 1")
        self.part, self.source, self.targets, self.points = part, source, targets, points
        self._augmentation, self._batch_size, self._draws = augmentation, batch_size, draws
        self._val_every, self._workers, self._seed = val_every, workers, seed
        self._tables, self._learn, self._pinned = tables, learn, pinned
        self._views, self._noise, self._clutter = views or StoredViews(), noise or NoNoise(), clutter

    def scenes(self, split: str, every: int = 1) -> SceneSet:
        """The scenes of a split."""
        return self.source.scenes(split, self.part, every)

    def train_scenes(self) -> SceneSource:
        """The training scenes of the part objects that are learnt."""
        keep = self._learnt if self._learn < 1 else None
        return self._views.open(self.source, self.part, self.points, self._noise, keep)

    def _learnt(self, objects: set[int]) -> set[int]:
        """Of the part objects (places in the L grid) those to learn."""
        ordered = [place for place in spread_order(self.part.grids["L"]) if place in objects]
        return set(ordered[: max(1, round(self._learn * len(ordered)))])

    def train_dataloader(self) -> DataLoader[Any]:
        """Training scenes, augmented, in an order that (seed, epoch) decides."""
        scenes = self.train_scenes()
        dataset = LabelledScenes(
            scenes,
            self.part.chain,
            self.targets.choice,
            self.points,
            self._augmentation,
            self._seed,
            self._posed,
        )
        if (self._draws or len(scenes)) < self._batch_size:
            raise ValueError(
                f"data.batch_size is {self._batch_size}, but an epoch has only "
                f"{self._draws or len(scenes)} scenes; lower it or make more scenes"
            )
        rank, world = (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
        order = mixed_order([scene.kind for scene in scenes.ids], self._seed, self._clutter)
        sampler = EpochSampler(order, self._draws, rank, world)
        return self._loader(dataset, sampler, drop_last=True)

    def val_dataloader(self) -> DataLoader[Any]:
        """Validation scenes as they are."""
        return self._unchanged(self.scenes("val", self._val_every))

    def test_dataloader(self, split: str = "test_l") -> DataLoader[Any]:
        """Scenes of a test split as they are: test_l (part objects of the training) or test_g (others)."""
        return self._unchanged(self.scenes(split))

    def _unchanged(self, scenes: SceneSet) -> DataLoader[Any]:
        dataset = LabelledScenes(
            scenes,
            self.part.chain,
            self.targets.choice,
            self.points,
            posed=self._posed,
        )
        return self._loader(dataset, None, drop_last=False)

    @property
    def _posed(self) -> ParametricPart | None:
        return self.part if self.targets.poses else None

    def _loader(
        self, dataset: LabelledScenes, sampler: EpochSampler | None, drop_last: bool
    ) -> DataLoader[Any]:
        return DataLoader(
            dataset,
            batch_size=self._batch_size,
            sampler=sampler,
            drop_last=drop_last,
            num_workers=self._workers,
            persistent_workers=self._workers > 0,
            pin_memory=self._pinned,
            collate_fn=Collate(self._tables),
            generator=torch.Generator().manual_seed(self._seed),
        )
