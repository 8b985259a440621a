import json
import pickle
import shutil
from dataclasses import replace
from math import atan

import numpy as np
import pytest
from PIL import Image
from tests.data.public.conftest import assert_is_scene, read_damaged, round_trip_errors, take_picture
from tests.data.public.ipa_writer import (
    BIN,
    SQUARE,
    truth_row,
    window_camera,
    write_depth,
    write_parameters,
    write_scene,
    write_truth,
)

from pnet.data.public.ipa import IpaData
from pnet.data.public.object_frame import ObjectFrame
from pnet.records import SceneId

CAMERA = window_camera(160, 120, 30, 65, 260.0)
SMALL = window_camera(64, 48, 80, 100, 104.0)
STEP = 1000 * (CAMERA.far - CAMERA.near) / 65535  # mm between two codes


def write_picture(part_folder, cycle, drop, picture, **options):
    write_scene(
        part_folder,
        cycle,
        drop,
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
    """Writes cycles, by part, of two scenes and an empty bin each."""

    def write(root=tmp_path / "data", cycles=((1, 0), (1, 1)), **options):
        for number, cycle in cycles:
            part_folder = root / f"IPAGear_part_{number}"
            write_parameters(part_folder, SMALL)
            write_depth(part_folder, cycle, 0, SMALL, small[0].floor)
            for picture in small:
                write_picture(part_folder, cycle, len(picture.t), picture, **options)
        return root

    return write


def only_scene(root, picture, **options):
    """The folder of a part with one scene: cycle 7, drop 6."""
    part_folder = root / "IPAGear_part_2"
    write_parameters(part_folder, picture.camera)
    write_depth(part_folder, 7, 0, picture.camera, picture.floor)
    write_picture(part_folder, 7, 6, picture, **options)
    return part_folder


def read_one(root, part, **settings):
    (scene,) = IpaData(str(root), 1, 0, **settings).scenes("val", part)
    return scene


def truth_of(part_folder):
    return part_folder / "gt" / "cycle_0007" / "006.csv"


def depth_of(part_folder, drop=6):
    return part_folder / "p_depth" / "cycle_0007" / f"{drop:03d}_depth_uint16.png"


def segmentation_of(part_folder):
    return part_folder / "p_segmentation" / "cycle_0007" / "006_segmentation.png"


def test_a_written_pile_comes_back(tmp_path, fixed_part):
    picture = take_picture(fixed_part, CAMERA)
    scene = read_one(only_scene(tmp_path, picture), fixed_part, points=3000)
    assert_is_scene(scene, 3000)
    errors = round_trip_errors(scene, picture)
    print(f"IPA, {fixed_part.name}: {errors}")
    assert errors["R"] < 1e-9 and errors["t"] < 1e-6
    assert errors["z"] < 0.5 * STEP + 1e-4  # half a code, and float32
    assert errors["point"] < 0.6 * STEP + 1e-4
    np.testing.assert_allclose(scene.occlusion, picture.occlusion, atol=1e-12)
    np.testing.assert_allclose(scene.visibility, picture.visible / picture.visible.max(), atol=1e-12)
    np.testing.assert_array_equal(scene.parameters, np.tile(fixed_part.part_object("L", 0), (6, 1)))
    for name in ("width", "height", "fx", "fy", "cx", "cy", "near", "far"):
        assert getattr(scene.camera, name) == pytest.approx(getattr(CAMERA, name), rel=1e-12)
    assert scene.part == fixed_part.name and scene.id == SceneId("val", "pile", 20007, 0, 6)


def test_the_object_frame_carries_poses_to_the_part(tmp_path, gear, picture):
    turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # object → part
    shift = np.array([3.0, -8, 5])  # mm
    object_t = picture.t + picture.R @ shift / 1000
    part_folder = only_scene(tmp_path, replace(picture, R=picture.R @ turn, t=object_t))
    scene = read_one(part_folder, gear, frame=ObjectFrame(turn.tolist(), shift.tolist()))
    np.testing.assert_allclose(scene.R, picture.R, atol=1e-9)
    np.testing.assert_allclose(scene.t, picture.t, atol=1e-9)


def test_pixels_without_depth_are_left_out_and_still_count_as_visible(tmp_path, gear, picture):
    depth = picture.depth.copy()
    depth[::2] = np.nan  # the code 65535
    depth[1::4] = CAMERA.near  # the code 0
    scene = read_one(only_scene(tmp_path, replace(picture, depth=depth)), gear, points=4000)
    rows = np.unique(np.rint(CAMERA.project(scene.points))[:, 1])
    assert (rows % 4 == 3).all()
    np.testing.assert_allclose(scene.visibility, picture.visible / picture.visible.max())


def test_pixels_as_deep_as_the_empty_bin_are_on_no_body(tmp_path, gear, picture):
    first = picture.instance == 0
    depth = np.where(first, picture.floor - 0.0009, picture.depth)
    root = only_scene(tmp_path, replace(picture, depth=depth))
    for background, there in ((0.001, False), (0.0008, True), (None, True)):
        scene = read_one(root, gear, background=background, points=4000)
        assert (0 in scene.instance) == there == (scene.visibility[0] > 0)
        assert set(scene.instance) | {0} == {0, 1, 2, 3, 5}


def test_an_unmeasured_empty_bin_hides_nothing(tmp_path, gear, picture):
    part_folder = only_scene(tmp_path, picture)
    write_depth(part_folder, 7, 0, CAMERA, np.full((120, 160), np.nan))
    scene = read_one(part_folder, gear, points=2000)
    np.testing.assert_allclose(scene.visibility, picture.visible / picture.visible.max())


def test_a_missing_empty_bin_is_named_unless_it_is_not_wanted(tmp_path, gear, picture):
    part_folder = only_scene(tmp_path, picture)
    depth_of(part_folder, 0).unlink()
    with pytest.raises(FileNotFoundError, match=r"000_depth_uint16\.png: no such file; .*background is null"):
        read_one(part_folder, gear)
    assert len(read_one(part_folder, gear, background=None, points=64).points) == 64


def test_a_scene_without_bodies_has_no_points(tmp_path, gear):
    scene = read_one(only_scene(tmp_path, take_picture(gear, CAMERA, bodies=0)), gear)
    assert_is_scene(scene, 16384)
    assert len(scene.points) == 0 and len(scene.R) == 0


def test_a_scene_whose_bodies_were_not_measured_has_no_points(tmp_path, gear, picture):
    scene = read_one(only_scene(tmp_path, replace(picture, depth=picture.floor)), gear)
    assert_is_scene(scene, 16384)
    assert len(scene.points) == 0 and len(scene.R) == 6


# the segmentation


def test_the_highest_id_stands_for_nothing_where_no_body_has_it(tmp_path, gear, picture):
    scene = read_one(only_scene(tmp_path, picture, nothing=255), gear, points=2000)
    assert round_trip_errors(scene, picture)["R"] < 1e-9


def test_the_highest_id_is_a_bodys_where_a_row_says_so(tmp_path, gear, picture):
    part_folder = only_scene(tmp_path, picture)
    rename_first(truth_of(part_folder), 255)
    path = segmentation_of(part_folder)
    codes = np.array(Image.open(path))
    Image.fromarray(np.where(codes == 1, np.uint8(255), codes)).save(path)
    scene = read_one(part_folder, gear, points=2000)
    assert 0 in scene.instance and round_trip_errors(scene, picture)["R"] < 1e-9


def test_an_id_that_the_truth_lacks_is_named(tmp_path, gear, picture):
    part_folder = only_scene(tmp_path, picture)
    rename_first(truth_of(part_folder), 99)
    with pytest.raises(ValueError, match=r"006_segmentation\.png: \d+ pixels have the id 1, which .*csv"):
        read_one(part_folder, gear)


def test_an_id_that_comes_twice_is_refused(tmp_path, gear, picture):
    part_folder = only_scene(tmp_path, picture)
    rename_first(truth_of(part_folder), 2)
    with pytest.raises(ValueError, match=r"006\.csv: the segmentation id 2 comes twice"):
        read_one(part_folder, gear)


def rename_first(path, number):
    """Give the first body another id."""
    lines = path.read_text().splitlines()
    lines[2] = f"{number}{lines[2][1:]}"
    path.write_text("\n".join(lines))


def test_the_bins_row_may_say_anything_or_be_missing(tmp_path, gear, picture):
    path = truth_of(only_scene(tmp_path, picture))
    lines = path.read_text().splitlines()
    assert lines[1] == BIN
    for bin_rows in ([",".join(["0", "bin", *["nan"] * 14])], []):
        path.write_text("\n".join([lines[0], *bin_rows, *lines[2:]]))
        assert round_trip_errors(read_one(path.parents[2], gear), picture)["R"] < 1e-9


# the truth's table


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (0, "1.5", "line 3: the id is '1.5', expected a whole number, 0 to 255"),
        (0, "256", "line 3: the id is '256'"),
        (0, "-1", "line 3: the id is '-1'"),
        (0, "one", "line 3: could not convert string to float: 'one'"),
        (0, "0", "the bin's id 0 comes twice"),
        (2, "nan", "line 3: holds NaN or infinity"),
        (4, "1e400", "line 3: holds NaN or infinity"),
        (5, "5", "the rotation of entry 0 is none"),
        (15, "-0.1", "a visibility_score_p is -0.1, expected 0 to 1"),
        (15, "0.5,7", "line 3 has 17 fields, expected 16"),
    ],
)
def test_a_row_that_cannot_be_is_refused(tmp_path, gear, picture, place, value, message):
    path = truth_of(only_scene(tmp_path, picture))
    lines = path.read_text().splitlines()
    fields = lines[2].split(",")
    fields[place] = value
    lines[2] = ",".join(fields)
    path.write_text("\n".join(lines))
    with pytest.raises(ValueError, match=rf"006\.csv: {message}"):
        read_one(path.parents[2], gear)


