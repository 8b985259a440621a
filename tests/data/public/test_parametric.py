"""Raw folders of the Parametric data set, written by hand, against what was put before the camera."""

import builtins
import json
import os
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from scipy.spatial.transform import Rotation
from tests.data.public.parametric_checks import MUTATIONS, assert_is_scene, damage_and_read, read_everything
from tests.data.public.parametric_writer import (
    CLIP_START,
    LARGEST,
    STEP,
    colours,
    make_camera,
    make_pile,
    truth_rows,
    write_colours,
    write_depth,
    write_parameters,
    write_raw,
    write_truth,
)

from pnet.data.public.object_frame import ObjectFrame
from pnet.data.public.parametric import ParametricData
from pnet.data.public.parametric_camera import read_camera
from pnet.records import SceneId
from pnet.scenes.rendering import render_view

TRAIN = Path("training_set/TemplateNum06")
SCENE = "cycle_0000/5_005"


@pytest.fixture
def pile(tn06):
    return make_pile(tn06, 5)


@pytest.fixture
def root(tmp_path, pile):
    """One cycle with one scene of five bodies."""
    write_parameters(tmp_path / TRAIN / "parameter.json", pile.camera)
    write_raw(tmp_path / TRAIN, "5_005", pile)
    return tmp_path


@pytest.fixture
def read(root, tn06):
    """Reads the only scene of `root`."""

    def read_scene(points=4096, **settings):
        (scene,) = ParametricData(str(root), points, val_cycles=0, **settings).scenes("train", tn06)
        return scene

    return read_scene


def write_names(template: Path, cycles: int, parts: int, drops: int) -> None:
    """A template's truth files, all empty, and its camera."""
    write_parameters(template / "parameter.json", make_camera())
    for cycle in range(cycles):
        folder = template / "gt" / f"cycle_{cycle:04d}"
        folder.mkdir(parents=True)
        for part in range(parts):
            for drop in range(1, drops + 1):
                (folder / f"{part}_{drop:03d}.csv").touch()


