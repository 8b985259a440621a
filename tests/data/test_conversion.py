"""Conversion into the store: the same scenes, resumable, and refused where it would mix."""

from dataclasses import replace

import numpy as np
import pytest

from pnet.data.conversion import conversion_manifest, convert, plan_conversion
from pnet.data.source import SceneSet, StoredData
from pnet.records import SceneId


class Made(SceneSet):
    """Scenes that are there already."""

    def __init__(self, scenes):
        self.made, self.reads = scenes, 0

    ids = property(lambda self: [scene.id for scene in self.made])
    points_per_scene = 64

    def __len__(self):
        return len(self.made)

    def __getitem__(self, index):
        self.reads += 1
        return self.made[index]


class Source:
    """A data set with two splits: two cycles of three scenes to train on, one of two for tests."""

    def __init__(self, make_scene, part, name="made"):
        self.name = name
        cycles = {"train": [(0, 3), (4, 3)], "test_l": [(9, 2)]}
        self.sets = {
            split: Made(
                [
                    replace(make_scene(part, drop, 64, cycle), id=SceneId(split, "pile", cycle, 2, drop))
                    for cycle, drops in plan
                    for drop in range(1, drops + 1)
                ]
            )
            for split, plan in cycles.items()
        }

    def manifest(self):
        return {"name": self.name}

    def scenes(self, split, part, every=1, keep=None):
        if split not in self.sets:
            raise ValueError(f"{split}: not in this set")
        return self.sets[split]


@pytest.fixture
def source(make_scene, tn34):
    return Source(make_scene, tn34)


def run(source, part, root):
    plan = plan_conversion(source, part, root)
    return list(convert(plan, conversion_manifest(plan, {"name": part.name}), workers=0))


def test_a_converted_set_holds_the_same_scenes(source, tn34, tmp_path):
    reports = run(source, tn34, tmp_path / "store")
    assert [(cycle.split, cycle.stem, report.scenes) for cycle, report in reports] == [
        ("train", "pile_0000_part_02", 3),
        ("train", "pile_0004_part_02", 3),
        ("test_l", "pile_0009_part_02", 2),
    ]
    store = StoredData(tmp_path / "store")
    for split, made in source.sets.items():
        scenes = store.scenes(split, tn34)
        assert scenes.ids == made.ids and scenes.points_per_scene == 64
        for found, first in zip(scenes, made.made, strict=True):
            for name in ("points", "instance", "R", "t", "parameters", "visibility", "occlusion"):
                np.testing.assert_array_equal(getattr(found, name), getattr(first, name))
            assert found.camera == first.camera
    manifest = store.manifest()
    assert manifest["converted"] == {"name": "made"} and manifest["files"] == {"train": 2, "test_l": 1}
    assert manifest["points"] == 64 and manifest["camera"]["width"] == 160


def test_what_is_there_is_kept_and_what_is_gone_is_made_again(source, tn34, tmp_path):
    run(source, tn34, tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.safetensors")}
    gone = tmp_path / "train" / "pile_0004_part_02.safetensors"
    gone.unlink()
    source.sets["train"].reads = 0
    reports = run(source, tn34, tmp_path)
    assert [report is None for _, report in reports] == [True, True, False]
    assert source.sets["train"].reads == 4  # the lost cycle's three, and one for the camera
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.safetensors")} == before


def test_splits_may_be_converted_one_after_the_other(source, tn34, tmp_path):
    plan = plan_conversion(source, tn34, tmp_path)
    manifest = conversion_manifest(plan, {"name": "tn34"})
    assert [cycle.split for cycle, _ in convert(plan, manifest, 0, ["test_l"])] == ["test_l"]
    assert len(StoredData(tmp_path).scenes("test_l", tn34)) == 2
    with pytest.raises(FileNotFoundError, match="train"):
        StoredData(tmp_path).scenes("train", tn34)
    assert [report is None for _, report in convert(plan, manifest, 0)] == [True, False, False]


def test_another_source_does_not_mix_with_the_store(source, make_scene, tn34, tmp_path):
    run(source, tn34, tmp_path)
    with pytest.raises(ValueError, match=r"converted\.name was 'made', now 'other'"):
        run(Source(make_scene, tn34, "other"), tn34, tmp_path)


def test_scenes_without_a_point_are_left_out_and_counted(source, tn34, tmp_path):
    first = source.sets["train"].made[0]
    source.sets["train"].made[0] = replace(first, points=first.points[:0], instance=first.instance[:0])
    reports = run(source, tn34, tmp_path)
    assert (reports[0][1].scenes, reports[0][1].empty) == (2, 1)
    assert [one.drop for one in StoredData(tmp_path).scenes("train", tn34).ids] == [2, 3, 1, 2, 3]


def test_two_cameras_in_a_cycle_are_an_error_that_names_the_scene(source, tn34, tmp_path):
    scene = source.sets["train"].made[1]
    source.sets["train"].made[1] = replace(scene, camera=replace(scene.camera, fx=1.0))
    with pytest.raises(ValueError, match="train/pile_0000_part_02/002: its camera differs"):
        run(source, tn34, tmp_path)


def test_a_source_without_any_split_says_why(tn34, tmp_path, source):
    source.sets = {}
    with pytest.raises(ValueError, match="train: not in this set"):
        plan_conversion(source, tn34, tmp_path)