def test_a_mirror_image_is_no_rotation(tmp_path, gear, picture):
    part_folder = only_scene(tmp_path, replace(picture, R=picture.R @ np.diag([1, 1, -1])))
    with pytest.raises(ValueError, match=r"006\.csv: the rotation of entry 0 is none .*determinant -1"):
        read_one(part_folder, gear)


def test_a_visibility_above_one_is_one(tmp_path, gear, picture):
    scene = read_one(only_scene(tmp_path, replace(picture, occlusion=picture.occlusion - 0.02)), gear)
    assert scene.occlusion[1] == 0 and scene.occlusion[2] == pytest.approx(picture.occlusion[2] - 0.02)


def test_a_table_without_header_is_refused(tmp_path, gear, picture):
    path = truth_of(only_scene(tmp_path, picture))
    path.write_text("\n".join(path.read_text().splitlines()[1:]))
    with pytest.raises(ValueError, match=r"006\.csv: does not begin with a header line"):
        read_one(path.parents[2], gear)


def test_more_rows_than_the_segmentation_has_ids_are_refused(tmp_path, gear, picture):
    path = truth_of(only_scene(tmp_path, picture))
    write_truth(path, [truth_row(i, np.eye(3), np.ones(3), 1) for i in range(257)])
    with pytest.raises(ValueError, match=r"006\.csv: has 257 rows, more than an 8-bit segmentation"):
        read_one(path.parents[2], gear)


