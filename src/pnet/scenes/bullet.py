"""Physics by PyBullet (the extra [sim])."""

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

from pnet.scenes.physics import Body, Physics
from pnet.scenes.pile import Bin, Points

# The engine's margins and thresholds are made for bodies of decimetres: lengths and gravity are scaled.
SCALE = 10.0
WALL = 0.02  # thickness of floor and walls, metres
CHECK = 16  # steps between two looks at what still moves
QUIET = 3  # looks in a row that must find everything at rest


@dataclass(frozen=True)
class BulletPhysics(Physics):
    """PyBullet's settings.

    Attributes:
        friction, restitution: of every body; a contact has the product of its two.
        rolling_friction: resistance to rolling and spinning, metres times 10; without it a flange on its
            rim rolls on and on. angular_damping: share of turn lost per second.
        solver_iterations: of the contact solver in each step.
    """

    time_step: float = 1 / 480
    max_seconds: float = 3.0
    rest_speed: float = 0.005
    rest_turn: float = 0.3
    friction: float = 0.4
    drop_height: float = 0.01
    collision: str = "filled"
    restitution: float = 0.05
    rolling_friction: float = 0.005
    angular_damping: float = 0.1
    solver_iterations: int = 20

    def world(self, body: Body, box: Bin, limit: int) -> "BulletWorld":
        """An empty bin.

        Raises:
            ModuleNotFoundError: without PyBullet.
        """
        return BulletWorld(body, box, self)


class BulletWorld:
    """One simulation; see `World`. Lengths inside are metres times SCALE."""

    def __init__(self, body: Body, box: Bin, physics: BulletPhysics) -> None:
        bullet, client = connect()
        self._bullet: Any = bullet
        self._client: Any = client
        self._physics = physics
        self._inertia = (body.inertia * SCALE**2).tolist()
        self._bodies: list[int] = []
        client.setGravity(0, 0, -9.81 * SCALE)
        client.setPhysicsEngineParameter(
            fixedTimeStep=physics.time_step,
            numSolverIterations=physics.solver_iterations,
            deterministicOverlappingPairs=1,
        )
        self._add_box(box)
        self._shape = self._compound(body.pieces)

    def release(self, R: Points, t: Points) -> None:
        """See `World`."""
        body = self._client.createMultiBody(
            1.0,
            self._shape,
            basePosition=(SCALE * t).tolist(),
            baseOrientation=Rotation.from_matrix(R).as_quat().tolist(),
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
            localInertiaDiagonal=self._inertia,
            activationState=self._bullet.ACTIVATION_STATE_ENABLE_SLEEPING,
        )
        self._bodies.append(body)

    def settle(self, max_seconds: float) -> bool:
        """See `World`."""
        quiet = 0
        for _ in range(round(max_seconds / self._physics.time_step / CHECK)):
            for _ in range(CHECK):
                self._client.stepSimulation()
            quiet = quiet + 1 if self._at_rest() else 0
            if quiet == QUIET:
                return True
        return False

    def run(self, seconds: float) -> None:
        """See `World`."""
        for _ in range(round(seconds / self._physics.time_step)):
            self._client.stepSimulation()

    def _at_rest(self) -> bool:
        for body in reversed(self._bodies):  # the latest body moves longest
            velocity, turn = self._client.getBaseVelocity(body)
            if np.linalg.norm(velocity) > self._physics.rest_speed * SCALE:
                return False
            if np.linalg.norm(turn) > self._physics.rest_turn:
                return False
        return True

    def poses(self) -> tuple[Points, Points]:
        """See `World`."""
        found = [self._client.getBasePositionAndOrientation(body) for body in self._bodies]
        if not found:
            return np.zeros((0, 3, 3)), np.zeros((0, 3))
        position, quaternion = zip(*found, strict=True)
        return Rotation.from_quat(quaternion).as_matrix(), np.array(position) / SCALE

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """See `World`."""
        for body, stays in zip(self._bodies, chosen, strict=True):
            if not stays:
                self._client.removeBody(body)
        self._bodies = [body for body, stays in zip(self._bodies, chosen, strict=True) if stays]

    def speeds(self) -> tuple[Points, Points]:
        """See `World`."""
        found = np.array([self._client.getBaseVelocity(body) for body in self._bodies]).reshape(-1, 2, 3)
        speed, turn = np.linalg.norm(found, axis=-1).T
        return speed / SCALE, turn

    def penetration(self) -> float:
        """See `World`."""
        self._client.performCollisionDetection()
        gaps = [contact[8] for contact in self._client.getContactPoints()]
        return max(-min(gaps, default=0.0), 0.0) / SCALE

    def close(self) -> None:
        """See `World`."""
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
        for half, centre in box.slabs(WALL):
            shape = self._client.createCollisionShape(
                self._bullet.GEOM_BOX, halfExtents=(SCALE * half).tolist()
            )
            side = self._client.createMultiBody(
                0,
                shape,
                basePosition=(SCALE * centre).tolist(),
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
            "making piles needs PyBullet: install pnet with its extra [sim] (wheels exist for Python 3.11), "
            "or take physics=mujoco"
        ) from missing
    with _silent():
        return pybullet, BulletClient(pybullet.DIRECT)
