"""What a cycle's scenes promise to whoever learns from them."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from pnet.scenes.factory import SceneFactory
from pnet.scenes.pile import Bin
from pnet.scenes.protocol import CycleTask, Protocol, SplitPlan

PILE = CycleTask("train", "pile", "L", 0, 5)
CLUTTER = CycleTask("train", "clutter", "L", 0, 5)
BOTH = pytest.mark.parametrize("task", [PILE, CLUTTER], ids=["pile", "clutter"])
ARRAYS = ("points", "instance", "R", "t", "parameters", "visibility", "occlusion")

pytestmark = pytest.mark.usefixtures("bullet")


def drops_of(limit: int, step: int = 1, points: int = 256) -> Protocol:
    return Protocol("tiny", limit, points, {"train": SplitPlan("L", 1)}, step)


@BOTH
def test_a_scene_is_taken_after_every_drop(factory, task):
    cycle = factory.make_cycle(task)
    assert cycle.header.drops == (1, 2, 3)
    assert [str(scene.id) for scene in cycle.scenes] == [
        f"train/{task.kind}_0000_part_05/00{drop}" for drop in (1, 2, 3)
    ]
    assert [len(scene.R) for scene in cycle.scenes] == [1, 2, 3]
    assert (cycle.header.split, cycle.header.kind, cycle.header.part) == ("train", task.kind, "tn34")


@BOTH
def test_arrays_have_the_shapes_and_types_of_a_scene(factory, task):
    scene = factory.make_cycle(task).scenes[-1]
    assert scene.points.shape == (256, 3) and scene.points.dtype == np.float32
    assert scene.instance.shape == (256,) and scene.instance.dtype == np.int64
    assert scene.R.shape == (3, 3, 3) and scene.t.shape == (3, 3)
    assert scene.parameters.shape == (3, 2)
    assert scene.visibility.shape == scene.occlusion.shape == (3,)


@BOTH
def test_every_point_lies_on_the_surface_of_its_instance(factory, task):
    mesh = factory.part.mesh(factory.part.part_object("L", 5))
    for scene in factory.make_cycle(task).scenes:
        assert scene.instance.min() >= 0 and scene.instance.max() < len(scene.R)
        R, t = scene.R[scene.instance], scene.t[scene.instance]
        local = np.einsum("nji,nj->ni", R, scene.points - t)
        distance = trimesh.proximity.closest_point_naive(mesh, local)[1]
        assert distance.max() < 1e-4


@BOTH
def test_visibility_and_occlusion_are_shares(factory, task):
    for scene in factory.make_cycle(task).scenes:
        for share in (scene.visibility, scene.occlusion):
            assert (share >= 0).all() and (share <= 1).all()
        assert scene.visibility.max() == 1
        assert (scene.occlusion[scene.visibility == 0] == 1).all()


def test_labels_are_the_part_objects_own(factory):
    scene = factory.make_cycle(PILE).scenes[-1]
    np.testing.assert_array_equal(scene.parameters, np.tile(factory.part.part_object("L", 5), (3, 1)))
    np.testing.assert_allclose(scene.R @ scene.R.transpose(0, 2, 1), np.stack([np.eye(3)] * 3), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(scene.R), 1)


def test_the_camera_looks_straight_down_on_the_bin(factory):
    """One flange on its end: the centroid is as far from the camera as it lies above the floor."""
    scene = factory.make_cycle(PILE).scenes[0]
    lowest = (factory.part.mesh(scene.parameters[0]).vertices @ scene.R[0].T + scene.t[0])[:, 2].max()
    assert lowest == pytest.approx(factory.camera_height, abs=0.0005)
    assert (np.abs(scene.t[0, :2]) < factory.box.width / 2).all()


def test_points_come_in_farthest_point_order(factory):
    """Progressive: each point is at most as far from those before it as the one before was."""
    points = factory.make_cycle(PILE).scenes[-1].points.astype(float)
    gaps = [np.linalg.norm(points[:i] - points[i], axis=1).min() for i in range(1, len(points))]
    assert (np.diff(gaps) <= 1e-7).all() and gaps[0] > 0.01


def test_few_pixels_are_repeated_to_fill_a_scene(factory):
    many = replace(factory, protocol=drops_of(1, points=4096))
    scene = many.make_cycle(PILE).scenes[0]
    assert scene.points.shape == (4096, 3)
    distinct = len(np.unique(scene.points, axis=0))
    assert distinct < 2048
    np.testing.assert_array_equal(scene.points[:distinct], scene.points[distinct : 2 * distinct])
    np.testing.assert_array_equal(scene.instance[:distinct], scene.instance[distinct : 2 * distinct])


def test_a_step_keeps_the_full_bin_and_changes_no_scene(factory):
    every = replace(factory, protocol=drops_of(5)).make_cycle(PILE)
    some = replace(factory, protocol=drops_of(5, step=2)).make_cycle(PILE)
    assert some.header.drops == (1, 3, 5)
    for scene, twin in zip(some.scenes, every.scenes[::2], strict=True):
        for name in ARRAYS:
            np.testing.assert_array_equal(getattr(scene, name), getattr(twin, name))


@BOTH
def test_a_cycle_is_a_function_of_settings_and_task(factory, task):
    first, again = factory.make_cycle(task), factory.make_cycle(task)
    assert first.header == again.header
    for a, b in zip(first.scenes, again.scenes, strict=True):
        for name in ARRAYS:
            assert getattr(a, name).tobytes() == getattr(b, name).tobytes()
    other = replace(factory, seed=1).make_cycle(task)
    assert np.abs(other.scenes[-1].t - first.scenes[-1].t).max() > 1e-3


def test_bodies_that_left_the_bin_are_counted(factory: SceneFactory):
    low = replace(factory, box=Bin(0.02, 0.02, 0.001), protocol=drops_of(6))
    cycle = low.make_cycle(PILE)
    assert cycle.header.escaped > 0
    assert len(cycle.scenes[-1].R) + cycle.header.escaped == cycle.scenes[-1].id.drop


def test_a_scene_without_a_visible_body_is_left_out_and_counted(factory, camera):
    blind = replace(factory, camera=replace(camera, near=0.3, far=0.31))
    cycle = blind.make_cycle(PILE)
    assert cycle.scenes == [] and cycle.header.drops == () and cycle.header.empty == 3


def test_a_scene_not_at_rest_is_counted(factory):
    hasty = replace(factory, physics=replace(factory.physics, max_seconds=0.04))
    assert hasty.make_cycle(PILE).header.unsettled == 3


def test_a_camera_too_near_to_the_bin_is_refused(factory):
    low = replace(factory, camera_height=0.31)
    with pytest.raises(ValueError, match="nearer than its near plane"):
        low.make_cycle(PILE)


def test_times_are_kept_by_stage(factory):
    times = factory.make_cycle(PILE).times
    assert min(times.simulate, times.render, times.sample) > 0 and times.write == 0