class TestRoundTrip:
    def test_points_are_the_rendered_ones_within_half_a_step_of_the_depth_code(self, read, pile):
        scene = read()
        u, v = np.rint(pile.camera.project(scene.points)).astype(int).T
        error = np.linalg.norm(scene.points - pile.cloud[v, u], axis=1)
        assert error.max() <= 0.5 * STEP + 1e-7  # 4.6 micrometres, and float32

    def test_every_pixel_on_a_body_becomes_a_point_of_that_body(self, read, pile):
        scene = read()
        u, v = np.rint(pile.camera.project(scene.points)).astype(int).T
        found = np.full(pile.view.instance.shape, -1)
        found[v, u] = scene.instance
        np.testing.assert_array_equal(found, pile.view.instance)

    def test_bodies_come_by_segmentation_id_though_rows_are_shuffled(self, read, pile):
        scene = read()
        np.testing.assert_allclose(scene.R, pile.R, atol=1e-12)
        np.testing.assert_allclose(scene.t, pile.t, atol=1e-12)
        np.testing.assert_allclose(scene.parameters, np.tile(pile.sizes, (5, 1)), atol=1e-12)
        np.testing.assert_allclose(scene.visibility, pile.view.visibility, atol=1e-12)
        assert scene.id == SceneId("train", "pile", 0, 5, 5) and scene.part == "tn06"

    def test_occlusion_is_that_of_the_unclipped_silhouettes(self, read, pile):
        scene = read()
        np.testing.assert_array_equal(scene.occlusion, pile.view.occlusion)
        assert (scene.occlusion > 0.2).sum() >= 2  # covered, and cut by the border
        assert_is_scene(scene, 4096)

    def test_visibility_is_the_files_and_not_that_of_the_pixels(self, root, read, pile):
        rows = truth_rows(pile)
        rows[2][14] = 0.125
        write_truth(root / TRAIN / "gt" / f"{SCENE}.csv", rows)
        assert read().visibility[2] == 0.125

    def test_a_single_body_has_id_0_whatever_its_green(self, tmp_path, tn06):
        alone = make_pile(tn06, 1)
        write_parameters(tmp_path / "parameter.json", alone.camera)
        write_raw(tmp_path / TRAIN, "5_001", alone)
        red, _, blue = colours(alone)
        write_colours(tmp_path / TRAIN / "segment_images/cycle_0000/5_001/Image0001.exr", red, red / 3, blue)
        (scene,) = ParametricData(str(tmp_path), 64, val_cycles=0).scenes("train", tn06)
        assert len(scene.R) == 1 and not scene.instance.any() and scene.occlusion[0] == 0

    def test_a_wholly_hidden_body_keeps_its_truth_and_has_occlusion_1(self, tmp_path, tn06, pile):
        rows = [*range(5), 2]  # the nut that stands, and another one in its shadow
        crowd = replace(pile, R=pile.R[rows], t=pile.t[rows] * np.array([1, 1, 1, 1, 1, 1.1])[:, None])
        assert crowd.view.visible[5] == 0
        write_parameters(tmp_path / "parameter.json", crowd.camera)
        write_raw(tmp_path / TRAIN, "5_006", crowd)
        (scene,) = ParametricData(str(tmp_path), 64, val_cycles=0).scenes("train", tn06)
        assert len(scene.R) == 6 and scene.occlusion[5] == 1 and scene.visibility[5] == 0

    def test_pixels_without_depth_give_no_points_but_count_as_visible(self, root, read, pile):
        nothing = np.zeros(pile.view.depth.shape, np.uint16)
        write_depth(root / TRAIN / "depth_images" / SCENE / "Image0001.png", nothing)
        scene = read()
        np.testing.assert_array_equal(scene.occlusion, pile.view.occlusion)
        assert_is_scene(scene, 4096)
        assert len(scene.points) == 0

    def test_points_are_sampled_farthest_first_and_repeated_where_there_are_few(self, read, pile):
        few, many = read(points=50), read(points=4096)
        np.testing.assert_array_equal(few.points, many.points[:50])
        pixels = int((pile.view.instance >= 0).sum())
        assert pixels < 4096
        np.testing.assert_array_equal(many.points[pixels:], many.points[: 4096 - pixels])

    def test_the_objects_frame_is_carried_to_the_parts(self, root, read, pile):
        turn = Rotation.from_rotvec([0.3, -0.2, 1.1]).as_matrix()
        frame = ObjectFrame(turn.tolist(), (1.5, -2.0, 4.0))  # x_part = turn x_object + t
        shift = np.array([0.0015, -0.002, 0.004])
        rows = truth_rows(pile)
        for row, R, t in zip(rows, pile.R, pile.t, strict=True):
            row[2:5], row[5:14] = (t + R @ shift).tolist(), (R @ turn).reshape(9).tolist()
        write_truth(root / TRAIN / "gt" / f"{SCENE}.csv", rows)
        scene = read(frame=frame)
        np.testing.assert_allclose(scene.R, pile.R, atol=1e-12)
        np.testing.assert_allclose(scene.t, pile.t, atol=1e-12)

    def test_depth_is_counted_along_the_ray(self, tmp_path):
        camera = replace(make_camera(), fx=200.0, fy=100.0, cx=10.0, cy=20.0)
        write_parameters(tmp_path / "parameter.json", camera)
        sensor = read_camera(tmp_path / "parameter.json")
        values = np.zeros((72, 96), np.uint16)
        values[20, 10] = values[60, 40] = 30000
        planar = sensor.planar(values, "image")
        distance = CLIP_START + 30000 * STEP
        assert planar[20, 10] == pytest.approx(distance, abs=1e-12)
        assert planar[60, 40] == pytest.approx(distance / np.sqrt(1 + 0.15**2 + 0.4**2), abs=1e-12)
        assert np.count_nonzero(planar) == 2

    def test_the_cameras_near_plane_lets_every_coded_distance_through(self, tmp_path):
        write_parameters(tmp_path / "parameter.json", make_camera())
        sensor = read_camera(tmp_path / "parameter.json")
        nearest = sensor.planar(np.ones((72, 96), np.uint16), "image").min()
        assert 0 < nearest - sensor.camera.near < STEP

    def test_both_names_of_the_segmentation_are_read(self, root, read):
        before = read()
        (root / TRAIN / "segment_images").rename(root / TRAIN / "segmentation_images")
        np.testing.assert_array_equal(read().instance, before.instance)

    def test_half_precision_colours_give_the_same_ids(self, root, read, pile):
        before = read()
        half = [channel.astype(np.float16) for channel in colours(pile)]
        write_colours(root / TRAIN / "segment_images" / SCENE / "Image0001.exr", *half)
        np.testing.assert_array_equal(read().instance, before.instance)