def test_an_empty_table_is_refused(tmp_path, gear, picture):
    path = truth_of(only_scene(tmp_path, picture))
    path.write_text("")
    with pytest.raises(ValueError, match=r"006\.csv: does not begin with a header line"):
        read_one(path.parents[2], gear)


def test_poses_in_another_frame_are_refused(tmp_path, gear, picture):
    part_folder = only_scene(tmp_path, replace(picture, t=picture.t - [0, 0, 1.3]))
    with pytest.raises(ValueError, match=r"006\.csv: the poses do not fit the depth image: .* lie 1\.\d+ m"):
        read_one(part_folder, gear)


# the camera


def test_the_angle_of_view_may_be_in_radians(tmp_path, gear, picture):
    part_folder = only_scene(tmp_path, picture)
    write_parameters(part_folder, CAMERA, perspectiveAngle=2 * atan(SQUARE / 2 / CAMERA.fx))
    scene = read_one(part_folder, gear, points=64)
    assert scene.camera.fx == pytest.approx(CAMERA.fx, rel=1e-12)


@pytest.mark.parametrize("place", ["gt/parameter.json", "../parameter.json"])
def test_the_parameters_may_lie_elsewhere(tmp_path, gear, picture, place):
    part_folder = only_scene(tmp_path, picture)
    (part_folder / "parameter.json").rename(part_folder / place)
    assert len(read_one(part_folder, gear, points=64).points) == 64


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"perspectiveAngle": 0}, "key 'perspectiveAngle' is 0"),
        ({"perspectiveAngle": 180}, "key 'perspectiveAngle' is 180, expected less than 180 degrees"),
        ({"perspectiveAngle": 3.15}, "key 'perspectiveAngle' is 3.15"),
        ({"perspectiveAngle": None}, "key 'perspectiveAngle' is missing"),
        ({"perspectiveAngle": 179.9}, "degrees off the axis"),
        ({"resolution_big": "240"}, "key 'resolution_big' does not hold numbers"),
        ({"resolution_big": 184}, "resolutionX 160 pixels from 30 on does not lie in an image of .* 184"),
        ({"pixelOffset_X_KoSyTopLeft": -1}, "resolutionX 160 pixels from -1 on"),
        ({"resolutionX": float("nan")}, "key 'resolutionX' holds NaN"),
        ({"resolutionX": 0}, "an image of 0 x 120 pixels"),
        ({"resolutionY": 100.5}, "an image of 160 x 100.5 pixels, expected whole numbers"),
        ({"clip_start": 1.6}, r"clip_end \(1.5 m\) must exceed clip_start \(1.6 m\)"),
        ({"clip_start": -0.1}, "which must be positive"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(tmp_path, gear, picture, changes, message):
    part_folder = only_scene(tmp_path, picture)
    write_parameters(part_folder, CAMERA, **changes)
    with pytest.raises(ValueError, match=rf"parameter\.json: .*{message}"):
        read_one(part_folder, gear)


@pytest.mark.parametrize("text", ["[]", "", "{"])
def test_parameters_of_another_form_are_refused(tmp_path, gear, picture, text):
    part_folder = only_scene(tmp_path, picture)
    (part_folder / "parameter.json").write_text(text)
    with pytest.raises(ValueError, match=r"parameter\.json: (holds a list|is not valid JSON)"):
        read_one(part_folder, gear)


def test_missing_parameters_are_named(tmp_path, gear, picture):
    part_folder = only_scene(tmp_path, picture)
    (part_folder / "parameter.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"part_2/parameter\.json: no such file, nor"):
        read_one(part_folder, gear)


# the images


@pytest.mark.parametrize("file", [depth_of, segmentation_of])
@pytest.mark.parametrize(
    ("kind", "shape", "message"),
    [
        (np.float32, (120, 160), "not readable as an image"),
        (np.uint16, (119, 160), "has 160 x 119 pixels, the camera 160 x 120"),
        (np.uint8, (120, 160, 3), "has pixels of mode RGB"),
    ],
)
def test_an_image_of_another_kind_is_refused(tmp_path, gear, picture, file, kind, shape, message):
    path = file(only_scene(tmp_path, picture))
    image = Image.fromarray(np.zeros(shape, kind))
    image.save(path, format="PNG" if kind != np.float32 else "PPM")
    with pytest.raises(ValueError, match=rf"{path.name}: {message}"):
        read_one(path.parents[2], gear)


def test_depth_of_8_bits_and_segmentations_of_16_are_refused(tmp_path, gear, picture):
    part_folder = only_scene(tmp_path, picture)
    files = depth_of(part_folder), segmentation_of(part_folder)
    shutil.copy(files[0], tmp_path / "depth.png")
    shutil.copy(files[1], files[0])
    with pytest.raises(ValueError, match=r"006_depth_uint16\.png: has pixels of type uint8, expected uint16"):
        read_one(part_folder, gear)
    shutil.copy(tmp_path / "depth.png", files[0])
    shutil.copy(tmp_path / "depth.png", files[1])
    with pytest.raises(ValueError, match=r"006_segmentation\.png: has pixels of type uint16, expected uint8"):
        read_one(part_folder, gear)


# splits and folders


def cycles_of(data, split, part):
    return sorted({one.cycle for one in data.scenes(split, part).ids})


def test_the_last_cycles_over_all_parts_are_for_tests_and_validation(write_small, gear):
    root = write_small(cycles=[(10, 0), (2, 1), (2, 0), (2, 10), (10, 3)])
    data = IpaData(str(root), val_cycles=2, test_cycles=1, points=64)
    assert cycles_of(data, "train", gear) == [20000, 20001]
    assert cycles_of(data, "val", gear) == [20010, 100000]
    assert cycles_of(data, "test_l", gear) == [100003]
    assert data.manifest()["scenes"] == {"test_l": 2, "train": 4, "val": 4}
    ids = [(one.cycle, one.drop) for one in data.scenes("train", gear).ids]
    assert ids == [(20000, 2), (20000, 4), (20001, 2), (20001, 4)]
    assert [one.drop for one in data.scenes("train", gear, every=2).ids] == [4, 4]
    assert str(data.scenes("test_l", gear).ids[0]) == "test_l/pile_100003_part_00/002"


def test_a_single_part_folder_is_read_alone(write_small, gear):
    root = write_small(cycles=[(1, 0), (2, 0)])
    assert cycles_of(IpaData(str(root / "IPAGear_part_2"), 0, 0), "train", gear) == [20000]


def test_scenes_of_the_real_world_are_for_tests(write_small, gear, small):
    root = write_small(cycles=[(1, 0), (1, 1), (2, 0)])
    part_folder = root / "IPAGear_part_1"
    nearer = replace(small[0], depth=small[0].depth - 0.05, t=small[0].t - [0, 0, 0.05])
    write_picture(part_folder, 5, 2, nearer, ending="_real_world")
    write_depth(part_folder, 5, 0, SMALL, small[0].floor, "p_depth_real_world")
    data = IpaData(str(root), val_cycles=1, test_cycles=1, points=64, real_world=True)
    assert [cycles_of(data, split, gear) for split in ("train", "val", "test_l")] == [
        [10000],
        [10001],
        [10005],
    ]
    (scene,) = data.scenes("test_l", gear)
    assert round_trip_errors(scene, nearer)["t"] < 1e-6
    assert data.manifest()["scenes"] == {"test_l": 1, "train": 2, "val": 2}


def test_the_real_world_may_share_segmentation_and_truth(write_small, gear, small):
    root = write_small(cycles=[(1, 0), (1, 1)])
    part_folder = root / "IPAGear_part_1"
    for drop, depth in ((0, small[0].floor), (2, small[0].depth), (4, small[1].depth)):
        write_depth(part_folder, 1, drop, SMALL, depth, "p_depth_real_world")
    scenes = IpaData(str(root), 1, 0, points=64, real_world=True).scenes("test_l", gear)
    assert [(one.cycle, one.drop) for one in scenes.ids] == [(10001, 2), (10001, 4)]
    assert round_trip_errors(scenes[1], small[1])["R"] < 1e-9


def test_without_scenes_of_the_real_world_there_is_no_test(write_small, gear):
    with pytest.raises(ValueError, match=r"no scenes are left for test_l; .*real_world \(True\)"):
        IpaData(str(write_small()), 1, 1, real_world=True).scenes("test_l", gear)


@pytest.mark.parametrize(
    ("counts", "message"),
    [
        ((1, 1), r"no scenes are left for train; change data\.source\.val_cycles \(1\), test_cycles \(1\)"),
        ((2, 1), r"has 2 cycles, fewer than data\.source\.val_cycles \(2\) and test_cycles \(1\) take"),
    ],
)
def test_splits_that_leave_no_training_are_refused(write_small, gear, counts, message):
    with pytest.raises(ValueError, match=message):
        IpaData(str(write_small()), *counts).scenes("train", gear)


def test_the_general_test_split_does_not_exist(write_small, gear):
    with pytest.raises(ValueError, match="no split test_g, only train, val, test_l"):
        IpaData(str(write_small()), 0, 0).scenes("test_g", gear)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"points": -1}, r"data\.source\.points is -1"),
        ({"val_cycles": -1}, r"data\.source\.val_cycles is -1"),
        ({"test_cycles": 0.5}, r"data\.source\.test_cycles is 0\.5"),
        ({"background": -0.1}, r"data\.source\.background is -0\.1"),
        ({"background": float("nan")}, r"data\.source\.background is nan"),
        ({"background": "thick"}, r"data\.source\.background is 'thick', expected at least 0"),
    ],
)
def test_settings_that_make_no_sense_name_their_key(settings, message):
    with pytest.raises(ValueError, match=message):
        IpaData(**({"root": "/nowhere", "val_cycles": 1, "test_cycles": 1} | settings))


