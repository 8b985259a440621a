"""The names that scenes go by."""

from dataclasses import FrozenInstanceError

import pytest

from pnet.records import SceneId

ID = SceneId("train", "pile", cycle=7, part_index=11, drop=24)


def test_a_scene_id_reads_as_split_file_and_drop():
    assert str(ID) == "train/pile_0007_part_11/024"


def test_the_scenes_of_a_cycle_share_a_file():
    other_drop = SceneId("train", "pile", 7, 11, 1)
    assert other_drop.file_stem == ID.file_stem == "pile_0007_part_11"


@pytest.mark.parametrize(
    "other",
    [
        SceneId("train", "clutter", 7, 11, 24),
        SceneId("train", "pile", 8, 11, 24),
        SceneId("train", "pile", 7, 12, 24),
    ],
)
def test_kind_cycle_and_part_object_name_different_files(other):
    assert other.file_stem != ID.file_stem


def test_equal_ids_are_one_key_and_cannot_be_changed():
    assert {ID, SceneId("train", "pile", 7, 11, 24)} == {ID}
    with pytest.raises(FrozenInstanceError):
        ID.drop = 3  # type: ignore[misc]
