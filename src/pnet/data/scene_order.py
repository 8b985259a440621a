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
    """Two orders mixed by a share: exactly in every block of as many places as the share's denominator, and
    by chance within it, so that processes which take every n-th place see both.

    Args:
        first, second: the orders. share: of the second, in [0, 1]. seed: of the places.
    """

    def __init__(self, first: SceneOrder, second: SceneOrder, share: float, seed: int) -> None:
        if not 0 <= share <= 1:
            raise ValueError(f"data.clutter is {share}, expected a share in [0, 1]")
        self._first, self._second, self._seed = first, second, seed
        exact = Fraction(share).limit_denominator(1000)
        self._many, self._length = exact.numerator, exact.denominator
        self._block, self._is_second = -1, np.zeros(self._length, bool)

    def __len__(self) -> int:
        return len(self._first) + len(self._second)

    def __getitem__(self, position: int) -> int:
        block, place = divmod(position, self._length)
        if block != self._block:
            rng = np.random.default_rng([self._seed, block, 2])  # after the streams of the two orders
            self._is_second, self._block = rng.permutation(self._length) < self._many, block
        before = block * self._many + int(self._is_second[:place].sum())
        return self._second[before] if self._is_second[place] else self._first[position - before]


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
    return Mixture(pile, more, clutter, seed)