def test_a_part_of_several_sizes_is_refused(write_small, tn34):
    with pytest.raises(ValueError, match="one size each, but part tn34 has 16 part objects"):
        IpaData(str(write_small()), 0, 0).scenes("train", tn34)


@pytest.mark.parametrize("kind", ["p_depth", "p_segmentation", "gt"])
def test_a_missing_counterpart_is_named(write_small, gear, kind):
    root = write_small()
    (path,) = (root / "IPAGear_part_1" / kind / "cycle_0001").glob("002*")
    path.unlink()
    with pytest.raises(FileNotFoundError, match=rf"{kind}/cycle_0001/{path.name}: no such file, though"):
        IpaData(str(root), 0, 0).scenes("train", gear)


@pytest.mark.parametrize("kind", ["p_segmentation", "gt"])
def test_a_missing_folder_is_named(write_small, gear, kind):
    root = write_small()
    shutil.rmtree(root / "IPAGear_part_1" / kind / "cycle_0001")
    with pytest.raises(FileNotFoundError, match=rf"{kind}/cycle_0001: no such folder"):
        IpaData(str(root), 0, 0).scenes("train", gear)


def test_a_folder_without_parts_says_what_was_expected(tmp_path, gear):
    with pytest.raises(FileNotFoundError, match="holds neither p_depth nor folders named like"):
        IpaData(str(tmp_path), 0, 0).scenes("train", gear)
    with pytest.raises(FileNotFoundError, match="nowhere: no such folder"):
        IpaData(str(tmp_path / "nowhere"), 0, 0).manifest()


