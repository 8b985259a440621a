"""Piles by physics: bodies at rest, inside the bin, not inside each other."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pnet.scenes.bullet import BulletPhysics
from pnet.scenes.overlap import ConvexPiece, penetration
from pnet.scenes.physics import Physics, make_body
from pnet.scenes.pile import Bin
from pnet.scenes.piling import POUR_INTERVAL, pile_bodies, pour_bodies, release_above

SRC = Path(__file__).parents[2] / "src"
HALF_MILLIMETRE = 0.0005
WIDE = Bin(0.3, 0.3, 0.1)


def piles(part, box, drops, seed=0, index=0, fill=pile_bodies, **physics):
    rng, physics = np.random.default_rng(seed), BulletPhysics(**physics)
    return list(fill(part, part.part_object("L", index), box, range(1, drops + 1), physics, rng))


def world_corners(part, pile, index=0) -> np.ndarray:
    """(d, n, 3) vertices of every body, world frame."""
    vertices = part.mesh(part.part_object("L", index)).vertices
    return np.einsum("dij,nj->dni", pile.R, vertices) + pile.t[:, None]


def deepest_overlap(part, pile, index=0) -> float:
    """How deep the bodies' convex pieces reach into each other, over all pairs of bodies."""
    pieces = [ConvexPiece(p) for p in part.convex_pieces(part.part_object("L", index), True)]
    poses = list(zip(pile.R, pile.t, strict=True))
    return max(penetration(pieces, *pose, poses[i + 1 :]) for i, pose in enumerate(poses[:-1]))


@pytest.mark.usefixtures("bullet")
@pytest.mark.parametrize("seed", range(6))
def test_one_nut_comes_to_rest_on_an_end_or_on_a_side(tn06, seed):
    _, h, d = tn06.part_object("L", 0)
    (pile,) = piles(tn06, WIDE, 1, seed)
    assert pile.settled and pile.escaped == 0 and pile.drop == 1
    stable = np.array([h / 2, d * np.sqrt(0.75)])
    assert np.abs(stable - pile.t[0, 2]).min() < HALF_MILLIMETRE
    upright = np.abs(pile.R[0, 2, 2])
    assert upright > 0.999 if np.abs(stable - pile.t[0, 2]).argmin() == 0 else upright < 0.01


@pytest.mark.usefixtures("bullet")
@pytest.mark.parametrize("seed", range(4))
def test_one_flange_comes_to_rest_on_an_end(tn34, seed):
    """Its centroid lies low in the disc, its height over either end is the mesh's own."""
    (pile,) = piles(tn34, WIDE, 1, seed)
    lowest = world_corners(tn34, pile)[0, :, 2].min()
    assert abs(lowest) < HALF_MILLIMETRE
    assert abs(pile.R[0, 2, 2]) > 0.999


@pytest.mark.usefixtures("bullet")
def test_a_pile_lies_in_the_bin_on_the_floor(part, box):
    pile = piles(part, box, 8)[-1]
    assert pile.settled and len(pile.R) == 8
    corners = world_corners(part, pile)
    assert corners[..., 2].min() > -HALF_MILLIMETRE
    assert (np.abs(corners[..., :2]) < box.width / 2 + HALF_MILLIMETRE).all()
    assert corners[..., 2].min() < HALF_MILLIMETRE  # some body touches the floor


@pytest.mark.usefixtures("bullet")
def test_bodies_do_not_reach_into_each_other(part):
    """In a bin so narrow that eight bodies lie on each other."""
    pile = piles(part, Bin(0.05, 0.05, 0.15), 8)[-1]
    assert len(pile.R) == 8 and pile.t[:, 2].max() > 0.0115  # a flat nut on a flat nut
    assert -0.001 < deepest_overlap(part, pile) < HALF_MILLIMETRE


@pytest.mark.usefixtures("bullet")
def test_a_pile_comes_after_every_drop_and_bodies_stay_where_they_are(tn34):
    found = piles(tn34, WIDE, 4)
    assert [pile.drop for pile in found] == [1, 2, 3, 4]
    assert [len(pile.R) for pile in found] == [1, 2, 3, 4]
    np.testing.assert_allclose(found[-1].t[0], found[0].t[0], atol=HALF_MILLIMETRE)


@pytest.mark.usefixtures("bullet")
def test_the_generator_alone_decides(tn34, box):
    first, again, other = (piles(tn34, box, 5, seed)[-1] for seed in (3, 3, 4))
    assert first.R.tobytes() == again.R.tobytes() and first.t.tobytes() == again.t.tobytes()
    assert np.abs(first.t - other.t).max() > 1e-3


@pytest.mark.usefixtures("bullet")
def test_poses_are_rotations(tn06, box):
    R = piles(tn06, box, 3)[-1].R
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(R), 1)


