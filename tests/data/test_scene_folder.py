"""A split's scenes by index; what is wrong with a folder is said with its name."""

import json
import pickle
import re
from dataclasses import replace

import numpy as np
import pytest

from pnet.data.scene_folder import SceneFolder
from pnet.records import SceneId
from pnet.scenes.manifest import MANIFEST
from pnet.scenes.store import CycleFile, CycleHeader, write_cycle


@pytest.fixture
def root(tmp_path, tn34, write_split):
    write_split(tmp_path, tn34, "train")
    return tmp_path


def test_scenes_come_cycle_by_cycle(tmp_path, tn34, write_split):
    written = write_split(tmp_path, tn34, "train")
    scenes = SceneFolder(tmp_path, "train", "tn34")
    assert len(scenes) == 6 and scenes.points_per_scene == 256
    for i in (5, 0, 3, 1, 4, 2):
        np.testing.assert_array_equal(scenes[i].points, written[i].points)
        assert scenes[i].id == scenes.ids[i] == written[i].id


@pytest.mark.parametrize(("every", "drops"), [(1, [1, 2, 3]), (2, [1, 3]), (3, [3]), (9, [3])])
def test_every_counts_from_the_full_bin(root, every, drops):
    scenes = SceneFolder(root, "train", "tn34", every)
    assert [scene_id.drop for scene_id in scenes.ids] == 2 * drops
    assert [len(scene.R) for scene in scenes] == 2 * drops


@pytest.mark.parametrize("index", [-1, 6])
def test_there_is_no_scene_outside(root, index):
    with pytest.raises(IndexError):
        SceneFolder(root, "train", "tn34")[index]


@pytest.mark.parametrize("make", [False, True])
def test_a_missing_or_empty_folder_says_what_to_run(tmp_path, make):
    if make:
        (tmp_path / "val").mkdir()
    with pytest.raises(FileNotFoundError, match=re.escape(str(tmp_path / "val")) + ".*run pnet-generate"):
        SceneFolder(tmp_path, "val", "tn34")


def test_unfinished_files_are_no_scenes(root):
    (root / "train" / ".pile_0009_part_00.safetensors.7.part").write_bytes(b"half")
    (root / "train" / ".hidden.safetensors").write_bytes(b"half")
    assert len(SceneFolder(root, "train", "tn34")) == 6


def test_files_without_scenes_are_said_to_be_empty(root):
    for path in (root / "train").iterdir():
        header = CycleFile(path).header
        write_cycle(path, type(header)(**{**vars(header), "drops": ()}), [])
    with pytest.raises(ValueError, match="its files hold no scene; make the data anew"):
        SceneFolder(root, "train", "tn34")


def test_another_parts_data_is_refused(root):
    with pytest.raises(ValueError, match=r"shows tn34, not tn06; set part=tn34 or another data\.root"):
        SceneFolder(root, "train", "tn06")


def test_a_damaged_file_is_named(root):
    path = root / "train" / "pile_0001_part_00.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"pile_0001_part_00\.safetensors: not a whole cycle file"):
        SceneFolder(root, "train", "tn34")


def test_a_damaged_scene_is_named_when_it_is_read(root):
    path = root / "train" / "pile_0001_part_00.safetensors"
    whole = bytearray(path.read_bytes())
    whole[-1] ^= 1
    path.write_bytes(whole)
    scenes = SceneFolder(root, "train", "tn34")
    scenes[0]
    with pytest.raises(ValueError, match=r"pile_0001.*checksum"):
        for i in (3, 4, 5):
            scenes[i]


def test_it_travels_to_a_worker(root):
    scenes = SceneFolder(root, "train", "tn34")
    first = scenes[4]
    copy = pickle.loads(pickle.dumps(scenes))
    np.testing.assert_array_equal(copy[4].points, first.points)
    assert copy.ids == scenes.ids


@pytest.fixture
def objects(tmp_path, tn34, make_scene):
    """Two cycles of part objects 0, 3, 4 and 9, two scenes each."""
    (tmp_path / "train").mkdir()
    for cycle in (0, 1):
        for place in (0, 3, 4, 9):
            made = [
                replace(make_scene(tn34, drop, 64 + place), id=SceneId("train", "pile", cycle, place, drop))
                for drop in (1, 2)
            ]
            header = CycleHeader("tiny", "tn34", made[0].camera, "train", "pile", cycle, place, (1, 2))
            write_cycle(tmp_path / "train" / f"{made[0].id.file_stem}.safetensors", header, made)
    return tmp_path


def test_only_scenes_of_the_objects_to_keep_are_there(objects):
    asked = []

    def keep(places):
        asked.append(places)
        return {9, 3, 77}

    scenes = SceneFolder(objects, "train", "tn34", keep=keep)
    assert asked == [{0, 3, 4, 9}]
    places = [(cycle, place, drop) for cycle in (0, 1) for place in (3, 9) for drop in (1, 2)]
    assert [(i.cycle, i.part_index, i.drop) for i in scenes.ids] == places
    assert [scene.id for scene in scenes] == scenes.ids and len(scenes) == 8
    assert [len(scene.points) for scene in scenes] == 2 * [67, 67, 73, 73]
    assert scenes.points_per_scene == 67
    assert SceneFolder(objects, "train", "tn34").points_per_scene == 64


def test_all_objects_kept_are_all_scenes(objects):
    every, kept = (SceneFolder(objects, "train", "tn34", 2, keep) for keep in (None, lambda places: places))
    assert kept.ids == every.ids and len(every) == 8


def test_kept_scenes_travel_to_a_worker(objects):
    scenes = SceneFolder(objects, "train", "tn34", keep=lambda places: {4})
    copy = pickle.loads(pickle.dumps(scenes))
    assert copy.ids == scenes.ids and copy[3].id == scenes.ids[3] and copy[3].id.part_index == 4


def test_a_cycle_that_is_missing_is_missed_also_where_its_object_is_not_kept(objects):
    (objects / MANIFEST).write_text(json.dumps({"files": {"train": 8}}))
    assert len(SceneFolder(objects, "train", "tn34", keep=lambda places: {0})) == 4
    (objects / "train" / "pile_0001_part_09.safetensors").unlink()
    with pytest.raises(ValueError, match="only 7 of 8 cycles are there"):
        SceneFolder(objects, "train", "tn34", keep=lambda places: {0})


def test_nothing_kept_is_an_error(objects):
    with pytest.raises(ValueError, match=r"train: its files hold no scene"):
        SceneFolder(objects, "train", "tn34", keep=lambda places: set())
