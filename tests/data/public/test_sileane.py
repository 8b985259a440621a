import json
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from tests.data.public.conftest import assert_is_scene, read_damaged, round_trip_errors, take_picture
from tests.data.public.sileane_writer import (
    segmentation_ids,
    write_camera,
    write_image,
    write_scene,
    write_truth,
)

from pnet.data.public.object_frame import ObjectFrame
from pnet.data.public.sileane import SileaneData
from pnet.geometry.camera import Camera
from pnet.records import SceneId

CAMERA = Camera(160, 120, 260.0, 265.0, 82.3, 57.1, near=0.5, far=1.6)
SMALL = Camera(64, 48, 104.0, 106.0, 32.9, 22.8, near=0.5, far=1.6)
STEP = 1000 * (CAMERA.far - CAMERA.near) / 65535  # mm between two codes


def write_picture(root, name, picture, **options):
    write_scene(
        root,
        name,
        picture.camera,
        picture.depth,
        picture.instance,
        picture.R,
        picture.t,
        picture.occlusion,
        **options,
    )


@pytest.fixture(scope="module")
def picture(gear):
    return take_picture(gear, CAMERA)


@pytest.fixture(scope="module")
def small(gear):
    return [take_picture(gear, SMALL, bodies) for bodies in (2, 4)]


@pytest.fixture
def write_small(tmp_path, small):
    """Writes two cycles of two scenes."""

    def write(root=tmp_path / "gear", **options):
        write_camera(root, SMALL)
        for cycle in (0, 1):
            for picture in small:
                write_picture(root, f"gear_{cycle}_{len(picture.t):03d}", picture, **options)
        return root

    return write


def read_one(root, part, **settings):
    (scene,) = SileaneData(str(root), **settings).scenes("test_l", part)
    return scene


def only_scene(root, picture, name="gear_3_006", **options):
    write_camera(root, picture.camera)
    write_picture(root, name, picture, **options)
    return root


def change_entry(path, **changes):
    """Replace keys of the first body's entry."""
    rows = json.loads(path.read_text())
    rows[0] |= changes
    path.write_text(json.dumps(rows))


def test_a_written_pile_comes_back(tmp_path, fixed_part):
    picture = take_picture(fixed_part, CAMERA)
    scene = read_one(only_scene(tmp_path, picture), fixed_part, points=3000)
    assert_is_scene(scene, 3000)
    errors = round_trip_errors(scene, picture)
    print(f"Siléane, {fixed_part.name}: {errors}")
    assert errors["R"] < 1e-9 and errors["t"] < 1e-6
    assert errors["z"] < 0.5 * STEP + 1e-4  # half a code, and float32
    assert errors["point"] < 0.6 * STEP + 1e-4
    np.testing.assert_allclose(scene.occlusion, picture.occlusion, atol=1e-12)
    np.testing.assert_allclose(scene.visibility, picture.visible / picture.visible.max(), atol=1e-12)
    np.testing.assert_array_equal(scene.parameters, np.tile(fixed_part.part_object("L", 0), (6, 1)))
    assert scene.camera == CAMERA and scene.part == fixed_part.name
    assert scene.id == SceneId("test_l", "pile", 3, 0, 6)


def test_every_pixel_on_a_body_comes_once_before_any_comes_again(tmp_path, gear, picture):
    seen = int(picture.visible.sum())
    scene = read_one(only_scene(tmp_path, picture), gear, points=seen + 50)
    pixels = np.rint(CAMERA.project(scene.points)).astype(int)
    assert len(np.unique(pixels[:seen], axis=0)) == seen
    np.testing.assert_array_equal(scene.points[seen:], scene.points[:50])


def test_pixels_without_depth_are_left_out_and_still_count_as_visible(tmp_path, gear, picture):
    depth = picture.depth.copy()
    depth[::2] = np.nan
    scene = read_one(only_scene(tmp_path, replace(picture, depth=depth)), gear, points=4000)
    rows = np.unique(np.rint(CAMERA.project(scene.points))[:, 1])
    assert (rows % 2 == 1).all()
    np.testing.assert_allclose(scene.visibility, picture.visible / picture.visible.max())


