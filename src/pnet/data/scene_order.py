"""Which scene comes when in a training: endless orders, pure functions of the seed."""

from collections.abc import Sequence
from fractions import Fraction
from typing import Protocol

import numpy as np


class SceneOrder(Protocol):
    """An endless row of scene indices."""

    def __len__(self) -> int:
        """How many scenes it goes over."""

    def __getitem__(self, position: int) -> int:
        """The scene at a position of the row."""


class Permutations:
    """One permutation of the scenes after another.

    Args:
        scenes: their indices. seed: of all permutations; `stream` tells apart several with one seed.
    """

    def __init__(self, scenes: Sequence[int], seed: int, stream: int | None = None) -> None:
        self._scenes = np.asarray(scenes, dtype=np.int64)
        self._key = [] if stream is None else [stream]
        self._seed, self._turn, self._order = seed, -1, self._scenes

    def __len__(self) -> int:
        return len(self._scenes)

    def __getitem__(self, position: int) -> int:
        turn, place = divmod(position, len(self))
        if turn != self._turn:
            rng = np.random.default_rng([self._seed, turn, *self._key])
            self._order, self._turn = self._scenes[rng.permutation(len(self))], turn
        return int(self._order[place])


class Mixture:
    """Two orders mixed by a share, evenly at any length.

    Args:
        first, second: the orders. share: of the second, in [0, 1].
    """

    def __init__(self, first: SceneOrder, second: SceneOrder, share: float) -> None:
        if not 0 <= share <= 1:
            raise ValueError(f"data.clutter is {share}, expected a share in [0, 1]")
        # exact at any position: a float's product would lose its last digits
        self._first, self._second, self._share = first, second, Fraction(share).limit_denominator(1000)

    def __len__(self) -> int:
        return len(self._first) + len(self._second)

    def __getitem__(self, position: int) -> int:
        before, after = int(position * self._share), int((position + 1) * self._share)
        return self._second[before] if after > before else self._first[position - before]


def mixed_order(kinds: Sequence[str], seed: int, clutter: float | None) -> SceneOrder:
    """The order of a training.

    Args:
        kinds: "pile" or "clutter" of every scene. clutter: share of clutter among those drawn; None: all
            scenes equally often.
    Raises:
        ValueError: where a kind is asked for of which there is no scene.
    """
    if clutter is None:
        return Permutations(range(len(kinds)), seed)
    places = {kind: [i for i, found in enumerate(kinds) if found == kind] for kind in ("pile", "clutter")}
    for kind, share in (("pile", 1 - clutter), ("clutter", clutter)):
        if share > 0 and not places[kind]:
            raise ValueError(
                f"data.clutter={clutter:g} asks for scenes of kind {kind}, but training has none of them"
            )
    pile, more = (Permutations(places[kind], seed, i) for i, kind in enumerate(("pile", "clutter")))
    return Mixture(pile, more, clutter)
