"""Physics by MuJoCo (the extra [mujoco]).

What makes a pile slow is solving all its contacts at every step while only the body on top moves. So a
body that has come to rest stands still as a part of the bin, its twin, until something moves next to it;
before a pile counts as settled, all of it is simulated once more (see `MujocoWorld.settle`).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pnet.scenes.physics import Body, Physics
from pnet.scenes.pile import Bin, Points

WALL = 0.02  # thickness of floor and walls, metres
LOOK = 2  # steps between two looks at what moves
QUIET = 12  # steps a body must be slow for to stand still
CONFIRM = 12  # steps all bodies are simulated for, to see that they stay
WAKE_SPEED = 0.02  # metres per second, WAKE_TURN: radians per second; what moves faster wakes its neighbours
WAKE_TURN = 1.0
REACH = 0.006  # gap between bounding spheres of neighbours, metres: a falling body's way between two looks
TRAVEL = 0.0015  # metres; a step is divided where a body would move further in it, else edges reach too deep
FINEST = 4  # parts of a step at most
CONTACT = 2.16  # time constant of a contact's spring in steps; the engine allows no stiffer one than 2
IMPEDANCE = (0.95, 0.99, 0.0005, 0.5, 2.0)  # of contacts (solimp): hard, and harder from 0.5 mm on


@dataclass(frozen=True)
class MujocoPhysics(Physics):
    """MuJoCo's settings.

    Attributes:
        friction: of every contact.
        rolling_friction: resistance to rolling, metres; with twice of it a nut may stay on an edge.
        spinning_friction: resistance to spinning about a contact's normal, metres; with a third of it some
            flanges rattle on and on.
        iterations: of the contact solver in each step, at most. tolerance: improvement at which it stops.
    """

    time_step: float = 1 / 240
    max_seconds: float = 3.0
    rest_speed: float = 0.005
    rest_turn: float = 0.3
    friction: float = 0.2
    drop_height: float = 0.01
    collision: str = "filled"
    rolling_friction: float = 0.0005
    spinning_friction: float = 0.003
    iterations: int = 25
    tolerance: float = 1e-4

    def world(self, body: Body, box: Bin, limit: int) -> "MujocoWorld":
        """An empty bin.

        Raises:
            ModuleNotFoundError: without MuJoCo.
        """
        return MujocoWorld(body, box, limit, self)


class MujocoWorld:
    """One simulation; see `World`.

    Every body has a place of its own (slot) in the arrays of the engine, and is there twice: as a body that
    moves and as its twin that stands still. One of the two lies in the bin, the other is parked far away,
    the moving one asleep. Slots are taken in the order of release and not used again.
    """

    def __init__(self, body: Body, box: Bin, limit: int, physics: MujocoPhysics) -> None:
        self._mujoco = import_mujoco()
        self._physics = physics
        self._radius = body.radius
        self._reach = 2 * body.radius + REACH
        self._model = build_model(self._mujoco, body, box, limit, physics)
        self._data = self._mujoco.MjData(self._model)
        self._parked: Points = self._data.mocap_pos.copy()
        self._released = 0
        self._slots: NDArray[np.int64] = np.zeros(0, np.int64)  # of the bodies in the bin
        self._awake: NDArray[np.bool_] = np.zeros(limit, bool)  # for every slot: it is the moving one
        self._quiet: NDArray[np.int64] = np.zeros(limit, np.int64)  # for every slot: steps it has been slow

    def release(self, R: Points, t: Points) -> None:
        """See `World`."""
        slot = self._released
        self._released += 1
        self._slots = np.append(self._slots, slot)
        self._data.mocap_pos[slot] = t
        self._data.mocap_quat[slot] = Rotation.from_matrix(R).as_quat()[[3, 0, 1, 2]]
        self._set_awake(slot, True)

    def settle(self, max_seconds: float) -> bool:
        """See `World`. Where everything stands still, all bodies are woken: none of them may move then."""
        left = round(max_seconds / self._physics.time_step)
        while left > 0:
            if self._awake.any():
                self._advance()
                left -= LOOK
                continue
            self._set_awake(self._slots, True)
            self._step(CONFIRM)
            left -= CONFIRM
            self._set_awake(self._slots[self._slow()], False)
            if not self._awake.any():
                return True
        return False

    def run(self, seconds: float) -> None:
        """See `World`."""
        for _ in range(round(seconds / self._physics.time_step / LOOK)):
            if self._awake.any():
                self._advance()

    def wake(self) -> None:
        """Let every body move again, as if it had just been laid where it is."""
        self._set_awake(self._slots, True)

    def poses(self) -> tuple[Points, Points]:
        """See `World`."""
        pose = self._all_poses()[self._slots]
        if not len(pose):
            return np.zeros((0, 3, 3)), np.zeros((0, 3))
        return Rotation.from_quat(pose[:, [4, 5, 6, 3]]).as_matrix(), pose[:, :3].copy()

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """See `World`."""
        gone, self._slots = self._slots[~chosen], self._slots[chosen]
        self._set_awake(gone, False)
        self._data.mocap_pos[gone] = self._parked[gone]

    def speeds(self) -> tuple[Points, Points]:
        """See `World`. Bodies that stand still have the speed 0."""
        found = self._data.qvel.reshape(-1, 2, 3)[self._slots]
        speed, turn = np.sqrt(np.einsum("dij,dij->id", found, found))
        return speed, turn

    def penetration(self) -> float:
        """See `World`."""
        everything = self._mujoco.MjData(self._model)
        everything.qpos.reshape(-1, 7)[self._slots] = self._all_poses()[self._slots]
        self._mujoco.mj_forward(self._model, everything)
        return max(-float(everything.contact.dist.min(initial=0.0)), 0.0)

    def close(self) -> None:
        """See `World`. The engine's memory goes with the object."""

    def _advance(self) -> None:
        """Simulate up to the next look; wake what lies next to something fast, let stand what is slow."""
        self._step(LOOK)
        slots, (speed, turn) = self._slots, self.speeds()
        self._quiet[slots] = np.where(self._slow(), self._quiet[slots] + LOOK, 0)
        near = self._beside((speed > WAKE_SPEED) | (turn > WAKE_TURN))
        awake = self._awake[slots]
        stops = awake & ~near & (self._quiet[slots] >= QUIET)
        if (stops | (near & ~awake)).any():
            self._set_awake(slots, (awake | near) & ~stops)

    def _beside(self, moving: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which bodies (d,) can touch one of those that move (d,), these among them."""
        if not moving.any():
            return moving
        t = self._all_poses()[self._slots, :3]
        away = t[:, None] - t[moving]
        return (np.einsum("dmi,dmi->dm", away, away) < self._reach**2).any(1)

    def _slow(self) -> NDArray[np.bool_]:
        """Which bodies (d,) are at rest."""
        speed, turn = self.speeds()
        return (speed < self._physics.rest_speed) & (turn < self._physics.rest_turn)

    def _step(self, steps: int) -> None:
        """Simulate `steps` time steps, in smaller parts where something is fast."""
        speed, turn = self.speeds()
        travel = (speed + turn * self._radius).max(initial=0.0) * self._physics.time_step
        parts = int(np.ceil(np.clip(np.nan_to_num(travel / TRAVEL), 1, FINEST)))
        part = self._physics.time_step / parts
        self._model.opt.timestep, self._model.geom_solref[:, 0] = part, CONTACT * part
        self._mujoco.mj_step(self._model, self._data, steps * parts)
        if any(warning.number for warning in self._data.warning):  # a reset clears them
            raise ValueError("the simulation is unstable: choose a shorter physics.time_step")

    def _all_poses(self) -> Points:
        """Where each slot's body lies, (limit, 7): position, metres, and quaternion w, x, y, z."""
        data = self._data
        still = np.concatenate([data.mocap_pos, data.mocap_quat], axis=1)
        return np.where(self._awake[:, None], data.qpos.reshape(-1, 7), still)

    def _set_awake(self, slots: NDArray[np.int64] | int, value: NDArray[np.bool_] | bool) -> None:
        """Choose which bodies move; those that do already go on as they are, the others start at rest.

        The engine puts bodies to sleep on a reset only, so it is reset and the moving bodies are put back.
        """
        data, awake = self._data, self._awake.copy()
        awake[slots] = value
        pose, stays = self._all_poses(), awake & self._awake
        velocity, warm = data.qvel.reshape(-1, 6).copy(), data.qacc_warmstart.reshape(-1, 6).copy()
        self._mujoco.mj_resetData(self._model, data)
        data.qpos.reshape(-1, 7)[awake] = pose[awake]
        data.qvel.reshape(-1, 6)[stays] = velocity[stays]
        data.qacc_warmstart.reshape(-1, 6)[stays] = warm[stays]
        data.mocap_pos[:] = np.where(awake[:, None], self._parked, pose[:, :3])
        data.mocap_quat[:] = pose[:, 3:]
        self._quiet[awake & ~self._awake] = 0
        self._awake = awake


def build_model(mujoco: Any, body: Body, box: Bin, limit: int, physics: MujocoPhysics) -> Any:
    """The bin, `limit` parked bodies of 1 kg that can move and as many twins that cannot."""
    spec = mujoco.MjSpec()
    spec.option.timestep = physics.time_step
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.iterations = physics.iterations
    spec.option.tolerance = physics.tolerance
    spec.option.ls_tolerance = 0.05
    spec.option.sleep_tolerance = 1e-9  # nothing falls asleep by itself
    spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    contact: dict[str, Any] = {
        "solref": (CONTACT * physics.time_step, 1.0),  # again in each step
        "solimp": IMPEDANCE,
        "friction": (physics.friction, physics.spinning_friction, physics.rolling_friction),
        "condim": 6,  # friction against sliding, spinning and rolling
    }
    for half, centre in box.slabs(WALL):
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=centre, **contact)
    meshes = [f"piece{i}" for i in range(len(body.pieces))]
    for mesh, piece in zip(meshes, body.pieces, strict=True):
        spec.add_mesh(name=mesh, uservert=piece.ravel())
    moving: dict[str, Any] = {
        "mass": 1.0,
        "inertia": body.inertia,
        "ipos": (0.0, 0.0, 0.0),  # has no default next to a mass
        "explicitinertial": True,
        "sleep": mujoco.mjtSleepPolicy.mjSLEEP_INIT,
    }
    for depth, kind in ((-100.0, moving), (-200.0, {"mocap": True})):
        for slot in range(limit):
            parked = spec.worldbody.add_body(pos=(float(slot), 0.0, depth), **kind)
            if kind is moving:
                parked.add_freejoint()
            for mesh in meshes:
                parked.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, **contact)
    return spec.compile()


def import_mujoco() -> Any:
    """The engine's module."""
    try:
        import mujoco
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            "making piles with physics=mujoco needs MuJoCo: install pnet with its extra [mujoco]"
        ) from missing
    mujoco.set_mju_user_warning(lambda message: None)  # else a log file appears in the working directory
    return mujoco