def test_a_scene_whose_bodies_were_not_measured_has_no_points(tmp_path, gear, picture):
    scene = read_one(only_scene(tmp_path, replace(picture, depth=np.full((120, 160), np.nan))), gear)
    assert_is_scene(scene, 16384)
    assert len(scene.points) == 0 and len(scene.R) == 6


def test_a_scene_without_bodies_has_no_points(tmp_path, gear):
    picture = take_picture(gear, CAMERA, bodies=0)
    scene = read_one(only_scene(tmp_path, picture), gear)
    assert_is_scene(scene, 16384)
    assert len(scene.points) == 0 and len(scene.R) == 0 and scene.parameters.shape == (0, 3)


def test_the_object_frame_carries_poses_to_the_part(tmp_path, gear, picture):
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # object → part
    shift = np.array([3.0, -8, 5])  # mm
    object_R = picture.R @ turn
    object_t = picture.t + picture.R @ shift / 1000
    root = only_scene(tmp_path, replace(picture, R=object_R, t=object_t))
    scene = read_one(root, gear, frame=ObjectFrame(turn.tolist(), shift.tolist()))
    np.testing.assert_allclose(scene.R, picture.R, atol=1e-9)
    np.testing.assert_allclose(scene.t, picture.t, atol=1e-9)


def test_the_ideal_depth_is_read_where_it_is_asked_for(tmp_path, gear, picture):
    root = only_scene(tmp_path, picture)
    write_picture(root, "gear_3_006", replace(picture, depth=picture.depth + 0.01), folder="depth_gt")
    noisy, ideal = read_one(root, gear), read_one(root, gear, depth="depth_gt")
    v, u = np.rint(CAMERA.project(ideal.points)).astype(int).T[::-1]
    np.testing.assert_allclose(ideal.points[:, 2], picture.depth[v, u] + 0.01, atol=1e-5)
    assert noisy.points[0, 2] == pytest.approx(picture.cloud[..., 2][picture.instance >= 0][0], abs=1e-5)


def test_scenes_come_by_cycle_and_number_and_the_empty_bin_is_none(tmp_path, write_small, gear):
    root = write_small()
    write_image(root / "depth" / "gear_0_000.PNG", np.zeros((48, 64)))
    write_truth(root, "gear_0_000", [])
    data = SileaneData(str(root), points=64)
    ids = data.scenes("test_l", gear).ids
    assert [(one.cycle, one.drop) for one in ids] == [(0, 2), (0, 4), (1, 2), (1, 4)]
    assert [one.drop for one in data.scenes("test_l", gear, every=2).ids] == [4, 4]
    assert data.scenes("test_l", gear, keep=lambda objects: objects - {0}).ids == []


def test_numbers_are_ordered_as_numbers(tmp_path, gear, small):
    root = tmp_path / "tless"
    write_camera(root, SMALL)
    for name in ("t_less_20_10_002", "t_less_20_9_010", "t_less_20_9_002"):
        write_picture(root, name, small[0])
    ids = SileaneData(str(root)).scenes("test_l", gear).ids
    assert [(one.cycle, one.drop) for one in ids] == [(9, 2), (9, 10), (10, 2)]


def test_endings_may_be_small_and_hidden_files_are_passed_over(write_small, gear):
    root = write_small(ending=".png")
    (root / "depth" / "._gear_0_002.png").write_bytes(b"finder")
    (root / "depth" / "notes.txt").write_text("kept by hand")
    assert [len(scene.points) for scene in SileaneData(str(root), points=64).scenes("test_l", gear)] == [
        64
    ] * 4


def test_splits_take_their_cycles(write_small, gear):
    data = SileaneData(str(write_small()), points=64, splits={"train": [1], "val": [0]})
    assert {one.cycle for one in data.scenes("train", gear).ids} == {1}
    assert {one.cycle for one in data.scenes("val", gear).ids} == {0}


