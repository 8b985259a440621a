from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.data.public.conftest import assert_is_scene, take_picture

from pnet.data.public.labelled_image import (
    LabelledImage,
    check_depth_range,
    check_rotations,
    incidence_at,
    incidence_of_depth,
    instance_indices,
    nearest_rotations,
    read_lines,
    scene_of_image,
)
from pnet.geometry.camera import Camera
from pnet.records import SceneId

CAMERA = Camera(40, 30, 60.0, 65.0, 18.3, 15.2, near=0.5, far=2.0)
ID = SceneId("val", "pile", 0, 0, 2)


def labelled(depth, instance, bodies=2):
    return LabelledImage(
        depth,
        instance,
        R=np.broadcast_to(np.eye(3), (bodies, 3, 3)),
        t=np.zeros((bodies, 3)),
        parameters=np.ones((bodies, 1)),
        occlusion=np.zeros(bodies),
    )


def random_image(seed=0, share=0.5):
    """Random depth with holes, two bodies and background at random pixels."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.6, 0.9, (30, 40))
    depth[rng.random((30, 40)) < 0.1] = np.nan
    depth[rng.random((30, 40)) < 0.1] = 0
    return labelled(depth, np.where(rng.random((30, 40)) < share, rng.integers(0, 2, (30, 40)), -1))


def points_on_bodies(image):
    """The points and bodies of all pixels that count, one by one."""
    found = []
    for v, u in np.ndindex(image.depth.shape):
        z, body = image.depth[v, u], image.instance[v, u]
        if body >= 0 and z > 0:
            found.append([(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z, body])
    found = np.array(found)
    return found[:, :3].astype(np.float32), found[:, 3].astype(int)


def test_measured_pixels_on_bodies_become_points_with_their_body():
    image = random_image()
    cloud, body = points_on_bodies(image)
    scene = scene_of_image(image, CAMERA, "gear", ID, len(cloud))
    assert_is_scene(scene, len(cloud))
    places = {tuple(point): owner for point, owner in zip(cloud.tolist(), body, strict=True)}
    assert len(places) == len(cloud)
    assert {tuple(point) for point in scene.points.tolist()} == set(places)
    assert [places[tuple(point)] for point in scene.points.tolist()] == scene.instance.tolist()


def test_each_next_point_is_the_farthest_from_those_before():
    image = random_image(share=0.2)
    cloud = points_on_bodies(image)[0].astype(np.float64)
    scene = scene_of_image(image, CAMERA, "gear", ID, 60)
    for count in range(1, 60):
        taken = scene.points[:count].astype(np.float64)
        gaps = np.linalg.norm(cloud[:, None] - taken[None], axis=-1).min(1)
        gap = np.linalg.norm(scene.points[count] - taken, axis=-1).min()
        assert gap == pytest.approx(gaps.max(), rel=1e-5)


def test_the_sample_of_fewer_points_is_a_prefix():
    image = random_image()
    many, few = (scene_of_image(image, CAMERA, "gear", ID, count) for count in (300, 50))
    for name in ("points", "instance", "incidence", "edge"):
        np.testing.assert_array_equal(getattr(many, name)[:50], getattr(few, name))


def test_pixels_are_repeated_in_order_where_there_are_too_few():
    image = random_image(share=0.05)
    count = len(points_on_bodies(image)[0])
    scene = scene_of_image(image, CAMERA, "gear", ID, 3 * count + 4)
    assert_is_scene(scene, 3 * count + 4)
    for name in ("points", "instance", "incidence", "edge"):
        values = getattr(scene, name)
        np.testing.assert_array_equal(values[count : 2 * count], values[:count])
        np.testing.assert_array_equal(values[3 * count :], values[:4])


@pytest.mark.parametrize("depth", [0.0, np.nan])
def test_without_a_measured_body_there_is_no_point(depth):
    instance = np.full((30, 40), -1)
    instance[3:5, 4:8] = 1
    image = labelled(np.where(instance >= 0, depth, 0.8), instance)
    scene = scene_of_image(image, CAMERA, "gear", ID, 64)
    assert_is_scene(scene, 64)
    assert len(scene.points) == 0 and len(scene.R) == 2
    np.testing.assert_array_equal(scene.visibility, [0, 1])  # its pixels are seen, if not measured


def test_without_bodies_there_is_no_point():
    scene = scene_of_image(labelled(np.ones((30, 40)), np.full((30, 40), -1), 0), CAMERA, "gear", ID, 64)
    assert_is_scene(scene, 64)
    assert len(scene.points) == 0 and scene.visibility.shape == (0,)


def test_visibility_is_the_share_of_the_most_visible_bodys_pixels():
    instance = np.full((30, 40), -1)
    instance[:2, :10], instance[5, :5] = 1, 0
    scene = scene_of_image(labelled(np.full((30, 40), 0.7), instance), CAMERA, "gear", ID, 64)
    np.testing.assert_allclose(scene.visibility, [0.25, 1])


def test_rotations_with_few_digits_become_rotations(gear):
    picture = take_picture(gear, Camera(64, 48, 104.0, 106.0, 32.9, 22.8, near=0.5, far=1.6))
    R = picture.R.round(4)
    image = LabelledImage(picture.depth, picture.instance, R, picture.t, np.ones((6, 1)), picture.occlusion)
    scene = scene_of_image(image, picture.camera, "gear", ID, 64)
    assert_is_scene(scene, 64)
    assert 1e-6 < np.abs(scene.R - picture.R).max() < 1e-4


# incidence


def test_a_planes_incidence_is_its_angle_to_the_ray():
    normal = np.array([0.3, -0.4, 1.0]) / np.linalg.norm([0.3, -0.4, 1.0])
    v, u = np.mgrid[:30, :40]
    ray = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones((30, 40))], -1)
    depth = 0.8 / (ray @ normal)
    expected = np.abs(ray @ normal) / np.linalg.norm(ray, axis=-1)
    np.testing.assert_allclose(incidence_of_depth(depth, CAMERA), expected, atol=1e-9)


def test_the_incidence_at_a_bodys_border_is_the_bodys_own():
    depth = np.full((30, 40), 1.5)
    depth[8:20, 10:25] = 0.7  # both face the camera
    found = incidence_of_depth(depth, CAMERA)
    v, u = np.mgrid[:30, :40]
    ray = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones((30, 40))], -1)
    np.testing.assert_allclose(found, 1 / np.linalg.norm(ray, axis=-1), atol=1e-9)


def test_the_incidence_of_a_rendered_body_is_the_renderers(gear):
    from pnet.scenes.rendering import render_view

    camera = Camera(320, 240, 520.0, 530.0, 160.0, 118.0, near=0.5, far=1.6)
    R = Rotation.from_rotvec([[0.6, 0.3, 0.1]]).as_matrix()
    view = render_view(camera, gear.mesh(gear.part_object("L", 0)), R, np.array([[0.02, 0.01, 0.8]]))
    found = incidence_of_depth(view.depth, camera)
    body = view.instance >= 0
    gap = np.abs(found - view.incidence)[body]
    assert np.median(gap) < 1e-3 and np.quantile(gap, 0.9) < 0.03  # the rest touches edges of the body
    assert (found[~body] == 0).all()


def test_a_lone_pixel_faces_the_camera_and_a_missing_one_does_not():
    depth = np.zeros((30, 40))
    depth[4, 5], depth[7, 8] = 0.7, np.nan
    found = incidence_of_depth(depth, CAMERA)
    assert found[4, 5] == 1 and found.sum() == 1


def test_the_incidence_of_some_pixels_is_that_of_the_image():
    image = random_image()
    pixels = np.random.default_rng(3).permutation(1200)[:200]
    whole = incidence_of_depth(image.depth, CAMERA)
    np.testing.assert_array_equal(incidence_at(image.depth, CAMERA, pixels), whole.reshape(-1)[pixels])


# the segmentation


def indices(codes, ids, background=(0,), kind=np.uint8):
    return instance_indices(
        np.array(codes, kind), np.array(ids, np.int64), background, Path("a.png"), Path("b.csv")
    )


def test_ids_become_indices_and_background_minus_one():
    found = indices([[0, 7, 3], [9, 3, 255]], [3, 5, 7], {0, 9, 255})
    np.testing.assert_array_equal(found, [[-1, 2, 0], [-1, 0, -1]])


def test_a_background_value_that_is_a_bodys_stands_for_the_body():
    np.testing.assert_array_equal(indices([[0, 9]], [9, 0], {0, 9}), [[1, 0]])


def test_all_values_of_16_bits_can_be_ids():
    np.testing.assert_array_equal(indices([[65535, 1]], [1, 65535], (), np.uint16), [[1, 0]])


def test_without_bodies_all_is_background():
    np.testing.assert_array_equal(indices([[0, 0]], []), [[-1, -1]])


def test_values_without_a_body_are_counted_and_named():
    with pytest.raises(ValueError, match=r"a\.png: 2 pixels have the id 7, which b\.csv does not name"):
        indices([[0, 7, 3], [7, 3, 0]], [3])


def test_an_id_of_two_bodies_is_named():
    with pytest.raises(ValueError, match=r"b\.csv: the segmentation id 3 comes twice"):
        indices([[0]], [3, 5, 3])


# checks


def test_the_nearest_rotation_of_a_scaled_one_is_the_rotation():
    R = Rotation.random(4, np.random.default_rng(0)).as_matrix()
    np.testing.assert_allclose(nearest_rotations(1.0004 * R), R, atol=1e-12)
    assert nearest_rotations(np.zeros((0, 3, 3))).shape == (0, 3, 3)


@pytest.mark.parametrize(
    "matrix", [np.diag([1, 1, -1]), 1.001 * np.eye(3), np.zeros((3, 3)), np.full((3, 3), np.nan)]
)
def test_what_is_no_rotation_is_named(matrix):
    check_rotations(np.stack([np.eye(3), 1.0004 * np.eye(3)]), "a.csv")
    with pytest.raises(ValueError, match=r"a\.csv: the rotation of entry 1 is none"):
        check_rotations(np.stack([np.eye(3), matrix]), "a.csv")


@pytest.mark.parametrize(
    "planes",
    [(0.5, 0.5), (0.6, 0.5), (0, 1), (-1, 1), (0.5, np.inf), (np.nan, 1), (0.5, np.nan), (500, 1500)],
)
def test_clip_planes_that_cannot_be_are_refused(planes):
    check_depth_range(0.5, 1.5, "a.json")
    with pytest.raises(ValueError, match=r"a\.json: clip_end \(.* m\) must exceed clip_start"):
        check_depth_range(*planes, "a.json")


def test_a_text_file_is_read_by_lines_and_faults_name_it(tmp_path):
    path = tmp_path / "a.txt"
    with pytest.raises(FileNotFoundError, match=r"a\.txt: no such file"):
        read_lines(path)
    path.write_text("one\ntwo\n")
    assert read_lines(path) == ["one", "two"]
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match=r"a\.txt: not a text file"):
        read_lines(path)
