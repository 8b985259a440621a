"""What stands for a part in a simulation, and what PyBullet's world says of itself."""

from dataclasses import fields

import numpy as np
import pytest
from omegaconf import OmegaConf
from scipy.spatial import ConvexHull
from tests.conftest import CONF, Marble

from pnet.scenes.bullet import BulletPhysics
from pnet.scenes.overlap import ConvexPiece, penetration
from pnet.scenes.physics import COLLISIONS, make_body
from pnet.scenes.pile import Bin
from pnet.scenes.piling import release_above

HALF_MILLIMETRE = 0.0005


# bodies


@pytest.mark.parametrize("collision", COLLISIONS)
def test_collision_shapes_reach_as_far_as_the_mesh(part, collision):
    parameters = part.part_object("L", 0)
    corners = np.concatenate(make_body(part, parameters, collision).pieces)
    np.testing.assert_allclose([corners.min(0), corners.max(0)], part.mesh(parameters).bounds, atol=1e-8)


def volumes(part, collision) -> list[float]:
    return [ConvexHull(piece).volume for piece in make_body(part, part.part_object("L", 0), collision).pieces]


def test_a_hull_is_one_piece_and_holes_are_filled_where_asked(tn06):
    """A nut: its ring is cut into pieces, or filled to one prism, which is its hull."""
    exact, filled, hull = (volumes(tn06, collision) for collision in ("exact", "filled", "hull"))
    assert len(hull) == len(filled) == 1 < len(exact)
    r, h, _ = tn06.part_object("L", 0)
    assert sum(exact) == pytest.approx(tn06.mesh(tn06.part_object("L", 0)).volume, rel=1e-6)
    assert sum(exact) < filled[0] == pytest.approx(hull[0])
    assert filled[0] - sum(exact) == pytest.approx(np.pi * r**2 * h, rel=0.01)


def test_the_hull_of_a_flange_holds_more_than_its_pieces(tn34):
    filled, hull = volumes(tn34, "filled"), volumes(tn34, "hull")
    assert len(hull) == 1 < len(filled) and sum(filled) < 0.95 * hull[0]


def test_a_balls_inertia_and_radius():
    body = make_body(Marble({"r": [10]}), np.array([0.01]), "hull")
    np.testing.assert_allclose(body.inertia, 0.4 * 0.01**2, rtol=0.01)
    assert body.radius == pytest.approx(0.01)


def test_inertia_is_the_exact_parts_whatever_stands_for_it(part):
    parameters = part.part_object("L", 0)
    first, *others = (make_body(part, parameters, collision) for collision in COLLISIONS)
    for other in others:
        np.testing.assert_array_equal(other.inertia, first.inertia)
        assert other.radius == first.radius
    # the principal moments of any body obey the triangle inequality
    assert (first.inertia > 0).all() and 2 * first.inertia.max() <= first.inertia.sum()


def test_an_unknown_collision_shape_is_refused():
    with pytest.raises(ValueError, match=r"physics.collision is 'mesh', choose filled, exact, hull"):
        BulletPhysics(collision="mesh")


def test_the_config_holds_every_setting_and_the_classs_own_values():
    shipped = OmegaConf.to_container(OmegaConf.load(CONF / "physics" / "pybullet.yaml"))
    assert shipped.pop("_target_") == "pnet.scenes.bullet.BulletPhysics"
    assert shipped == pytest.approx({f.name: f.default for f in fields(BulletPhysics)})


# PyBullet's world


@pytest.fixture
def open_world(bullet):
    """Opens worlds and closes them."""
    opened = []

    def go(part, box, **settings):
        physics = BulletPhysics(**settings)
        body = make_body(part, part.part_object("L", 0), physics.collision)
        opened.append(physics.world(body, box, 60))
        return opened[-1], body, physics

    yield go
    for world in opened:
        world.close()


def test_an_empty_world_has_no_poses_and_is_at_rest(open_world, tn34, box):
    world, _, _ = open_world(tn34, box)
    R, t = world.poses()
    assert R.shape == (0, 3, 3) and t.shape == (0, 3)
    assert world.settle(1.0) and world.penetration() == 0
    speed, turn = world.speeds()
    assert speed.shape == turn.shape == (0,)


def test_a_body_falls_as_galileo_says(open_world, tn34, box):
    """After 0.1 s from rest g t² / 2 (and half a step more, as velocities come first); it does not turn."""
    world, _, physics = open_world(tn34, box)
    start = np.array([0.01, -0.02, 0.12])
    world.release(np.eye(3), start)
    world.run(0.1)
    R, t = world.poses()
    np.testing.assert_allclose(t[0], start - [0, 0, 9.81 * 0.1 * (0.1 + physics.time_step) / 2], atol=2e-5)
    np.testing.assert_allclose(R[0], np.eye(3), atol=1e-6)
    speed, turn = world.speeds()
    assert speed[0] == pytest.approx(0.981, rel=0.001) and turn[0] < 1e-6


def test_poses_come_in_the_order_of_release_and_go_when_not_kept(open_world, tn34, box):
    world, _, _ = open_world(tn34, box)
    for x in (-0.05, 0.0, 0.05):
        world.release(np.eye(3), np.array([x, 0, 0.1]))
    np.testing.assert_allclose(world.poses()[1][:, 0], [-0.05, 0, 0.05], atol=1e-6)
    world.keep(np.array([True, False, True]))
    np.testing.assert_allclose(world.poses()[1][:, 0], [-0.05, 0.05], atol=1e-6)
    assert [len(found) for found in world.speeds()] == [2, 2]
    world.release(np.eye(3), np.array([0.02, 0, 0.1]))
    np.testing.assert_allclose(world.poses()[1][:, 0], [-0.05, 0.05, 0.02], atol=1e-6)


def test_bodies_released_inside_each_other_penetrate(open_world, tn06, box):
    """Two nuts on one axis, the upper one 2 mm too low."""
    world, _, _ = open_world(tn06, box)
    height = tn06.part_object("L", 0)[1]
    for z in (0.05, 0.05 + height - 0.002):
        world.release(np.eye(3), np.array([0, 0, z]))
    assert world.penetration() == pytest.approx(0.002, abs=HALF_MILLIMETRE)


@pytest.mark.parametrize("collision", COLLISIONS)
def test_a_settled_pile_is_slow_and_nothing_reaches_into_another(open_world, part, collision):
    """In a bin so narrow that six bodies lie on each other."""
    world, body, physics = open_world(part, Bin(0.05, 0.05, 0.15), collision=collision)
    rng = np.random.default_rng(2)
    for _ in range(6):
        release_above(world, body, Bin(0.05, 0.05, 0.15), physics.drop_height, rng)
        assert world.settle(physics.max_seconds)
    speed, turn = world.speeds()
    assert speed.max() < physics.rest_speed and turn.max() < physics.rest_turn
    assert 0 <= world.penetration() < HALF_MILLIMETRE
    pieces = [ConvexPiece(piece) for piece in body.pieces]
    poses = list(zip(*world.poses(), strict=True))
    deepest = max(penetration(pieces, *pose, poses[i + 1 :]) for i, pose in enumerate(poses[:-1]))
    assert -0.001 < deepest < HALF_MILLIMETRE


def test_time_runs_out_for_what_still_falls(open_world, tn34, box):
    world, _, _ = open_world(tn34, box)
    world.release(np.eye(3), np.array([0, 0, 0.14]))
    assert not world.settle(0.05)
    assert world.speeds()[0][0] > 0.3
    assert world.settle(3.0)