@pytest.mark.parametrize("splits", [{"val": None}, {"val": None, "train": []}])
def test_a_split_without_cycles_says_how_to_give_it_some(write_small, gear, splits):
    with pytest.raises(
        ValueError, match=r"split train has no cycles; set them, .* data\.source\.splits\.train"
    ):
        SileaneData(str(write_small()), splits=splits).scenes("train", gear)


def test_a_cycle_that_is_not_there_is_named(write_small, gear):
    with pytest.raises(ValueError, match=r"has no cycle 7 \(data\.source\.splits\.val\), only 0, 1"):
        SileaneData(str(write_small()), splits={"val": [0, 7]}).scenes("val", gear)


def test_the_general_test_split_does_not_exist(write_small, gear):
    with pytest.raises(ValueError, match="no split test_g, only train, val, test_l"):
        SileaneData(str(write_small())).scenes("test_g", gear)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"points": 0}, r"data\.source\.points is 0"),
        ({"points": 10**9}, r"data\.source\.points is 1000000000"),
        ({"depth": "rgb"}, r"data\.source\.depth is 'rgb', choose depth or depth_gt"),
        ({"splits": {"tests": None}}, r"data\.source\.splits has tests"),
        ({"splits": None}, r"data\.source\.splits is None"),
        ({"splits": {"val": 3}}, r"data\.source\.splits has val: 3"),
        ({"splits": {"val": [-1]}}, r"data\.source\.splits has val: \[-1\]"),
    ],
)
def test_settings_that_make_no_sense_name_their_key(settings, message):
    with pytest.raises(ValueError, match=message):
        SileaneData("/nowhere", **settings)


def test_a_part_of_several_sizes_is_refused(write_small, tn34):
    with pytest.raises(ValueError, match="one size each, but part tn34 has 16 part objects"):
        SileaneData(str(write_small())).scenes("test_l", tn34)


def test_the_manifest_tells_settings_and_scenes_apart(write_small, tmp_path):
    root = write_small()
    made = SileaneData(str(root), points=64).manifest()
    assert made["camera"] == SMALL.to_dict()
    assert made["source"] == "sileane" and made["scenes"] == {"test_l": 4}
    assert json.loads(json.dumps(made)) == made
    shutil.copytree(root, tmp_path / "elsewhere")
    assert SileaneData(str(tmp_path / "elsewhere"), points=64).manifest() == made
    assert SileaneData(str(root), points=65).manifest() != made
    assert SileaneData(str(root), points=64, splits={"val": [0], "train": []}).manifest() != made
    for folder, ending in (("depth", "PNG"), ("segmentation", "PNG"), ("gt", "json")):
        (root / folder / f"gear_1_004.{ending}").unlink()
    assert SileaneData(str(root), points=64).manifest() != made


def test_the_scenes_travel_to_other_processes(write_small, gear):
    scenes = SileaneData(str(write_small()), points=64).scenes("test_l", gear)
    copy = pickle.loads(pickle.dumps(scenes))
    np.testing.assert_array_equal(copy[3].points, scenes[3].points)


# the segmentation


def test_ids_follow_the_formula():
    assert segmentation_ids(4) == [65535, 49151, 32768, 16384]  # 49151.25, 32767.5, 16383.75


def test_a_body_may_be_hidden_and_its_id_in_no_pixel(tmp_path, gear, picture):
    assert picture.visible[4] == 0
    scene = read_one(only_scene(tmp_path, picture), gear)
    assert scene.visibility[4] == 0 and 4 not in scene.instance and len(scene.R) == 6


def test_rows_of_the_truth_may_stand_in_any_order(tmp_path, gear, picture):
    root = only_scene(tmp_path, picture)
    path = root / "gt" / "gear_3_006.json"
    path.write_text(json.dumps(json.loads(path.read_text())[::-1]))
    errors = round_trip_errors(
        read_one(root, gear),
        replace(
            picture,
            R=picture.R[::-1],
            t=picture.t[::-1],
            instance=np.where(picture.instance < 0, -1, 5 - picture.instance),
        ),
    )
    assert errors["R"] < 1e-9 and errors["t"] < 1e-6


