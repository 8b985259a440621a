"""H5 files of the Parametric data set, written by hand, against what was put before the camera."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.data.public.parametric_checks import MUTATIONS, assert_is_scene, damage_and_read, read_everything
from tests.data.public.parametric_writer import (
    h5_arrays,
    make_camera,
    make_pile,
    write_h5,
    write_parameters,
    write_raw,
)

from pnet.data.public.object_frame import ObjectFrame
from pnet.data.public.parametric import ParametricData
from pnet.ops.sampling import farthest_point_order
from pnet.records import SceneId

TRAIN = Path("training_set/TemplateNum06")
SCENE = TRAIN / "cycle_0000/5_005.h5"
POINTS = 700


@pytest.fixture
def pile(tn06):
    return make_pile(tn06, 5)


@pytest.fixture
def arrays(pile):
    """`data` and `labels` of the pile."""
    return h5_arrays(pile, POINTS)


@pytest.fixture
def read(tmp_path, pile, tn06):
    """Writes two arrays as the only scene and reads it."""
    write_parameters(tmp_path / TRAIN / "parameter.json", pile.camera)

    def read_scene(data, labels, points=POINTS, **settings):
        write_h5(tmp_path / SCENE, data=data, labels=labels)
        (scene,) = ParametricData(str(tmp_path), points, val_cycles=0, **settings).scenes("train", tn06)
        return scene

    return read_scene


class TestRoundTrip:
    def test_points_are_the_files_farthest_first(self, read, arrays):
        data, labels = arrays
        scene = read(data, labels)
        order = farthest_point_order(data, POINTS)
        np.testing.assert_array_equal(scene.points, data[order])
        np.testing.assert_array_equal(scene.instance, labels[order, 13])
        few = read(data, labels, points=100)
        np.testing.assert_array_equal(few.points, scene.points[:100])
        many = read(data, labels, points=1000)
        np.testing.assert_array_equal(many.points[POINTS:], scene.points[:300])

    def test_bodies_have_the_files_poses_and_visibility_and_the_grids_sizes(self, read, arrays, pile):
        scene = read(*arrays)
        np.testing.assert_allclose(scene.R, pile.R, atol=1e-7)
        np.testing.assert_allclose(scene.t, pile.t, atol=1e-7)
        np.testing.assert_allclose(scene.visibility, pile.view.visibility, atol=1e-7)
        np.testing.assert_array_equal(scene.parameters, np.tile(pile.sizes, (5, 1)))
        assert scene.id == SceneId("train", "pile", 0, 5, 5) and scene.part == "tn06"
        assert scene.incidence is None and scene.edge is None
        assert_is_scene(scene, POINTS)

    def test_occlusion_is_that_of_the_pixels_where_a_body_is_wholly_visible(self, read, arrays, pile):
        assert pile.view.occlusion.min() == 0
        np.testing.assert_allclose(read(*arrays).occlusion, pile.view.occlusion, atol=1e-6)

    def test_occlusion_in_larger_pixels_is_off_by_less_than_two_percent(self, tmp_path, read, tn06):
        fine = make_pile(tn06, 5, width=960)
        write_parameters(tmp_path / TRAIN / "parameter.json", fine.camera)
        found = read(*h5_arrays(fine, 200)).occlusion
        np.testing.assert_allclose(found, fine.view.occlusion, atol=0.02)

    def test_no_visibility_at_all_is_occlusion_1(self, read, arrays):
        data, labels = arrays
        labels[:, 12] = 0
        np.testing.assert_array_equal(read(data, labels).occlusion, np.ones(5))

    def test_a_body_without_a_point_is_left_out(self, read, arrays, pile):
        data, labels = arrays
        seen = labels[:, 13] != 2
        scene = read(data[seen], labels[seen])
        np.testing.assert_allclose(scene.t, pile.t[[0, 1, 3, 4]], atol=1e-7)
        assert sorted(set(scene.instance.tolist())) == [0, 1, 2, 3]
        own = np.linalg.norm(scene.points - scene.t[scene.instance], axis=1)
        assert own.max() < 0.015  # each point is on its own body, whose radius is 13.2 mm

    def test_double_precision_and_other_numbers_of_keypoints_are_read(self, read, arrays, pile):
        data, labels = (values.astype(np.float64) for values in arrays)
        for keypoints in (0, 2, 4):
            columns = labels[:, np.arange(14 + 3 * keypoints) % 23]
            np.testing.assert_allclose(read(data, columns).t, pile.t, atol=1e-7)

    def test_the_objects_frame_is_carried_to_the_parts(self, read, arrays, pile):
        turn = Rotation.from_rotvec([0.3, -0.2, 1.1]).as_matrix()
        shift = np.array([0.0015, -0.002, 0.004])
        data, labels = arrays
        body = labels[:, 13].astype(int)
        labels[:, :3] = (pile.t + pile.R @ shift)[body]
        labels[:, 3:12] = (pile.R @ turn).reshape(-1, 9)[body]
        scene = read(data, labels, frame=ObjectFrame(turn.tolist(), (1000 * shift).tolist()))
        np.testing.assert_allclose(scene.R, pile.R, atol=1e-6)
        np.testing.assert_allclose(scene.t, pile.t, atol=1e-7)

    def test_the_generalization_set_takes_the_grid_g(self, tmp_path, tn06):
        pile = make_pile(tn06, 3, grid="G", index=9)
        write_parameters(tmp_path / "parameter.json", pile.camera)
        data, labels = h5_arrays(pile, 200)
        path = tmp_path / "generalization_test_set/TemplateNum06/cycle_0000/9_003.h5"
        write_h5(path, data=data, labels=labels)
        (scene,) = ParametricData(str(tmp_path), 200).scenes("test_g", tn06)
        np.testing.assert_array_equal(1000 * scene.parameters[0], [4.5, 15, 13])


class TestFolders:
    @pytest.mark.parametrize(
        "folder",
        [
            "training_set/TemplateNum06",
            "training_set/h5/TemplateNum06",
            "training_set/h5_dataset/TemplateNum06",
            "training_set/TemplateNum06/h5",
            "training_set/TemplateNum06/a/b/c",
        ],
    )
    def test_cycles_are_found_below_the_template(self, tmp_path, tn06, arrays, folder):
        write_parameters(tmp_path / "parameter.json", make_camera())
        for cycle in range(3):
            data, labels = arrays
            write_h5(tmp_path / folder / f"cycle_{cycle:04d}/5_005.h5", data=data, labels=labels)
        data = ParametricData(str(tmp_path), 64)
        assert [one.cycle for one in data.scenes("train", tn06).ids] == [0, 1]
        assert [one.cycle for one in data.scenes("val", tn06).ids] == [2]
        assert data.manifest()["scenes"] == {"train": 2, "val": 1}
        assert len(list(data.scenes("train", tn06))) == 2

    def test_raw_data_come_first_where_both_are_there(self, tmp_path, tn06, pile, arrays):
        write_parameters(tmp_path / TRAIN / "parameter.json", pile.camera)
        write_raw(tmp_path / TRAIN, "5_005", pile)
        data, labels = arrays
        write_h5(tmp_path / SCENE, data=data, labels=labels)
        write_h5(tmp_path / TRAIN / "cycle_0000/5_004.h5", data=data, labels=labels)
        both = ParametricData(str(tmp_path), 64, val_cycles=0)
        assert [one.drop for one in both.scenes("train", tn06).ids] == [5]
        assert [one.drop for one in replace(both, layout="h5").scenes("train", tn06).ids] == [4, 5]
        assert both.manifest() != replace(both, layout="h5").manifest()
        (raw,) = both.scenes("train", tn06)
        assert raw.edge is not None

    def test_a_cycle_in_two_places_is_refused(self, tmp_path, tn06):
        for folder in ("h5/TemplateNum06", "TemplateNum06"):
            path = tmp_path / "training_set" / folder / "cycle_0000/5_005.h5"
            path.parent.mkdir(parents=True)
            path.touch()
        with pytest.raises(ValueError, match=r"5_005: has the same numbers as .*5_005"):
            ParametricData(str(tmp_path), val_cycles=0).scenes("train", tn06)

    def test_the_setting_gives_the_camera_where_no_file_does(self, tmp_path, tn06, arrays):
        data, labels = arrays
        write_h5(tmp_path / SCENE, data=data, labels=labels)
        source = ParametricData(str(tmp_path), 64, val_cycles=0)
        with pytest.raises(FileNotFoundError, match=r"no parameter\.json .* or set data\.source\.camera"):
            source.scenes("train", tn06)
        own = make_camera(64, 48)
        assert replace(source, camera=own).scenes("train", tn06)[0].camera == own
        write_parameters(tmp_path / "parameter.json", make_camera())
        assert replace(source, camera=own).scenes("train", tn06)[0].camera.width == 96


class TestBadFiles:
    @pytest.fixture
    def refused(self, read, arrays):
        """Reads arrays after a change and expects the error that names the file."""

        def check(change, message):
            data, labels = (values.copy() for values in arrays)
            data, labels = change(data, labels) or (data, labels)
            with pytest.raises(ValueError, match=rf"5_005\.h5: .*{message}"):
                read(data, labels)

        return check

    def test_missing(self, tmp_path, read, arrays, tn06):
        read(*arrays)
        scenes = ParametricData(str(tmp_path), val_cycles=0).scenes("train", tn06)
        (tmp_path / SCENE).unlink()
        with pytest.raises(FileNotFoundError, match=r"5_005\.h5: no such file"):
            scenes[0]

    @pytest.mark.parametrize("kept", [0, 0.1, 0.9])
    def test_empty_or_truncated(self, tmp_path, read, arrays, tn06, kept):
        read(*arrays)
        os.truncate(tmp_path / SCENE, int(kept * (tmp_path / SCENE).stat().st_size))
        scenes = ParametricData(str(tmp_path), val_cycles=0).scenes("train", tn06)
        with pytest.raises(ValueError, match=r"5_005\.h5: "):
            scenes[0]

    @pytest.mark.parametrize(
        "shapes",
        [((700, 2), (700, 23)), ((700, 3), (699, 23)), ((700, 3), (700, 13)), ((700, 3), (700, 22))],
    )
    def test_wrong_shapes(self, refused, shapes):
        refused(
            lambda *_: [np.ones(shape, np.float32) for shape in shapes], r"expected \(n, 3\) and \(n, 23\)"
        )

    def test_no_rows_three_axes_and_integers(self, refused):
        refused(lambda data, labels: (data[:0], labels[:0]), r"`data` has shape \(0, 3\)")
        refused(
            lambda data, labels: (data[None], labels), r"`data` is float32 \(1, 700, 3\), expected floats"
        )
        refused(lambda data, labels: (data, labels.astype(int)), r"`labels` is int64")

    def test_a_claim_of_more_than_fits_is_refused_before_it_is_read(self, tmp_path, read, arrays, tn06):
        read(*arrays)
        for shape, chunks in (((1 << 40, 3), (1024, 3)), ((1024, 3), (1 << 28, 3))):
            with h5py.File(tmp_path / SCENE, "w") as file:
                file.create_dataset("data", shape, "f4", chunks=chunks, maxshape=(None, 3))
                file["labels"] = arrays[1]
            with pytest.raises(ValueError, match=r"5_005\.h5: `data` has shape .* at most 1,048,576"):
                ParametricData(str(tmp_path), 64, val_cycles=0).scenes("train", tn06)[0]

    def test_arrays_missing_or_elsewhere(self, tmp_path, read, arrays, tn06):
        data, labels = arrays
        read(data, labels)
        write_h5(tmp_path / "other.h5", data=data)
        elsewhere = {
            "link": h5py.ExternalLink(str(tmp_path / "other.h5"), "data"),
            "soft": h5py.SoftLink("/labels"),
        }
        for content in ({}, {"data": elsewhere["link"]}, {"data": elsewhere["soft"]}):
            write_h5(tmp_path / SCENE, labels=labels, **content)
            with pytest.raises(ValueError, match=r"5_005\.h5: holds no `data`"):
                ParametricData(str(tmp_path), 64, val_cycles=0).scenes("train", tn06)[0]
        with h5py.File(tmp_path / SCENE, "w") as file:
            file.create_group("data")
        with pytest.raises(ValueError, match=r"5_005\.h5: `data` is no array of this file"):
            ParametricData(str(tmp_path), 64, val_cycles=0).scenes("train", tn06)[0]

    @pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
    def test_numbers_that_are_none(self, refused, value):
        refused(lambda data, labels: data.__setitem__((3, 1), value), "`data` holds NaN, infinity or more")
        refused(lambda data, labels: labels.__setitem__((3, 4), value), "`labels` holds NaN, infinity")

    def test_keypoints_are_not_looked_at(self, read, arrays, pile):
        data, labels = arrays
        labels[:, 14:] = np.nan
        np.testing.assert_allclose(read(data, labels).t, pile.t, atol=1e-7)

    @pytest.mark.parametrize("value", [-1, 5, 0.5])
    def test_ids_that_no_body_has(self, refused, value):
        refused(lambda data, labels: labels.__setitem__((3, 13), value), "expected whole numbers, 0 to 4")

    @pytest.mark.parametrize("column", [0, 11, 12])
    def test_labels_that_differ_within_a_body(self, refused, column):
        def change(data, labels):
            labels[np.flatnonzero(labels[:, 13] == 3)[-1], column] += 2e-5

        refused(change, "labels of body 3 differ by 2e-05")

    def test_no_rotation(self, refused):
        def change(data, labels):
            labels[labels[:, 13] == 3, 3:12] *= 1.01

        refused(change, "the rotation of entry 3 is none")

    def test_visibility_outside_0_to_1(self, refused):
        refused(lambda data, labels: labels.__setitem__((slice(None), 12), 1.5), "visibility is 1.5 to 1.5")

    def test_points_behind_the_camera_and_poses_elsewhere(self, refused):
        refused(lambda data, labels: data.__setitem__((3, 2), 0), "points lie behind the camera")
        refused(lambda data, labels: labels.__setitem__((slice(None), 2), -0.5), "a body is at t = .* z > 0")
        refused(
            lambda data, labels: labels.__setitem__((slice(None), 0), 0.2),
            "points of body . are .* mm from its pose on average",
        )

    def test_a_part_object_that_the_grid_lacks(self, tmp_path, arrays, tn06, pile):
        write_parameters(tmp_path / TRAIN / "parameter.json", pile.camera)
        data, labels = arrays
        write_h5(tmp_path / TRAIN / "cycle_0000/64_005.h5", data=data, labels=labels)
        scenes = ParametricData(str(tmp_path), val_cycles=0).scenes("train", tn06)
        with pytest.raises(ValueError, match=r"64_005\.h5: tn06 has no part object 64 in grid L"):
            scenes[0]

    def test_without_h5py_the_extra_is_named(self, tmp_path, monkeypatch, read, arrays, tn06):
        read(*arrays)
        monkeypatch.setitem(sys.modules, "h5py", None)
        with pytest.raises(ModuleNotFoundError, match=r'5_005\.h5: .* pip install "pnet\[formats\]"'):
            ParametricData(str(tmp_path), val_cycles=0).scenes("train", tn06)[0]


def test_damaged_folders_are_refused_or_read_as_scenes(tmp_path, tn06):
    whole = tmp_path / "whole"
    for cycle, bodies in ((0, 2), (0, 5), (1, 3)):
        pile = make_pile(tn06, bodies, width=48)
        data, labels = h5_arrays(pile, 40)
        write_h5(whole / TRAIN / f"cycle_{cycle:04d}/5_{bodies:03d}.h5", data=data, labels=labels)
    write_parameters(whole / TRAIN / "parameter.json", pile.camera)
    assert read_everything(ParametricData(str(whole), points=64), tn06) == 3
    outcomes = damage_and_read(whole, tmp_path / "copies", tn06)
    assert sum(outcomes.values()) == MUTATIONS
    assert outcomes["ValueError"] > MUTATIONS / 4
