"""Both stages together: from a task to a cycle's scenes."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from time import perf_counter

from pnet.records import Scene
from pnet.scenes.noise import NoNoise
from pnet.scenes.pile import Pile
from pnet.scenes.pile_factory import PileFactory
from pnet.scenes.pile_store import PileHeader
from pnet.scenes.protocol import SPLITS, CycleTask
from pnet.scenes.store import CycleHeader
from pnet.scenes.view_factory import ViewFactory, ViewTimes


@dataclass
class StageTimes(ViewTimes):
    """Seconds spent by stage, summed over scenes."""

    simulate: float = 0.0
    write: float = 0.0


@dataclass
class Cycle:
    """A finished cycle: its scenes, and what its header has to tell."""

    header: CycleHeader
    scenes: list[Scene]
    times: StageTimes = field(default_factory=StageTimes)


@dataclass(frozen=True, eq=False)
class SceneFactory:
    """Everything that a data set is made from.

    Attributes:
        piles, views: the two stages. fingerprint: digest of all settings, kept in every file of scenes.
        noise_in: splits to whose scenes the sensor's noise is added.
    """

    piles: PileFactory
    views: ViewFactory
    fingerprint: str
    noise_in: Sequence[str] = SPLITS

    @cached_property
    def _exact_views(self) -> ViewFactory:
        return replace(self.views, noise=NoNoise())

    def make_cycle(self, task: CycleTask) -> Cycle:
        """Make one cycle; a pure function of the settings and the task."""
        start = perf_counter()
        header, piles = self.piles.make_piles(task)
        simulated = perf_counter() - start
        cycle = self.render_cycle(task, header, piles)
        cycle.times.simulate += simulated
        return cycle

    def render_cycle(self, task: CycleTask, made: PileHeader, piles: Sequence[Pile]) -> Cycle:
        """The scenes of a cycle whose piles are there."""
        views = self.views if task.split in self.noise_in else self._exact_views
        times, scenes = StageTimes(), []
        for pile in piles:
            rng = task.rng(self.piles.seed, made.part, pile.drop)
            scene = views.view(pile, made.parameters, task.scene_id(pile.drop), rng, times)
            if scene is not None:
                scenes.append(scene)
        header = CycleHeader(
            fingerprint=self.fingerprint,
            part=made.part,
            camera=self.views.camera,
            split=task.split,
            kind=task.kind,
            cycle=task.cycle,
            part_index=task.part_index,
            drops=tuple(scene.id.drop for scene in scenes),
            escaped=piles[-1].escaped,
            unsettled=sum(not pile.settled for pile in piles),
            empty=len(piles) - len(scenes),
        )
        return Cycle(header, scenes, times)