def test_the_background_may_have_the_value_of_the_empty_bin(tmp_path, gear, picture):
    root = only_scene(tmp_path, picture, background=777)
    with pytest.raises(
        ValueError, match=r"gear_3_006\.PNG: \d+ pixels have the id 777, which .*gear_3_006\.json"
    ):
        read_one(root, gear)
    write_image(root / "segmentation" / "gear_3_000.PNG", np.full((120, 160), 777))
    scene = read_one(root, gear, points=2000)
    assert round_trip_errors(scene, picture)["R"] < 1e-9


def test_the_empty_bin_of_another_cycle_does_not_count(tmp_path, gear, picture):
    root = only_scene(tmp_path, picture, background=777)
    write_image(root / "segmentation" / "gear_2_000.PNG", np.full((120, 160), 777))
    with pytest.raises(ValueError, match="pixels have the id 777"):
        read_one(root, gear)


def test_an_empty_bin_with_a_bodys_value_does_not_take_the_body_away(tmp_path, gear, picture):
    root = only_scene(tmp_path, picture)
    write_image(root / "segmentation" / "gear_3_000.PNG", np.full((120, 160), 65535))
    scene = read_one(root, gear, points=2000)
    assert 0 in scene.instance and round_trip_errors(scene, picture)["R"] < 1e-9


def test_a_background_that_has_a_bodys_value_is_refused(tmp_path, gear, picture):
    root = only_scene(tmp_path, picture, background=65535)
    write_image(root / "segmentation" / "gear_3_000.PNG", np.full((120, 160), 65535))
    with pytest.raises(ValueError, match=r"the empty bin's segmentation has the value 65535 too"):
        read_one(root, gear)


def test_an_id_that_comes_twice_is_refused(tmp_path, gear, picture):
    root = only_scene(tmp_path, picture)
    change_entry(root / "gt" / "gear_3_006.json", segmentation_id=54613)
    with pytest.raises(ValueError, match=r"gear_3_006\.json: the segmentation id 54613 comes twice"):
        read_one(root, gear)


# files that are missing or wrong


@pytest.mark.parametrize(
    "name", ["depth/gear_0_002.PNG", "segmentation/gear_0_002.PNG", "gt/gear_0_002.json"]
)
def test_a_missing_counterpart_is_named(write_small, gear, name):
    root = write_small()
    (root / name).unlink()
    with pytest.raises(FileNotFoundError, match=rf"{name}: no such file, though there is .*gear_0_002"):
        SileaneData(str(root)).scenes("test_l", gear)


