"""Piles by physics: bodies dropped one by one into a bin, a pile after each (PyBullet)."""

import ctypes
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pnet.parts.base import ParametricPart
from pnet.scenes.pile import Bin, Pile, Points

# The engine's margins and thresholds are made for bodies of decimetres: lengths and gravity are scaled.
SCALE = 10.0
WALL = 0.02  # thickness of floor and walls, metres
ESCAPE_MARGIN = 0.01  # a body this far outside the walls has left the bin, metres


@dataclass(frozen=True)
class Physics:
    """How bodies fall.

    Attributes:
        time_step: seconds. max_seconds: simulated time per dropped body after which it counts as unsettled.
        rest_speed: metres per second, rest_turn: radians per second; below both, a body is at rest.
        friction, restitution: Coulomb friction and bounce of every contact.
        rolling_friction: resistance to rolling and spinning, metres times 10; without it a flange on its
            rim rolls on and on. angular_damping: share of turn lost per second.
        solver_iterations: of the contact solver in each step.
        drop_height: gap between the pile's top and the next body, metres.
        collision: "filled" (convex pieces, holes filled), "exact" (convex pieces) or "hull".
    """

    time_step: float = 1 / 480
    max_seconds: float = 3.0
    rest_speed: float = 0.005
    rest_turn: float = 0.3
    friction: float = 0.4
    restitution: float = 0.05
    rolling_friction: float = 0.005
    angular_damping: float = 0.1
    solver_iterations: int = 20
    drop_height: float = 0.01
    collision: str = "filled"

    def __post_init__(self) -> None:
        if self.collision not in ("filled", "exact", "hull"):
            raise ValueError(f"physics.collision is {self.collision!r}, choose filled, exact or hull")


def collision_pieces(part: ParametricPart, parameters: Points, collision: str) -> list[Points]:
    """Corner arrays (n_i, 3) of the convex pieces that stand for a body in contacts."""
    pieces = part.convex_pieces(parameters, fill_holes=collision != "exact")
    return [np.concatenate(pieces)] if collision == "hull" else pieces


def pile_bodies(
    part: ParametricPart,
    parameters: Points,
    box: Bin,
    drop_limit: int,
    physics: Physics,
    rng: np.random.Generator,
) -> Iterator[Pile]:
    """Fill a bin one body at a time.

    Args:
        part, parameters: the part object, (k,) metres. drop_limit: how many bodies are dropped.
        rng: the only source of chance.
    Yields:
        A `Pile` after each drop; bodies that left the bin are removed and counted.
    Raises:
        ModuleNotFoundError: without PyBullet (the extra `sim`).
    """
    world = _World(part, parameters, box, physics)
    try:
        for drop in range(1, drop_limit + 1):
            world.drop_body(rng)
            settled = world.settle()
            world.remove_escaped()
            R, t = world.poses()
            yield Pile(R, t, drop, world.escaped, settled)
    finally:
        world.close()


