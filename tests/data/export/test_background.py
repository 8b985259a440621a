"""The empty bin's depth: by hand, and by casting rays at the slabs that physics has."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from pnet.data.export.background import Background, bin_depth
from pnet.scenes.pile import Bin
from pnet.scenes.viewpoints import LOOKING_DOWN, Viewpoints

ABOVE = (LOOKING_DOWN, np.array([0, 0, 0.65]))


def slab_triangles(box, R, t, wall):
    slabs = []
    for half, centre in box.slabs(wall):
        slab = trimesh.creation.box(2 * half)
        slab.apply_translation(centre)
        slabs.append(slab.triangles)
    return np.concatenate(slabs) @ R.T + t


def test_from_straight_above_floor_and_walls_are_where_they_are(eye, box):
    depth = bin_depth(eye, box, *ABOVE)
    v, u = np.mgrid[: eye.height, : eye.width]
    x, y = np.abs(u - eye.cx) / eye.fx, np.abs(v - eye.cy) / eye.fy
    slope = np.maximum(x, y)
    # the floor ends at 0.075 / 0.65, the walls' upper edge is seen at 0.075 / 0.5
    expected = np.where(slope <= 0.075 / 0.65, 0.65, 0.075 / slope)
    seen = slope <= 0.075 / 0.5
    np.testing.assert_allclose(depth[seen], expected[seen], atol=1e-12)
    assert np.isnan(depth[~seen]).all()
    # columns by rows between the walls at the floor, and at the rim
    assert (depth == 0.65).sum() == 53 * 53 and seen.sum() == 69 * 68


@pytest.mark.parametrize("seed", range(4))
def test_from_anywhere_it_is_what_rays_at_thin_slabs_meet(eye, box, naive_depth, seed):
    rng = np.random.default_rng(seed)
    R, t = Viewpoints((0.5, 0.8), (0.0, 75.0), turn=True).draw(rng)
    expected = naive_depth(eye, slab_triangles(box, R, t, 1e-8))
    found = bin_depth(eye, box, R, t)
    nothing = ~np.isfinite(expected)
    # a slab's edge is 1e-8 m wide: no pixel's ray meets it and misses the sheet
    np.testing.assert_array_equal(np.isnan(found), nothing)
    assert nothing.any() and (~nothing).sum() > 1500
    np.testing.assert_allclose(found[~nothing], expected[~nothing], atol=1e-6)


def test_thick_slabs_show_the_same_through_the_opening(eye, box, naive_depth):
    R, t = Viewpoints((0.6, 0.6), (20.0, 20.0)).draw(np.random.default_rng(0))
    v, u = np.mgrid[: eye.height, : eye.width]
    rays, origin = eye.rays(u, v) @ R, -t @ R
    at_rim = origin + ((box.height - origin[2]) / rays[..., 2])[..., None] * rays
    through = (np.abs(at_rim[..., :2]) < 0.075).all(-1)
    expected = naive_depth(eye, slab_triangles(box, R, t, 0.01))
    assert through.sum() > 3000
    np.testing.assert_allclose(bin_depth(eye, box, R, t)[through], expected[through], atol=1e-12)


def test_from_inside_no_ray_slips_between_floor_and_walls(eye):
    box, near = Bin(0.3, 0.2, 0.1), replace(eye, near=1e-6)
    low = np.array([0.0, -0.06, 0.01])
    for R in Rotation.random(200, np.random.default_rng(0)).as_matrix():
        rays = eye.rays(*np.mgrid[: eye.width, : eye.height]).swapaxes(0, 1) @ R
        depth = bin_depth(near, box, R, -R @ low)
        # what leaves the bin does so over the walls
        hits = low + np.where(np.isnan(depth), np.inf, depth)[..., None] * rays
        assert (rays[np.isnan(depth)][:, 2] > 0).all()
        assert (np.abs(hits[~np.isnan(depth)]) <= np.array([0.15, 0.1, 0.1]) + 1e-8).all()
    # straight at the seams: the ray of the pixel 0, 0 goes to the corners of the floor and between them
    camera = replace(near, cx=0.0, cy=0.0)
    for x, y in product((-0.15, 0.07, 0.15), (-0.1, 0.03, 0.1)):
        axis = np.array([x, y, 0]) - low
        side = np.cross(axis, [0, 0, 1])
        R = np.stack([side, np.cross(axis, side), axis])
        R /= np.linalg.norm(R, axis=1, keepdims=True)
        assert bin_depth(camera, box, R, -R @ low)[0, 0] == pytest.approx(np.linalg.norm(axis))


def test_what_the_sensor_cannot_measure_is_not_there(eye, box):
    assert np.isnan(bin_depth(replace(eye, far=0.64), box, *ABOVE)[36, 46])
    near = bin_depth(replace(eye, near=0.6), box, *ABOVE)
    assert near[36, 46] == 0.65 and np.nanmin(near) >= 0.6


def test_it_stands_where_a_still_camera_sees_it(eye, box):
    still = Viewpoints((0.7, 0.7), (30.0, 30.0))
    found = Background.seen_from(still, box)
    R, t = still.draw(np.random.default_rng(5))
    np.testing.assert_array_equal(found.depth(eye), bin_depth(eye, box, R, t))
    assert found.depth(eye) is found.depth(eye) and not found.depth(eye).flags.writeable


@pytest.mark.parametrize(
    "moving", [Viewpoints((0.6, 0.7)), Viewpoints(tilt=(0.0, 10.0)), Viewpoints(turn=True)]
)
def test_a_camera_that_moves_has_no_background(moving, box):
    with pytest.raises(ValueError, match=r"moves from scene to scene .* without a background"):
        Background.seen_from(moving, box)


@pytest.mark.parametrize(
    ("R", "t", "what"),
    [
        (np.eye(3)[:2], np.zeros(3), r"R \(3, 3\)"),
        (np.eye(3), np.array([0, 0, np.nan]), "finite"),
        (np.diag([1.0, 1, -1]), np.zeros(3), "no rotation"),
    ],
)
def test_a_pose_that_is_none_is_refused(box, R, t, what):
    with pytest.raises(ValueError, match=what):
        Background(box, R, t)