def test_braces_in_a_folders_name_do_no_harm(tmp_path, write_small, gear):
    root = write_small(tmp_path / "a{b}{}")
    (root / "gt" / "gear_0_002.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"gt/gear_0_002\.json: no such file"):
        SileaneData(str(root)).scenes("test_l", gear)


@pytest.mark.parametrize("folder", ["depth", "segmentation", "gt"])
def test_a_missing_folder_is_named(write_small, gear, folder):
    root = write_small()
    shutil.rmtree(root / folder)
    with pytest.raises(FileNotFoundError, match=rf"{folder}: no such folder"):
        SileaneData(str(root)).scenes("test_l", gear)


def test_a_folder_without_scenes_says_what_was_expected(tmp_path, gear):
    for folder in ("depth", "segmentation", "gt"):
        (tmp_path / folder).mkdir()
    with pytest.raises(FileNotFoundError, match=r"no images there named like bunny_3_070\.PNG"):
        SileaneData(str(tmp_path)).scenes("test_l", gear)


def test_one_scene_in_two_spellings_is_refused(write_small, gear):
    root = write_small()
    shutil.copy(root / "depth" / "gear_0_002.PNG", root / "depth" / "gear_0_002.png")
    with pytest.raises(ValueError, match=r"gear_0_002\.png: stands for the same scene as gear_0_002\.PNG"):
        SileaneData(str(root)).scenes("test_l", gear)


def test_two_objects_in_a_folder_are_refused(write_small, gear, small):
    root = write_small()
    write_picture(root, "bunny_0_002", small[0])
    with pytest.raises(ValueError, match=r"gear_0_002: has the same numbers as .*bunny_0_002"):
        SileaneData(str(root)).scenes("test_l", gear)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fu": "0"}, "focal lengths 0 and 106 must be positive"),
        ({"fv": "-106"}, "focal lengths 104 and -106 must be positive"),
        ({"fv": "nan"}, "line 5: key 'fv' has 'nan', expected 1 finite numbers"),
        ({"cu": "1 2"}, "key 'cu' has '1 2', expected 1 finite numbers"),
        ({"cv": "left"}, "key 'cv' has 'left'"),
        ({"clip_start": "1.7"}, r"clip_end \(1.6 m\) must exceed clip_start \(1.7 m\)"),
        ({"clip_start": "0"}, "which must be positive"),
        ({"clip_end": "1600"}, "be at most 1000 m"),
        ({"width": "64.5"}, "an image of 64.5 x 48 pixels, expected whole numbers"),
        ({"height": "0"}, "an image of 64 x 0 pixels"),
        ({"width": "1e9", "cu": "5e8", "fu": "1e9"}, "expected whole numbers"),
        ({"cu": "5000"}, "seen at 88.81 degrees off the axis"),
        ({"rotation": "1 0 0 0.1"}, "quaternion of norm 1.005, expected 1"),
        ({"rotation": "1 0 0"}, "key 'rotation' has '1 0 0', expected 4"),
        ({"location": "0 0"}, "key 'location' has '0 0', expected 3"),
        ({"location": ""}, "key 'location' is missing"),
        ({"fu": "100\nfu 100"}, "line 5: key 'fu' comes twice"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(write_small, gear, changes, message):
    root = write_small()
    write_camera(root, SMALL, **changes)
    with pytest.raises(ValueError, match=rf"camera_params\.txt: .*{message}"):
        SileaneData(str(root)).scenes("test_l", gear)


def test_a_missing_camera_is_named(write_small, gear):
    root = write_small()
    (root / "camera_params.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"camera_params\.txt: no such file"):
        SileaneData(str(root)).scenes("test_l", gear)


def test_comments_and_other_keys_of_the_camera_are_passed_over(write_small, gear):
    root = write_small()
    write_camera(root, SMALL, fu="104 # pixels", scanner="a b c")
    assert SileaneData(str(root), points=64).scenes("test_l", gear)[0].camera == SMALL


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"R": [[1, 0, 0], [0, 1, 0], [0, 0, 1.1]]}, "entry 0: key 'R' is not a rotation"),
        ({"R": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, "key 'R' is not a rotation"),
        ({"R": [[1, 0, 0], [0, 1, 0]]}, "key 'R' has shape"),
        ({"t": [0, float("nan"), 1]}, "entry 0: key 't' holds NaN or infinity"),
        ({"t": "here"}, "key 't' does not hold numbers"),
        ({"occlusion_rate": 1.01}, "key 'occlusion_rate' is 1.01, expected 0 to 1"),
        ({"occlusion_rate": -0.01}, "key 'occlusion_rate' is -0.01"),
        ({"segmentation_id": 0.5}, "key 'segmentation_id' is 0.5, expected a whole number"),
        ({"segmentation_id": 65536}, "key 'segmentation_id' is 65536, expected a whole number, 0 to 65535"),
        ({"segmentation_id": None}, "key 'segmentation_id' does not hold numbers"),
    ],
)
def test_an_entry_that_cannot_be_is_refused(tmp_path, gear, picture, changes, message):
    root = only_scene(tmp_path, picture)
    change_entry(root / "gt" / "gear_3_006.json", **changes)
    with pytest.raises(ValueError, match=rf"gear_3_006\.json: .*{message}"):
        read_one(root, gear)


@pytest.mark.parametrize(
    ("rows", "message"),
    [({"R": 1}, "holds a dict, expected a list"), ([3], "entry 0: is a int"), ([{}], "is missing")],
)
def test_a_truth_of_another_form_is_refused(tmp_path, gear, picture, rows, message):
    root = only_scene(tmp_path, picture)
    write_truth(root, "gear_3_006", rows)
    with pytest.raises(ValueError, match=rf"gear_3_006\.json: .*{message}"):
        read_one(root, gear)


