"""Piles by physics: bodies at rest, inside the bin, not inside each other."""

import itertools
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from pnet.scenes.pile import Bin
from pnet.scenes.piling import Physics, collision_pieces, pile_bodies

SRC = Path(__file__).parents[2] / "src"
HALF_MILLIMETRE = 0.0005
WIDE = Bin(0.3, 0.3, 0.1)


def piles(part, box, drops, seed=0, index=0, **physics):
    rng = np.random.default_rng(seed)
    return list(pile_bodies(part, part.part_object("L", index), box, drops, Physics(**physics), rng))


def world_corners(part, pile, index=0) -> np.ndarray:
    """(d, n, 3) vertices of every body, world frame."""
    vertices = part.mesh(part.part_object("L", index)).vertices
    return np.einsum("dij,nj->dni", pile.R, vertices) + pile.t[:, None]


def face_normals_and_edges(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outward normals and edge directions of a convex hull."""
    hull = ConvexHull(corners)
    edges = np.concatenate([np.diff(corners[s[[0, 1, 2, 0]]], axis=0) for s in hull.simplices])
    edges /= np.linalg.norm(edges, axis=1, keepdims=True)
    edges *= np.sign(edges @ [1.0, np.e, np.pi])[:, None]
    return np.unique(hull.equations[:, :3].round(6), axis=0), np.unique(edges.round(6), axis=0)


def penetration(a: np.ndarray, b: np.ndarray) -> float:
    """Least overlap of two convex bodies along all candidate axes; not positive where they are apart."""
    (na, ea), (nb, eb) = face_normals_and_edges(a), face_normals_and_edges(b)
    cross = np.cross(ea[:, None], eb[None]).reshape(-1, 3)
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    cross = (cross / np.maximum(length, 1e-12))[length[:, 0] > 1e-3]
    axes = np.concatenate([na, nb, cross, -cross])
    return float(((a @ axes.T).max(0) - (b @ axes.T).min(0)).min())


def test_penetration_of_two_boxes_by_hand():
    box = np.array(list(itertools.product((0.0, 1.0), repeat=3)))
    assert penetration(box, box + np.array([0.9, 0.3, 0.2])) == pytest.approx(0.1)
    assert penetration(box, box + np.array([1.2, 0, 0])) == pytest.approx(-0.2)


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
    pieces = part.convex_pieces(part.part_object("L", 0), fill_holes=True)
    placed = [[p @ R.T + t for p in pieces] for R, t in zip(pile.R, pile.t, strict=True)]
    depth = [
        penetration(p, q) for a, b in itertools.combinations(placed, 2) for p, q in itertools.product(a, b)
    ]
    assert -0.001 < max(depth) < HALF_MILLIMETRE


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
    pile = pile_bodies(tn34, tn34.part_object("L", 0), box, 5, Physics(), np.random.default_rng(0))
    next(pile)
    client = pile.gi_frame.f_locals["world"]._client
    assert client.isConnected()
    pile.close()
    with pytest.raises(Exception, match=r"[Nn]ot connected"):
        client.stepSimulation()


@pytest.mark.parametrize("collision", ["filled", "exact", "hull"])
def test_collision_shapes_reach_as_far_as_the_mesh(part, collision):
    parameters = part.part_object("L", 0)
    pieces = collision_pieces(part, parameters, collision)
    corners = np.concatenate(pieces)
    np.testing.assert_allclose([corners.min(0), corners.max(0)], part.mesh(parameters).bounds, atol=1e-8)
    assert len(pieces) == 1 if collision == "hull" else len(pieces) >= 1


@pytest.mark.usefixtures("bullet")
def test_a_body_of_exact_pieces_rests_at_the_same_height(tn34):
    filled, exact = (piles(tn34, WIDE, 1, collision=c)[0] for c in ("filled", "exact"))
    assert filled.t[0, 2] == pytest.approx(exact.t[0, 2], abs=HALF_MILLIMETRE)


def test_an_unknown_collision_shape_is_refused():
    with pytest.raises(ValueError, match=r"physics.collision is 'mesh', choose filled, exact or hull"):
        Physics(collision="mesh")


def test_without_the_engine_the_error_names_the_extra(monkeypatch, tn34, box):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(ModuleNotFoundError, match=r"extra \[sim\]"):
        piles(tn34, box, 1)


@pytest.mark.usefixtures("bullet")
def test_connecting_prints_nothing_on_the_screen():
    """In a process of its own: the engine speaks when it is imported first."""
    script = "from pnet.scenes.piling import connect; connect(); print('done')"
    done = subprocess.run(
        [sys.executable, "-c", script], env={**os.environ, "PYTHONPATH": str(SRC)}, capture_output=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, b"done\n", b"")