class TestListing:
    def test_splits_are_cycles_in_order_with_drops_together(self, tmp_path, tn06):
        write_names(tmp_path / TRAIN, cycles=4, parts=2, drops=3)
        write_names(tmp_path / "learning_test_set/TemplateNum06", cycles=1, parts=1, drops=2)
        data = ParametricData(str(tmp_path), val_cycles=1)
        expected = [
            SceneId("train", "pile", cycle, part, drop)
            for cycle in range(3)
            for part in range(2)
            for drop in (1, 2, 3)
        ]
        assert data.scenes("train", tn06).ids == expected
        assert [one.cycle for one in data.scenes("val", tn06).ids] == [3] * 6
        assert [str(one) for one in data.scenes("test_l", tn06).ids] == [
            "test_l/pile_0000_part_00/001",
            "test_l/pile_0000_part_00/002",
        ]
        with pytest.raises(FileNotFoundError, match="generalization_test_set"):
            data.scenes("test_g", tn06)

    def test_parts_and_drops_sort_as_numbers(self, tmp_path, tn06):
        folder = tmp_path / TRAIN / "gt/cycle_0000"
        folder.mkdir(parents=True)
        for name in ("10_001", "9_010", "9_002"):
            (folder / f"{name}.csv").touch()
        write_parameters(tmp_path / "parameter.json", make_camera())
        ids = ParametricData(str(tmp_path), val_cycles=0).scenes("train", tn06).ids
        assert [(one.part_index, one.drop) for one in ids] == [(9, 2), (9, 10), (10, 1)]

    def test_every_and_keep_choose_by_cycle_and_part_object(self, tmp_path, tn06):
        write_names(tmp_path / TRAIN, cycles=2, parts=3, drops=4)
        data = ParametricData(str(tmp_path))
        chosen = data.scenes("train", tn06, every=3, keep=lambda objects: objects - {1})
        assert [(one.part_index, one.drop) for one in chosen.ids] == [(0, 1), (0, 4), (2, 1), (2, 4)]

    def test_files_of_other_kinds_and_empty_bins_are_passed_over(self, tmp_path, tn06):
        write_names(tmp_path / TRAIN, cycles=1, parts=1, drops=2)
        folder = tmp_path / TRAIN / "gt/cycle_0000"
        for name in ("notes.csv", "0_000.csv", ".0_001.csv", "0_001.csv.part", "0_003.txt"):
            (folder / name).touch()
        (tmp_path / TRAIN / "gt/cycle_old").mkdir()
        data = ParametricData(str(tmp_path), val_cycles=0)
        assert [one.drop for one in data.scenes("train", tn06).ids] == [1, 2]

    def test_listing_opens_no_scene_and_asks_for_no_files_state(self, tmp_path, tn06, monkeypatch):
        write_names(tmp_path / TRAIN, cycles=2, parts=5, drops=20)
        asked, opened = Counter(), []
        stat, open_file = os.stat, builtins.open
        count = lambda path, *a, **k: (asked.update([Path(path).suffix]), stat(path, *a, **k))[1]  # noqa: E731
        monkeypatch.setattr(os, "stat", count)
        monkeypatch.setattr(
            builtins, "open", lambda path, *a, **k: opened.append(path) or open_file(path, *a, **k)
        )
        assert ParametricData(str(tmp_path)).manifest()["scenes"] == {"train": 100, "val": 100}
        assert opened == [] and asked[".csv"] == 0 and asked.total() < 60

    def test_a_listing_follows_the_folder(self, tmp_path, tn06):
        write_names(tmp_path / TRAIN, cycles=1, parts=1, drops=2)
        data = ParametricData(str(tmp_path), val_cycles=0)
        before, folder = data.manifest(), tmp_path / TRAIN / "gt/cycle_0000"
        (folder / "0_003.csv").touch()
        os.utime(folder, ns=(1, 1))  # another time than before, however coarse the file system's clock
        after = data.manifest()
        assert (before["scenes"], after["scenes"]) == ({"train": 2}, {"train": 3})
        assert before["listing"] != after["listing"]

    def test_the_manifest_is_the_same_in_another_place_and_tells_settings_apart(self, tmp_path):
        write_names(tmp_path / "a" / TRAIN, cycles=3, parts=1, drops=2)
        write_names(tmp_path / "b" / TRAIN, cycles=3, parts=1, drops=2)
        a, b = ParametricData(str(tmp_path / "a")), ParametricData(str(tmp_path / "b"))
        assert a.manifest() == b.manifest() == json.loads(json.dumps(a.manifest()))
        others = [replace(b, val_cycles=2), replace(b, points=10), replace(b, frame=ObjectFrame(t=(1, 0, 0)))]
        assert all(other.manifest() != a.manifest() for other in others)

    def test_the_template_follows_the_parts_name_or_the_setting(self, tmp_path, tn06, tn34):
        write_names(tmp_path / "training_set/TemplateNum34", cycles=1, parts=1, drops=2)
        data = ParametricData(str(tmp_path), val_cycles=0)
        assert len(data.scenes("train", tn34)) == 2
        with pytest.raises(FileNotFoundError, match="TemplateNum06"):
            data.scenes("train", tn06)
        assert len(replace(data, template="TemplateNum34").scenes("train", tn06)) == 2

    def test_a_part_of_another_name_needs_the_template(self, tmp_path, tn06):
        other = type(tn06)(learning={"r": [4], "h": [8], "d": [12]})
        other.name = "my_nut"
        with pytest.raises(ValueError, match=r"no part my_nut; set data\.source\.template"):
            ParametricData(str(tmp_path)).scenes("train", other)

    def test_two_files_of_one_scene_are_refused(self, tmp_path, tn06):
        write_names(tmp_path / TRAIN, cycles=1, parts=1, drops=1)
        (tmp_path / TRAIN / "gt/cycle_0000/00_001.csv").touch()
        with pytest.raises(ValueError, match=r"/0_001: has the same numbers as .*/00_001"):
            ParametricData(str(tmp_path), val_cycles=0).scenes("train", tn06)

    @pytest.mark.parametrize("val_cycles, split", [(0, "val"), (2, "train"), (5, "train")])
    def test_a_split_without_cycles_is_an_error(self, tmp_path, tn06, val_cycles, split):
        write_names(tmp_path / TRAIN, cycles=2, parts=1, drops=1)
        with pytest.raises(FileNotFoundError, match=f"split {split} .* data.source.val_cycles={val_cycles}"):
            ParametricData(str(tmp_path), val_cycles=val_cycles).scenes(split, tn06)

    @pytest.mark.parametrize(
        "settings, message",
        [
            ({"points": 0}, "points is 0"),
            ({"val_cycles": -1}, "val_cycles is -1"),
            ({"layout": "zip"}, "layout is 'zip', expected raw or h5"),
            ({"template": "../other"}, "template is '../other'"),
        ],
    )
    def test_impossible_settings_are_refused(self, settings, message):
        with pytest.raises(ValueError, match=message):
            ParametricData("data", **settings)

    def test_a_missing_root_an_unknown_split_and_a_missing_camera_are_errors(self, tmp_path, tn06):
        data = ParametricData(str(tmp_path / "nowhere"))
        with pytest.raises(FileNotFoundError, match="nowhere"):
            data.manifest()
        with pytest.raises(FileNotFoundError, match=r"nowhere/training_set.*data\.source\.root"):
            data.scenes("train", tn06)
        with pytest.raises(ValueError, match="split is 'test'"):
            data.scenes("test", tn06)
        write_names(tmp_path / TRAIN, cycles=2, parts=1, drops=1)
        (tmp_path / TRAIN / "parameter.json").unlink()
        with pytest.raises(FileNotFoundError, match=r"no parameter\.json"):
            ParametricData(str(tmp_path)).scenes("train", tn06)

    def test_the_nearest_camera_above_a_cycle_counts(self, tmp_path, root, read):
        write_parameters(tmp_path / "parameter.json", make_camera(), fu=1e9)
        write_parameters(tmp_path / "training_set/parameter.json", make_camera(), fu=1e9)
        assert read().camera.fx == pytest.approx(2.9 * 96)
        write_parameters(tmp_path / "training_set/parameter.json", make_camera(), clip_end=0.95)
        (root / TRAIN / "parameter.json").unlink()
        assert read().camera.far == 0.95