def test_parts_of_several_objects_are_refused(write_small, gear):
    root = write_small()
    (root / "IPARing_part_1").mkdir()
    with pytest.raises(ValueError, match=r"holds folders of several objects \(IPAGear, IPARing\)"):
        IpaData(str(root), 0, 0).scenes("train", gear)


def test_parts_with_the_same_number_are_refused(write_small, gear):
    root = write_small()
    shutil.copytree(root / "IPAGear_part_1", root / "IPAGear_part_01")
    with pytest.raises(ValueError, match="has the same numbers as"):
        IpaData(str(root), 0, 0).scenes("train", gear)


def test_scenes_with_the_same_number_are_refused(write_small, gear):
    root = write_small()
    for path in list((root / "IPAGear_part_1").glob("*/cycle_0000/002*")):
        shutil.copy(path, path.with_name(f"0{path.name}"))
    with pytest.raises(ValueError, match="has the same numbers as"):
        IpaData(str(root), 0, 0).scenes("train", gear)


def test_the_manifest_tells_settings_and_scenes_apart(write_small, tmp_path):
    root = write_small()
    made = IpaData(str(root), 1, 0).manifest()
    assert made["source"] == "ipa" and made["scenes"] == {"train": 2, "val": 2}
    assert json.loads(json.dumps(made)) == made
    shutil.copytree(root, tmp_path / "elsewhere")
    assert IpaData(str(tmp_path / "elsewhere"), 1, 0).manifest() == made
    assert IpaData(str(root), 1, 0, background=None).manifest() != made
    assert IpaData(str(root), 0, 1).manifest() != made
    for path in list((root / "IPAGear_part_1").glob("*/cycle_0000/002*")):
        path.unlink()
    assert IpaData(str(root), 1, 0).manifest() != made


def test_the_scenes_travel_to_other_processes(write_small, gear):
    scenes = IpaData(str(write_small()), 0, 0, points=64).scenes("train", gear)
    copy = pickle.loads(pickle.dumps(scenes))
    np.testing.assert_array_equal(copy[3].points, scenes[3].points)


def test_damaged_files_give_errors_or_scenes(tmp_path, write_small, gear):
    outcomes = read_damaged(
        write_small(), tmp_path, lambda root: IpaData(root, 1, 0, points=64), ["train", "val"], gear
    )
    print(f"IPA: {outcomes}")
    assert outcomes["read"] > 2 * outcomes["refused"] > 0 and outcomes["not opened"] > 0
