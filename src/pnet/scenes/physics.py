"""What every physics engine promises: a bin, bodies that fall into it, and rest."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pnet.parts.base import ParametricPart
from pnet.scenes.pile import Bin, Points

COLLISIONS = ("filled", "exact", "hull")


@dataclass(frozen=True, eq=False)
class Body:
    """A part object as an engine takes it.

    Attributes:
        pieces: corner arrays (n_i, 3) of its convex pieces, part frame (origin at the centroid), metres.
        inertia: (3,) principal moments about the part frame's axes for a mass of 1 kg, kg m².
        radius: of the bounding sphere about the origin, metres.
    """

    pieces: list[Points]
    inertia: Points
    radius: float


def make_body(part: ParametricPart, parameters: Points, collision: str) -> Body:
    """The body of a part object.

    Args:
        parameters: (k,) metres.
        collision: "filled" (convex pieces, holes filled), "exact" (convex pieces) or "hull" (one hull).
    """
    mesh = part.mesh(parameters)
    pieces = part.convex_pieces(parameters, fill_holes=collision != "exact")
    return Body(
        [np.concatenate(pieces)] if collision == "hull" else pieces,
        np.diag(mesh.moment_inertia) / mesh.volume,
        float(np.linalg.norm(mesh.vertices, axis=1).max()),
    )


class World(Protocol):
    """One simulation. World frame: z up, origin in the middle of the bin's floor; metres, seconds."""

    def release(self, R: Points, t: Points) -> None:
        """Let one more body go, at rest, with this pose: R (3, 3), t (3,) part → world."""

    def settle(self, max_seconds: float) -> bool:
        """Simulate until nothing moves for a while; False where `max_seconds` come first."""

    def run(self, seconds: float) -> None:
        """Simulate for so long."""

    def poses(self) -> tuple[Points, Points]:
        """R (d, 3, 3), t (d, 3) of the bodies, in the order of their release."""

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """Take every body out that is not chosen: (d,) bool."""

    def speeds(self) -> tuple[Points, Points]:
        """How fast each body moves, (d,) m/s, and turns, (d,) rad/s."""

    def penetration(self) -> float:
        """How deep the deepest contact reaches, metres; 0 where nothing overlaps."""

    def close(self) -> None:
        """End the simulation."""


@dataclass(frozen=True)
class Physics(ABC):
    """How bodies fall; a subclass is an engine.

    Attributes:
        time_step: seconds. max_seconds: simulated time per dropped body after which it counts as unsettled.
        rest_speed: metres per second, rest_turn: radians per second; below both, a body is at rest.
        friction: Coulomb coefficient; engines differ in whether of a contact or of a body.
        drop_height: gap between the pile's top and the next body, metres.
        collision: what stands for a body in contacts, see `make_body`.
    """

    time_step: float
    max_seconds: float
    rest_speed: float
    rest_turn: float
    friction: float
    drop_height: float
    collision: str

    def __post_init__(self) -> None:
        if self.collision not in COLLISIONS:
            raise ValueError(f"physics.collision is {self.collision!r}, choose {', '.join(COLLISIONS)}")

    @abstractmethod
    def world(self, body: Body, box: Bin, limit: int) -> World:
        """An empty bin for at most `limit` bodies of one kind."""