@pytest.mark.usefixtures("bullet")
@pytest.mark.parametrize("tiny", [Bin(0.02, 0.02, 0.001), Bin(0.04, 0.04, 0.002)])
def test_bodies_that_leave_the_bin_are_removed_and_counted(part, tiny):
    """Bins lower and hardly wider than one part: most of what is dropped slides off."""
    found = piles(part, tiny, 8)
    for pile in found:
        assert len(pile.R) + pile.escaped == pile.drop
        assert tiny.contains(pile.t, margin=0.01).all()
    escaped = [pile.escaped for pile in found]
    assert escaped == sorted(escaped) and escaped[-1] > 0


@pytest.mark.usefixtures("bullet")
def test_a_pile_that_runs_out_of_time_says_so(tn34, box):
    (pile,) = piles(tn34, box, 1, max_seconds=0.04)
    assert not pile.settled


@pytest.mark.usefixtures("bullet")
def test_an_abandoned_pile_ends_its_simulation(tn34, box):
    pile = pile_bodies(
        tn34, tn34.part_object("L", 0), box, range(1, 6), BulletPhysics(), np.random.default_rng(0)
    )
    next(pile)
    client = pile.gi_frame.f_locals["world"]._client
    assert client.isConnected()
    pile.close()
    with pytest.raises(Exception, match=r"[Nn]ot connected"):
        client.stepSimulation()


@pytest.mark.usefixtures("bullet")
def test_a_body_of_exact_pieces_rests_at_the_same_height(tn34):
    filled, exact = (piles(tn34, WIDE, 1, collision=c)[0] for c in ("filled", "exact"))
    assert filled.t[0, 2] == pytest.approx(exact.t[0, 2], abs=HALF_MILLIMETRE)


def test_without_the_engine_the_error_names_the_extra(monkeypatch, tn34, box):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(ModuleNotFoundError, match=r"extra \[sim\]"):
        piles(tn34, box, 1)


@pytest.mark.usefixtures("bullet")
def test_connecting_prints_nothing_on_the_screen():
    """In a process of its own: the engine speaks when it is imported first."""
    script = "from pnet.scenes.bullet import connect; connect(); print('done')"
    done = subprocess.run(
        [sys.executable, "-c", script], env={**os.environ, "PYTHONPATH": str(SRC)}, capture_output=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, b"done\n", b"")


# poured anew for every number of bodies


@pytest.mark.usefixtures("bullet")
def test_as_many_bodies_are_poured_as_asked(part, box):
    body, rng = part.part_object("L", 0), np.random.default_rng(0)
    found = list(pour_bodies(part, body, box, [1, 4, 7], BulletPhysics(), rng))
    assert [pile.drop for pile in found] == [1, 4, 7] == [len(pile.R) for pile in found]
    assert all(pile.settled and pile.escaped == 0 for pile in found)
    for pile in found:
        corners = world_corners(part, pile)
        assert abs(corners[..., 2].min()) < HALF_MILLIMETRE
        assert (np.abs(corners[..., :2]) < box.width / 2 + HALF_MILLIMETRE).all()


@pytest.mark.usefixtures("bullet")
def test_piles_poured_anew_share_no_pose(tn34, box):
    found = piles(tn34, box, 4, fill=pour_bodies)
    poses = np.concatenate([np.concatenate([pile.R.reshape(-1, 9), pile.t], 1) for pile in found])
    assert len(np.unique(poses.round(5), axis=0)) == len(poses) == 1 + 2 + 3 + 4


@pytest.mark.usefixtures("bullet")
def test_bodies_poured_on_each_other_come_to_rest_outside_each_other(part):
    body, rng = part.part_object("L", 0), np.random.default_rng(1)
    (pile,) = pour_bodies(part, body, Bin(0.05, 0.05, 0.15), [8], BulletPhysics(), rng)
    assert pile.settled and len(pile.R) == 8
    assert -0.001 < deepest_overlap(part, pile) < HALF_MILLIMETRE


@pytest.mark.usefixtures("bullet")
def test_pouring_counts_the_escaped_on_and_says_what_is_not_at_rest(tn34):
    tiny = Bin(0.02, 0.02, 0.001)
    found = piles(tn34, tiny, 5, fill=pour_bodies)
    escaped = [pile.escaped for pile in found]
    assert escaped == sorted(escaped) and escaped[-1] > 0
    gone = np.diff([0, *escaped])
    assert [len(pile.R) + n for pile, n in zip(found, gone, strict=True)] == [1, 2, 3, 4, 5]
    assert not any(pile.settled for pile in piles(tn34, WIDE, 2, fill=pour_bodies, max_seconds=0.04))


@pytest.mark.usefixtures("bullet")
def test_the_generator_alone_decides_what_is_poured(tn34, box):
    first, again, other = (piles(tn34, box, 3, seed, fill=pour_bodies)[-1] for seed in (3, 3, 4))
    assert first.R.tobytes() == again.R.tobytes() and first.t.tobytes() == again.t.tobytes()
    assert np.abs(first.t - other.t).max() > 1e-3