class TestBadTruth:
    @pytest.fixture
    def refused(self, root, read, pile):
        """Writes rows after a change and expects the error that names the file."""

        def check(change, message, error=ValueError):
            rows = truth_rows(pile)
            rows = change(rows) or rows
            path = root / TRAIN / "gt" / f"{SCENE}.csv"
            write_truth(path, rows)
            with pytest.raises(error, match=rf"(?s)5_005.*{message}") as caught:
                read()
            assert str(root) in str(caught.value)

        return check

    def put(self, row, column, value):
        """A change of one cell."""
        return lambda rows: rows[row].__setitem__(column, value)

    def test_missing(self, root, tn06):
        scenes = ParametricData(str(root), val_cycles=0).scenes("train", tn06)
        (root / TRAIN / "gt" / f"{SCENE}.csv").unlink()
        with pytest.raises(FileNotFoundError, match=r"5_005\.csv: no such file"):
            scenes[0]

    @pytest.mark.parametrize(
        "text, message",
        [
            ("", "is empty"),
            ("\n \n", "is empty"),
            ("class,id\n", "has 0 rows, expected 1 to 5"),
            ("\x00\xff", "not a text file"),
            ("TN06" + ",1" * 17 + "\n", "line 1 holds numbers, expected a header"),
        ],
    )
    def test_no_rows(self, root, read, text, message):
        (root / TRAIN / "gt" / f"{SCENE}.csv").write_bytes(text.encode("latin-1"))
        with pytest.raises(ValueError, match=rf"5_005\.csv: {message}"):
            read()

    def test_truncated(self, root, read):
        path = root / TRAIN / "gt" / f"{SCENE}.csv"
        os.truncate(path, path.stat().st_size - 20)
        with pytest.raises(ValueError, match=r"5_005\.csv: line 6 has \d+ columns, expected 18"):
            read()

    def test_too_large(self, root, read):
        path = root / TRAIN / "gt" / f"{SCENE}.csv"
        os.truncate(path, 2_000_000_000)
        with pytest.raises(ValueError, match=r"5_005\.csv: has 2,000,000,000 bytes"):
            read()

    @pytest.mark.parametrize("cell", ["nan", "inf", "-inf", "1e400", "", "x"])
    def test_cells_that_are_no_numbers(self, refused, cell):
        refused(self.put(1, 3, cell), rf"column 4 is '{cell}', expected a number")

    def test_a_parameter_column_too_few_or_too_many(self, refused):
        refused(
            lambda rows: [row[:-1] for row in rows],
            "has 17 columns, expected 18: .*parameters r, h, d of tn06",
        )
        refused(lambda rows: [[*row, 1.0] for row in rows], "has 19 columns, expected 18")

    def test_more_rows_than_bodies(self, refused):
        refused(lambda rows: [*rows, [*rows[0][:1], 5, *rows[0][2:]]], "has 6 rows, expected 1 to 5")

    @pytest.mark.parametrize(
        "value, ids", [(1, "0, 1, 1, 3, 4"), (7, "0, 1, 3, 4, 7"), (-1, "-1, "), (0.5, "0.5")]
    )
    def test_ids_that_are_not_0_to_n_each_once(self, refused, value, ids):
        refused(self.put(2, 1, value), rf"segmentation ids are .*{ids}.*expected 0 to 4, each once")

    def test_a_row_too_few_shows_in_the_colours(self, refused):
        refused(lambda rows: rows[:4], r"expected whole numbers, 0 to 3, for the 4 rows")

    def test_no_rotation(self, refused, pile):
        refused(self.put(3, 5, 0.5), "the rotation of entry 3 is none")
        mirrored = (pile.R[3] * [1, 1, -1]).reshape(9).tolist()
        refused(lambda rows: rows[3].__setitem__(slice(5, 14), mirrored), "determinant -1")

    @pytest.mark.parametrize("value", [-0.01, 1.01, 65536])
    def test_visibility_outside_0_to_1(self, refused, value):
        refused(self.put(0, 14, value), "visibility is .*expected 0 to 1")

    def test_sizes_that_differ_from_body_to_body(self, refused):
        refused(self.put(2, 16, 12.0), "bodies differ in size, 0 has r = 4 mm.* 2 has r = 4 mm, h = 12 mm")

    def test_sizes_that_make_no_solid(self, refused):
        def change(rows):
            for row in rows:
                row[15] = 14.0

        refused(change, "the hole .* is as wide as the hexagon")

    def test_sizes_of_many_metres(self, refused):
        def change(rows):
            for row in rows:
                row[16] = 1e30

        refused(change, "expected parameters in mm")

    def test_sizes_in_metres(self, root, read, pile):
        rows = truth_rows(pile)
        for row in rows:
            row[15:] = [size / 1000 for size in row[15:]]
        write_truth(root / TRAIN / "gt" / f"{SCENE}.csv", rows)
        with pytest.raises(
            ValueError, match=r"5_005\.csv: points of body \d are .* from its pose on average"
        ):
            read()

    def test_poses_behind_the_camera_before_the_near_plane_and_far_away(self, refused):
        refused(self.put(2, 4, -0.5), "a body is at t = .*expected metres in the camera frame, z > 0")
        refused(self.put(2, 4, 0.29), "body 2 reaches to z = 0.2.* m, nearer than the camera")
        refused(self.put(2, 4, 500_000), "a body is at t = ")
        refused(self.put(2, 2, 999), "points of body 2 are .* mm from its pose on average")

    def test_poses_in_another_frame(self, refused):
        def change(rows):
            for row in rows:
                row[2:5] = [row[2], row[3], 1.3 - row[4]]

        refused(change, "points of body . are .* expected poses in the camera frame")


