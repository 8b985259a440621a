"""Data sources: pnet's own store, and two sets for training and tests."""

import json

import pytest

from pnet.data.combined import CombinedData
from pnet.data.source import SceneSet, StoredData


class Listed(SceneSet):
    """As many scenes as told."""

    def __init__(self, name, count):
        self.name, self._ids = name, list(range(count))

    ids = property(lambda self: self._ids)
    points_per_scene = 7

    def __len__(self):
        return len(self._ids)

    def __getitem__(self, index):
        return (self.name, index)


class Named:
    """A data set that tells which split it was asked for."""

    def __init__(self, name):
        self.name = name

    def manifest(self):
        return {"name": self.name}

    def scenes(self, split, part, every=1, keep=None):
        return Listed((self.name, split, every), 3)


def test_the_store_is_read_by_its_manifest_and_its_files(tmp_path, tn34, write_split):
    written = write_split(tmp_path, tn34, "train")
    (tmp_path / "dataset.json").write_text(json.dumps({"seed": 3, "files": {"train": 2}}))
    source = StoredData(tmp_path)
    assert source.manifest() == {"seed": 3, "files": {"train": 2}}
    scenes = source.scenes("train", tn34, every=2)
    assert [scene.drop for scene in scenes.ids] == [1, 3, 1, 3]
    assert (scenes[1].t == written[2].t).all() and scenes.draw(1, None).id == scenes[1].id
    assert scenes.points_per_scene == 256
    with pytest.raises(FileNotFoundError, match="no scenes there"):
        source.scenes("val", tn34)


@pytest.mark.parametrize(("split", "name"), [("train", "a"), ("val", "a"), ("test_l", "b"), ("test_g", "b")])
def test_training_takes_one_set_and_tests_the_other(tn34, split, name):
    source = CombinedData(Named("a"), Named("b"))
    assert source.scenes(split, tn34, 4)[2] == ((name, split, 4), 2)
    assert source.manifest() == {"source": "combined", "training": {"name": "a"}, "tests": {"name": "b"}}