class _World:
    """One simulation; everything that knows PyBullet. Lengths inside are metres times SCALE."""

    def __init__(self, part: ParametricPart, parameters: Points, box: Bin, physics: Physics) -> None:
        bullet, client = connect()
        self._bullet: Any = bullet
        self._client: Any = client
        self._physics, self._box = physics, box
        mesh = part.mesh(parameters)
        self._radius = float(np.linalg.norm(mesh.vertices, axis=1).max())
        self._inertia = np.diag(mesh.moment_inertia) / mesh.volume * SCALE**2
        self.escaped = 0
        self._bodies: list[int] = []
        client.setGravity(0, 0, -9.81 * SCALE)
        client.setPhysicsEngineParameter(
            fixedTimeStep=physics.time_step,
            numSolverIterations=physics.solver_iterations,
            deterministicOverlappingPairs=1,
        )
        self._add_box(box)
        pieces = collision_pieces(part, parameters, physics.collision)
        self._shape = self._compound(pieces)

    def drop_body(self, rng: np.random.Generator) -> None:
        """Release one body above the pile, at a random place and orientation."""
        half = np.array([self._box.width, self._box.depth]) / 2 - self._radius
        place = rng.uniform(-1, 1, 2) * np.maximum(half, 0)
        top = max((self.poses()[1][:, 2].max() + self._radius if self._bodies else 0.0), 0.0)
        height = top + self._radius + self._physics.drop_height
        body = self._client.createMultiBody(
            1.0,
            self._shape,
            basePosition=(SCALE * np.array([*place, height])).tolist(),
            baseOrientation=Rotation.random(rng=rng).as_quat().tolist(),
            useMaximalCoordinates=True,  # a plain rigid body: twice as fast, and it comes to rest
        )
        self._client.changeDynamics(
            body,
            -1,
            lateralFriction=self._physics.friction,
            restitution=self._physics.restitution,
            rollingFriction=self._physics.rolling_friction,
            spinningFriction=self._physics.rolling_friction,
            angularDamping=self._physics.angular_damping,
            mass=1.0,  # again: setting the inertia alone forgets it
            localInertiaDiagonal=self._inertia.tolist(),
            activationState=self._bullet.ACTIVATION_STATE_ENABLE_SLEEPING,
        )
        self._bodies.append(body)

    def settle(self) -> bool:
        """Step until nothing moves for a while; False when the time limit comes first."""
        check, quiet = 16, 0
        for _ in range(round(self._physics.max_seconds / self._physics.time_step / check)):
            for _ in range(check):
                self._client.stepSimulation()
            quiet = quiet + 1 if self._at_rest() else 0
            if quiet == 3:
                return True
        return False

    def _at_rest(self) -> bool:
        for body in reversed(self._bodies):  # the latest body moves longest
            velocity, turn = self._client.getBaseVelocity(body)
            if np.linalg.norm(velocity) > self._physics.rest_speed * SCALE:
                return False
            if np.linalg.norm(turn) > self._physics.rest_turn:
                return False
        return True

    def remove_escaped(self) -> None:
        """Take bodies out that left the bin."""
        if not self._bodies:
            return
        inside = self._box.contains(self.poses()[1], ESCAPE_MARGIN)
        for body, stays in zip(self._bodies, inside, strict=True):
            if not stays:
                self._client.removeBody(body)
        self.escaped += int((~inside).sum())
        self._bodies = [b for b, stays in zip(self._bodies, inside, strict=True) if stays]

    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """R (d, 3, 3), t (d, 3) metres, part → world."""
        found = [self._client.getBasePositionAndOrientation(body) for body in self._bodies]
        if not found:
            return np.zeros((0, 3, 3)), np.zeros((0, 3))
        position, quaternion = zip(*found, strict=True)
        return Rotation.from_quat(quaternion).as_matrix(), np.array(position) / SCALE

    def close(self) -> None:
        """End the simulation."""
        self._client.disconnect()

    def _compound(self, pieces: list[Points]) -> int:
        """A shape of convex hulls; the engine takes several only from a file, one object a hull."""
        with tempfile.TemporaryDirectory(prefix="pnet-") as folder:
            path = Path(folder) / "pieces.obj"
            path.write_text(_wavefront(pieces))
            shape: int = self._client.createCollisionShape(
                self._bullet.GEOM_MESH, fileName=str(path), meshScale=[SCALE] * 3
            )
        return shape

    def _add_box(self, box: Bin) -> None:
        w, d, h, wall = box.width / 2, box.depth / 2, box.height / 2, WALL / 2
        sides = [
            ((w + WALL, d + WALL, wall), (0, 0, -wall)),
            ((wall, d + WALL, h), (w + wall, 0, h)),
            ((wall, d + WALL, h), (-w - wall, 0, h)),
            ((w + WALL, wall, h), (0, d + wall, h)),
            ((w + WALL, wall, h), (0, -d - wall, h)),
        ]
        for half, centre in sides:
            shape = self._client.createCollisionShape(
                self._bullet.GEOM_BOX, halfExtents=(SCALE * np.array(half)).tolist()
            )
            side = self._client.createMultiBody(
                0,
                shape,
                basePosition=(SCALE * np.array(centre)).tolist(),
                useMaximalCoordinates=True,
            )
            self._client.changeDynamics(side, -1, lateralFriction=self._physics.friction)


def _wavefront(pieces: list[Points]) -> str:
    lines, first = [], 1
    for i, piece in enumerate(pieces):
        hull = trimesh.convex.convex_hull(piece)
        lines.append(f"o piece{i}")
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in hull.vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in hull.faces + first]
        first += len(hull.vertices)
    return "\n".join(lines) + "\n"


@contextmanager
def _silent() -> Iterator[None]:
    """The engine prints its build time from C, to either stream; keep that off the user's screen."""
    streams = (sys.stdout, sys.stderr)
    for stream in streams:
        stream.flush()
    kept = [os.dup(number) for number in (1, 2)]
    try:
        with open(os.devnull, "w") as nowhere:
            for number in (1, 2):
                os.dup2(nowhere.fileno(), number)
            yield
    finally:
        for stream in streams:
            stream.flush()
        ctypes.CDLL(None).fflush(None)  # what C still buffers must not reach the screen later
        for number, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, number)
            os.close(copy)


def connect() -> tuple[Any, Any]:
    """A fresh PyBullet simulation: the module and its client."""
    try:
        with _silent():
            import pybullet
            from pybullet_utils.bullet_client import BulletClient
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            "making piles needs PyBullet: install pnet with its extra [sim] (wheels exist for Python 3.11)"
        ) from missing
    with _silent():
        return pybullet, BulletClient(pybullet.DIRECT)