class TestBadImages:
    def test_missing(self, root, read):
        (root / TRAIN / "depth_images" / SCENE / "Image0001.png").unlink()
        with pytest.raises(FileNotFoundError, match=r"depth_images.*Image0001\.png"):
            read()

    def test_missing_segmentation(self, root, read):
        (root / TRAIN / "segment_images" / SCENE / "Image0001.exr").unlink()
        with pytest.raises(FileNotFoundError, match=r"segment_images/cycle_0000/5_005/Image0001\.exr"):
            read()

    @pytest.mark.parametrize("image", ["depth_images/{}/Image0001.png", "segment_images/{}/Image0001.exr"])
    @pytest.mark.parametrize("kept", [0, 0.6])
    def test_empty_or_truncated(self, root, read, image, kept):
        path = root / TRAIN / image.format(SCENE)
        os.truncate(path, int(kept * path.stat().st_size))
        with pytest.raises(ValueError, match=path.name):
            read()

    def test_another_size(self, root, read, pile):
        depth = root / TRAIN / "depth_images" / SCENE / "Image0001.png"
        write_depth(depth, np.ones((96, 72), np.uint16))
        with pytest.raises(ValueError, match=r"\.png: has 72 x 96 pixels, the camera 96 x 72"):
            read()
        write_depth(depth, np.ones((72, 96), np.uint16))
        write_colours(
            root / TRAIN / "segment_images" / SCENE / "Image0001.exr", *np.ones((3, 36, 48), np.float32)
        )
        with pytest.raises(ValueError, match=r"\.exr: has 48 x 36 pixels"):
            read()

    def test_another_type(self, root, read):
        path = root / TRAIN / "depth_images" / SCENE / "Image0001.png"
        write_depth(path, np.ones((72, 96, 3), np.uint8))
        with pytest.raises(ValueError, match=r"\.png: has pixels of mode RGB"):
            read()
        write_depth(path, np.ones((72, 96), np.uint8))
        with pytest.raises(ValueError, match=r"\.png: has pixels of type uint8, expected .* up to 65535"):
            read()

    def test_depth_above_the_largest_value(self, root, read, pile):
        write_parameters(root / TRAIN / "parameter.json", pile.camera, max_val_in_depth=100)
        with pytest.raises(ValueError, match=r"\.png: holds 0 to \d+, expected 0 to 100"):
            read()

    def test_other_channels_and_integers(self, root, read):
        path = root / TRAIN / "segment_images" / SCENE / "Image0001.exr"
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        one = np.ones((72, 96), np.float32)
        OpenEXR.File(header, {"R": one, "G": one, "Y": one}).write(str(path))
        with pytest.raises(ValueError, match=r"\.exr: has the channels G, R, Y, expected R, G and B"):
            read()
        write_colours(path, *np.ones((3, 72, 96), np.uint32))
        with pytest.raises(ValueError, match=r"\.exr: R, G and B are uint32 .* expected floats"):
            read()

    @pytest.mark.parametrize("green", [1.25, -0.25, np.nan, np.inf, 0.1])
    def test_an_id_that_the_truth_lacks(self, root, read, pile, green):
        red, own, blue = colours(pile)
        own[pile.view.instance == 1] = green
        write_colours(root / TRAIN / "segment_images" / SCENE / "Image0001.exr", red, own, blue)
        with pytest.raises(
            ValueError, match=r"\.exr: green times 4 gives ids .* for the 5 rows of 5_005\.csv"
        ):
            read()