def test_more_entries_than_bodies_are_refused(tmp_path, gear, picture):
    root = only_scene(tmp_path, picture, name="gear_3_005")
    with pytest.raises(
        ValueError, match=r"gear_3_005\.json: has 6 entries, but the file's name says 5 bodies"
    ):
        read_one(root, gear)


def test_occlusion_may_miss_the_range_by_rounding(tmp_path, gear, picture):
    root = only_scene(tmp_path, picture)
    change_entry(root / "gt" / "gear_3_006.json", occlusion_rate=-1e-6)
    assert read_one(root, gear).occlusion[0] == 0


@pytest.mark.parametrize("folder", ["depth", "segmentation"])
@pytest.mark.parametrize(
    ("kind", "shape", "message"),
    [
        (np.uint8, (120, 160), "has pixels of type uint8, expected uint16"),
        (np.uint16, (120, 161), "has 161 x 120 pixels, the camera 160 x 120"),
        (np.uint8, (120, 160, 3), "has pixels of mode RGB"),
    ],
)
def test_an_image_of_another_kind_is_refused(tmp_path, gear, picture, folder, kind, shape, message):
    root = only_scene(tmp_path, picture)
    path = root / folder / "gear_3_006.PNG"
    Image.fromarray(np.zeros(shape, kind)).save(path)
    with pytest.raises(ValueError, match=rf"{folder}/gear_3_006\.PNG: {message}"):
        read_one(root, gear)


@pytest.mark.parametrize("factor", [1000, 0.001])
def test_poses_in_another_unit_are_refused(tmp_path, gear, picture, factor):
    root = only_scene(tmp_path, replace(picture, t=factor * picture.t))
    with pytest.raises(ValueError, match=r"gear_3_006\.json: the poses do not fit the depth image"):
        read_one(root, gear)


def test_a_few_wrong_poses_are_the_authors_affair(tmp_path, gear, picture):
    t = picture.t.copy()
    t[0] += 1
    assert len(read_one(only_scene(tmp_path, replace(picture, t=t)), gear).R) == 6


def test_damaged_files_give_errors_or_scenes(tmp_path, write_small, gear):
    whole = write_small()
    write_image(whole / "segmentation" / "gear_0_000.PNG", np.zeros((48, 64)))
    outcomes = read_damaged(whole, tmp_path, lambda root: SileaneData(root, points=64), ["test_l"], gear)
    print(f"Siléane: {outcomes}")
    assert outcomes["read"] > 2 * outcomes["refused"] > 0 and outcomes["not opened"] > 0


def test_sizes_beside_the_images_choose_the_part_object(tmp_path, picture, tn34):
    root = only_scene(tmp_path, picture)
    (root / "parameters.json").write_text('{"r": 0.012, "h": 0.010}')
    scenes = SileaneData(str(root)).scenes("test_l", tn34)
    assert scenes._read.part.parameters.tolist() == [0.012, 0.010]


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("{", "not valid JSON"),
        ('{"r": 0.012}', "expected the sizes r, h of part tn34"),
        ('{"r": 0.012, "h": "x"}', "key 'h' does not hold numbers"),
        ('{"r": 0.012, "h": -1}', "must be positive"),
    ],
)
def test_wrong_sizes_are_refused(tmp_path, picture, tn34, text, error):
    root = only_scene(tmp_path, picture)
    (root / "parameters.json").write_text(text)
    with pytest.raises(ValueError, match=error) as fault:
        SileaneData(str(root)).scenes("test_l", tn34)
    assert "parameters.json" in str(fault.value)


def test_a_multi_size_part_without_sizes_is_refused(tmp_path, picture, tn34):
    with pytest.raises(ValueError, match=r"has \d+ part objects"):
        SileaneData(str(only_scene(tmp_path, picture))).scenes("test_l", tn34)
