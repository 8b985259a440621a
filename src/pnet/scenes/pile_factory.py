"""The first stage: from a task to a cycle's piles."""

from collections.abc import Iterator
from dataclasses import dataclass

from pnet.parts.base import ParametricPart, Points
from pnet.scenes.clutter import Clutter
from pnet.scenes.physics import Physics
from pnet.scenes.pile import Bin, Pile
from pnet.scenes.pile_store import PileHeader
from pnet.scenes.piling import pile_bodies, pour_bodies
from pnet.scenes.protocol import CycleTask, Protocol


@dataclass(frozen=True, eq=False)
class PileFactory:
    """Everything that piles are made from.

    Attributes:
        part, protocol, box, physics, clutter: see their classes. seed: of the whole data set.
        fingerprint: digest of the settings, kept in every file.
    """

    part: ParametricPart
    protocol: Protocol
    box: Bin
    physics: Physics
    clutter: Clutter
    seed: int
    fingerprint: str

    def make_piles(self, task: CycleTask) -> tuple[PileHeader, list[Pile]]:
        """Make one cycle's piles; a pure function of the settings and the task."""
        parameters = self.part.part_object(task.grid, task.part_index)
        piles = list(self._piles(task, parameters))
        drops = tuple(pile.drop for pile in piles)
        place = (task.split, task.kind, task.grid, task.cycle, task.part_index)
        return PileHeader(self.fingerprint, self.part.name, *place, tuple(parameters.tolist()), drops), piles

    def _piles(self, task: CycleTask, parameters: Points) -> Iterator[Pile]:
        rng, drops = task.rng(self.seed, self.part.name), self.protocol.scene_drops()
        if task.kind == "clutter":
            for drop in drops:
                yield self.clutter.scatter(self.part, parameters, self.box, drop, rng)
            return
        fill = pour_bodies if self.protocol.dropping == "anew" else pile_bodies
        yield from fill(self.part, parameters, self.box, drops, self.physics, rng)
