"""What a data set consists of: splits, part objects, cycles (Table I of the paper)."""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pnet.records import SceneId

SPLITS = ("train", "val", "test_l", "test_g")
KINDS = ("pile", "clutter")
DROPPINGS = ("one_by_one", "anew")


@dataclass(frozen=True)
class SplitPlan:
    """One split.

    Attributes:
        grid: "L" (part objects that training sees) or "G" (others).
        objects: whole numbers are indices into the grid, numbers like 0.7 a place in it as a share of its
            size, so that one protocol serves grids of any size; None: all of them.
        count: instead of objects, so many of them, spread over the grid (all where it has fewer).
        first_cycle, cycles: numbers of the cycles of piles; no two splits of one grid may share one.
        clutter: share of clutter cycles, which come beside the piles, in [0, 1); training only.
    """

    grid: str
    cycles: int
    first_cycle: int = 0
    objects: Sequence[int | float] | None = None
    count: int | None = None
    clutter: float = 0.0

    @property
    def clutter_cycles(self) -> int:
        """Number of clutter cycles beside the piles."""
        return round(self.cycles * self.clutter / (1 - self.clutter))


@dataclass(frozen=True)
class CycleTask:
    """One file to make: a cycle of one part object."""

    split: str
    kind: str
    grid: str
    cycle: int
    part_index: int

    def scene_id(self, drop: int) -> SceneId:
        """The id of the scene after `drop` bodies."""
        return SceneId(self.split, self.kind, self.cycle, self.part_index, drop)

    def rng(self, seed: int, part: str, *more: int) -> np.random.Generator:
        """The task's own generator: a pure function of seed, part, grid, part object, kind and cycle (and of
        `more`: a scene's drop)."""
        key = (seed, zlib.crc32(part.encode()), zlib.crc32(self.grid.encode()))
        return np.random.default_rng([*key, self.part_index, KINDS.index(self.kind), self.cycle, *more])


class Protocol:
    """The plan of a data set.

    Args:
        name: for folders and tables. drop_limit: bodies dropped in a cycle.
        drop_step: a scene is taken after every `drop_step` bodies.
        dropping: "one_by_one": a pile grows by one body at a time (Table I); "anew": the bin is filled from
            empty for every number of bodies.
        by_part: what differs for some templates: name → drop_limit, splits, or both.
        points: N, points of a scene. splits: by name.
    """

    def __init__(
        self,
        name: str,
        drop_limit: int,
        points: int,
        splits: Mapping[str, SplitPlan],
        drop_step: int = 1,
        dropping: str = "one_by_one",
        by_part: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        if drop_limit < 1 or drop_step < 1 or points < 1:
            raise ValueError(
                f"protocol {name}: drop_limit, drop_step and points must be at least 1, got "
                f"{drop_limit}, {drop_step}, {points}"
            )
        if dropping not in DROPPINGS:
            raise ValueError(f"protocol {name}: dropping is {dropping!r}, choose {' or '.join(DROPPINGS)}")
        for split, plan in splits.items():
            _check_split(name, split, plan)
        self.name, self.drop_limit, self.drop_step, self.points = name, drop_limit, drop_step, points
        self.splits, self.dropping = dict(splits), dropping
        self._by_part = {part: self._varied(part, changes) for part, changes in (by_part or {}).items()}
        self._check_disjoint()

    def _varied(self, part: str, changes: Mapping[str, Any]) -> "Protocol":
        unknown = sorted(set(changes) - {"drop_limit", "splits"})
        if unknown:
            raise ValueError(f"protocol {self.name}, by_part.{part}: {unknown[0]} cannot differ by part")
        given = {"drop_limit": self.drop_limit, "splits": self.splits, **changes}
        rest: dict[str, Any] = {"points": self.points, "drop_step": self.drop_step, "dropping": self.dropping}
        return Protocol(f"{self.name}, {part}", **rest, **given)

    def for_part(self, part: str) -> "Protocol":
        """The plan for a template."""
        return self._by_part.get(part, self)

    def scene_drops(self) -> list[int]:
        """Numbers of dropped bodies after which a scene is taken; the full bin always."""
        return list(range(self.drop_limit, 0, -self.drop_step))[::-1]

    def tasks(self, orders: Mapping[str, Sequence[int]]) -> list[CycleTask]:
        """Every file of the data set, small splits first.

        Args:
            orders: places of each grid's part objects, in the order by which `count` takes them (see
                `spread_order`); splits of a grid that a part lacks are left out.
        """
        found = []
        for split in sorted(self.splits, key=lambda s: s == "train"):
            plan = self.splits[split]
            if plan.grid not in orders:
                continue
            objects = self._objects(split, orders[plan.grid])
            for kind, count in (("pile", plan.cycles), ("clutter", plan.clutter_cycles)):
                cycles = range(plan.first_cycle, plan.first_cycle + count)
                found += [
                    CycleTask(split, kind, plan.grid, cycle, index) for cycle in cycles for index in objects
                ]
        return found

    def _objects(self, split: str, order: Sequence[int]) -> list[int]:
        """Places of a split's part objects in the grid of which `order` is a permutation."""
        plan, size = self.splits[split], len(order)
        if plan.count is not None:
            return sorted(order[: plan.count])
        chosen = range(size) if plan.objects is None else plan.objects
        places = [int(place * size) if isinstance(place, float) else place for place in chosen]
        for place in places:
            if not 0 <= place < size:
                raise ValueError(
                    f"protocol {self.name}, split {split}: part object {place} is not in grid "
                    f"{plan.grid}, which has 0 to {size - 1}"
                )
        return list(dict.fromkeys(places))

    def _check_disjoint(self) -> None:
        taken: dict[tuple[str, int], str] = {}
        for split, plan in self.splits.items():
            for cycle in range(plan.first_cycle, plan.first_cycle + plan.cycles):
                other = taken.setdefault((plan.grid, cycle), split)
                if other != split:
                    raise ValueError(
                        f"protocol {self.name}: splits {other} and {split} share cycle {cycle} of grid "
                        f"{plan.grid}; give them different first_cycle"
                    )


def _check_split(protocol: str, split: str, plan: SplitPlan) -> None:
    where = f"protocol {protocol}, split {split}"
    if split not in SPLITS:
        raise ValueError(f"{where}: no such split, choose from {', '.join(SPLITS)}")
    if plan.grid not in ("L", "G"):
        raise ValueError(f"{where}: grid is {plan.grid!r}, choose L or G")
    if plan.cycles < 1:
        raise ValueError(f"{where}: cycles is {plan.cycles}, expected at least 1")
    if plan.count is not None and (plan.count < 1 or plan.objects is not None):
        raise ValueError(f"{where}: count is {plan.count}, expected at least 1, and no objects beside it")
    if not 0 <= plan.clutter < 1:
        raise ValueError(f"{where}: clutter is {plan.clutter}, expected a share in [0, 1)")
    if plan.clutter and split != "train":
        raise ValueError(f"{where}: clutter belongs in training only, it would flatter a test")
