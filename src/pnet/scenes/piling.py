"""Piles by physics: bodies dropped into a bin, one by one or anew for every number of them."""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from pnet.parts.base import ParametricPart
from pnet.scenes.physics import Body, Physics, World, make_body
from pnet.scenes.pile import Bin, Pile, Points

ESCAPE_MARGIN = 0.01  # a body this far outside the walls has left the bin, metres
POUR_INTERVAL = 0.1  # simulated seconds between two bodies that are poured


def pile_bodies(
    part: ParametricPart,
    parameters: Points,
    box: Bin,
    drops: Sequence[int],
    physics: Physics,
    rng: np.random.Generator,
) -> Iterator[Pile]:
    """Fill a bin one body at a time; the pile at rest is kept on.

    Args:
        part, parameters: the part object, (k,) metres. drops: after how many bodies a pile is wanted, rising.
        rng: the only source of chance.
    Yields:
        A `Pile` for every one of `drops`; bodies that left the bin are removed and counted.
    Raises:
        ModuleNotFoundError: without the engine.
    """
    body = make_body(part, parameters, physics.collision)
    world = physics.world(body, box, drops[-1])
    escaped = 0
    try:
        for drop in range(1, drops[-1] + 1):
            release_above(world, body, box, physics.drop_height, rng)
            settled = world.settle(physics.max_seconds)
            escaped += remove_escaped(world, box)
            if drop in drops:
                R, t = world.poses()
                yield Pile(R, t, drop, escaped, settled)
    finally:
        world.close()


def pour_bodies(
    part: ParametricPart,
    parameters: Points,
    box: Bin,
    drops: Sequence[int],
    physics: Physics,
    rng: np.random.Generator,
) -> Iterator[Pile]:
    """Fill an empty bin anew for every number of bodies, one shortly after the other.

    Piles of one cycle have nothing in common then; their making takes longer, as n bodies are dropped for
    the n-th. Arguments, yields and errors as `pile_bodies`; `escaped` counts on from pile to pile.
    """
    body = make_body(part, parameters, physics.collision)
    escaped = 0
    for drop in drops:
        world = physics.world(body, box, drop)
        try:
            for _ in range(drop):
                release_above(world, body, box, physics.drop_height, rng)
                world.run(POUR_INTERVAL)
            settled = world.settle(physics.max_seconds)
            escaped += remove_escaped(world, box)
            R, t = world.poses()
        finally:
            world.close()
        yield Pile(R, t, drop, escaped, settled)


def release_above(world: World, body: Body, box: Bin, gap: float, rng: np.random.Generator) -> None:
    """Release one body above the pile, at a random place and orientation. gap: to the pile's top, metres."""
    half = np.array([box.width, box.depth]) / 2 - body.radius
    place = rng.uniform(-1, 1, 2) * np.maximum(half, 0)
    top = max(world.poses()[1][:, 2].max(initial=-body.radius) + body.radius, 0.0)
    world.release(Rotation.random(rng=rng).as_matrix(), np.array([*place, top + body.radius + gap]))


def remove_escaped(world: World, box: Bin) -> int:
    """Take bodies out that left the bin; how many."""
    inside = box.contains(world.poses()[1], ESCAPE_MARGIN)
    if not inside.all():
        world.keep(inside)
    return int((~inside).sum())