class TestBadCamera:
    @pytest.mark.parametrize(
        "changes, message",
        [
            ({"fu": 0}, "focal lengths 0 and .* must be positive"),
            ({"fv": -278.4}, "-278.4 must be positive"),
            ({"fu": 1e-30}, "would be seen at 90.00 degrees off the axis"),
            ({"cu": 1e30}, "would be seen at 90.00 degrees off the axis"),
            ({"fu": "wide"}, "key 'fu' does not hold numbers"),
            ({"cv": float("nan")}, "key 'cv' holds NaN"),
            ({"resolutionX": 96.5}, "96.5 x 72 pixels, expected whole numbers"),
            ({"resolutionY": 0}, "96 x 0 pixels"),
            ({"resolutionX": 99999999999}, r"1e\+11 x 72 pixels"),
            ({"clip_start": 0.9, "clip_end": 0.3}, r"clip_end \(0.3 m\) must exceed clip_start \(0.9 m\)"),
            ({"clip_start": 0}, r"clip_start \(0 m\), which must be positive"),
            ({"clip_start": 5e-324, "fu": 20}, "key 'clip_start' is"),
            ({"clip_end": float("inf")}, "key 'clip_end' holds NaN or infinity"),
            ({"max_val_in_depth": 0}, "key 'max_val_in_depth' is 0, expected more than 0"),
            ({"max_val_in_depth": [65535]}, "key 'max_val_in_depth' has shape"),
        ],
    )
    def test_impossible_values(self, tmp_path, changes, message):
        path = tmp_path / "parameter.json"
        write_parameters(path, make_camera(), **changes)
        with pytest.raises(ValueError, match=rf"parameter\.json: .*{message}"):
            read_camera(path)

    @pytest.mark.parametrize(
        "text, message", [("", "not valid JSON"), ("[1]", "holds a list"), ("{}", "'resolutionX' is missing")]
    )
    def test_no_object_with_the_keys(self, tmp_path, text, message):
        path = tmp_path / "parameter.json"
        path.write_text(text)
        with pytest.raises(ValueError, match=rf"parameter\.json: .*{message}"):
            read_camera(path)

    def test_a_camera_that_makes_bodies_larger_than_memory(self, root, read, pile):
        write_parameters(root / TRAIN / "parameter.json", pile.camera, fu=1e9, fv=1e9)
        with pytest.raises(ValueError, match=r"5_005\.csv: body \d covers .* pixels"):
            read()