# whatever the engine


class NotedWorld:
    """Notes what is asked of it; bodies stay where they are released, the second one leaves the bin."""

    def __init__(self, calls: list[tuple], limit: int) -> None:
        self.calls, self.R, self.t = calls, np.zeros((0, 3, 3)), np.zeros((0, 3))
        self.released = 0
        calls.append(("world", limit))

    def release(self, R, t):
        self.released += 1
        self.calls.append(("release", t.copy()))
        place = t if self.released != 2 else t + np.array([9.0, 0, 0])
        self.R, self.t = np.concatenate([self.R, R[None]]), np.concatenate([self.t, place[None]])

    def settle(self, max_seconds):
        self.calls.append(("settle", max_seconds))
        return self.released != 3

    def run(self, seconds):
        self.calls.append(("run", seconds))

    def poses(self):
        return self.R.copy(), self.t.copy()

    def keep(self, chosen):
        self.calls.append(("keep", chosen.tolist()))
        self.R, self.t = self.R[chosen], self.t[chosen]

    def close(self):
        self.calls.append(("close",))


class NotedPhysics(Physics):
    """The engine of a `NotedWorld`."""

    def __init__(self) -> None:
        super().__init__(1 / 100, 7.5, 0.01, 0.1, 0.4, 0.02, "hull")
        object.__setattr__(self, "calls", [])

    def world(self, body, box, limit):
        return NotedWorld(self.calls, limit)


def noted(part, fill, drops) -> tuple[list[tuple], list]:
    physics, rng = NotedPhysics(), np.random.default_rng(0)
    return physics.calls, list(fill(part, part.part_object("L", 0), WIDE, drops, physics, rng))


def test_a_growing_pile_settles_after_every_body_and_loses_the_escaped(tn34):
    calls, found = noted(tn34, pile_bodies, [1, 3, 4])
    assert [call[0] for call in calls] == [
        *("world", "release", "settle", "release", "settle", "keep"),
        *("release", "settle", "release", "settle", "close"),
    ]
    assert calls[0] == ("world", 4) and ("keep", [True, False]) in calls
    assert {call[1] for call in calls if call[0] == "settle"} == {7.5}
    assert [(pile.drop, len(pile.R), pile.escaped) for pile in found] == [(1, 1, 0), (3, 2, 1), (4, 3, 1)]
    assert [pile.settled for pile in found] == [True, False, True]


def test_pouring_lets_bodies_follow_each_other_and_settles_once_a_pile(tn34):
    calls, found = noted(tn34, pour_bodies, [1, 3])
    assert [call[0] for call in calls] == [
        *("world", "release", "run", "settle", "close"),
        *("world", "release", "run", "release", "run", "release", "run", "settle", "keep", "close"),
    ]
    assert [call[1] for call in calls if call[0] == "world"] == [1, 3]
    assert {call[1] for call in calls if call[0] == "run"} == {POUR_INTERVAL}
    assert [(pile.drop, len(pile.R), pile.escaped, pile.settled) for pile in found] == [
        (1, 1, 0, True),
        (3, 2, 1, False),
    ]


def test_a_body_is_released_over_the_highest_one_within_the_walls(tn34):
    """The lowest point of its bounding sphere is `drop_height` above the highest body's."""
    body = make_body(tn34, tn34.part_object("L", 0), "hull")
    rng, calls = np.random.default_rng(0), []
    world = NotedWorld(calls, 60)
    world.released = 2  # nobody leaves
    for _ in range(40):
        release_above(world, body, WIDE, 0.02, rng)
    places = np.array([call[1] for call in calls if call[0] == "release"])
    gaps = 2 * body.radius + 0.02
    np.testing.assert_allclose(places[:, 2], body.radius + 0.02 + gaps * np.arange(40))
    half = 0.15 - body.radius
    assert (np.abs(places[:, :2]) <= half).all() and np.abs(places[:, :2]).max() > 0.9 * half
    narrow = NotedWorld([], 1)
    release_above(narrow, body, Bin(0.001, 0.001, 0.1), 0.02, rng)
    assert np.abs(narrow.t[:, :2]).max() == 0  # in the middle, where it fits nowhere


def test_the_world_is_closed_when_something_fails(tn34, monkeypatch):
    def broken(*_):
        raise RuntimeError("no memory")

    monkeypatch.setattr(NotedWorld, "settle", broken)
    for fill in (pile_bodies, pour_bodies):
        physics = NotedPhysics()
        with pytest.raises(RuntimeError, match="no memory"):
            list(fill(tn34, tn34.part_object("L", 0), WIDE, [1], physics, np.random.default_rng(0)))
        assert physics.calls[-1] == ("close",)