def test_every_value_of_the_depth_code_is_within_the_clip_planes(tmp_path):
    write_parameters(tmp_path / "parameter.json", replace(make_camera(), width=256, height=256))
    sensor = read_camera(tmp_path / "parameter.json")
    values = np.arange(256 * 256, dtype=np.uint16).reshape(256, 256)
    planar = sensor.planar(values, "image")
    v, u = np.indices(values.shape)
    distance = np.linalg.norm(sensor.camera.rays(u, v) * planar[..., None], axis=-1)
    assert distance[values == LARGEST] == pytest.approx([0.9], abs=1e-12)
    assert np.diff(distance.reshape(-1)[1:]) == pytest.approx(STEP, abs=1e-12)


def test_parts_with_two_parameters_are_read(tmp_path, tn34):
    pile = make_pile(tn34, 3)
    assert len(pile.sizes) == 2
    folder = tmp_path / "generalization_test_set/TemplateNum34"
    write_parameters(tmp_path / "parameter.json", pile.camera)
    write_raw(folder, "5_003", pile, segments="segmentation_images")
    (scene,) = ParametricData(str(tmp_path), 256).scenes("test_g", tn34)
    np.testing.assert_allclose(scene.parameters, np.tile(pile.sizes, (3, 1)), atol=1e-12)
    view = render_view(scene.camera, tn34.mesh(pile.sizes), scene.R, scene.t)
    np.testing.assert_array_equal(scene.occlusion, view.occlusion)


def test_damaged_folders_are_refused_or_read_as_scenes(tmp_path, tn06):
    whole = tmp_path / "whole"
    for cycle, bodies in ((0, 2), (0, 5), (1, 3)):
        pile = make_pile(tn06, bodies, width=48)
        write_raw(whole / TRAIN, f"5_{bodies:03d}", pile, cycle, seed=bodies)
    write_parameters(whole / TRAIN / "parameter.json", pile.camera)
    assert read_everything(ParametricData(str(whole), points=64), tn06) == 3
    outcomes = damage_and_read(whole, tmp_path / "copies", tn06)
    assert sum(outcomes.values()) == MUTATIONS
    assert outcomes["ValueError"] > MUTATIONS / 4
