from pathlib import Path

import numpy as np
import pytest

from pnet.data.public.public_scenes import Listed, PublicScenes, listing_digest, public_manifest
from pnet.records import SceneId

ROOT = Path("/data")


def listed(cycles, split="val", part_index=0):
    """Scenes 1, 2, … of some cycles, so many in each."""
    return [
        Listed(SceneId(split, "pile", cycle, part_index, drop), ROOT / str(cycle), f"{drop:03d}")
        for cycle, count in cycles.items()
        for drop in range(1, count + 1)
    ]


def name(one):
    """Stands for a scene."""
    return f"{one.folder.name}/{one.name}"


def test_scenes_are_read_when_they_are_asked_for():
    read = []
    scenes = PublicScenes(listed({0: 2, 1: 1}), lambda one: read.append(one.name) or name(one), points=64)
    assert len(scenes) == 3 and scenes.points_per_scene == 64 and read == []
    assert scenes[2] == "1/001" and read == ["001"]
    assert scenes.draw(1, np.random.default_rng(0)) == "0/002"
    assert list(scenes) == ["0/001", "0/002", "1/001"]
    with pytest.raises(IndexError):
        scenes[3]


def test_some_scenes_are_kept_from_the_end_of_each_cycle():
    scenes = PublicScenes(listed({0: 7, 3: 2, 4: 1}), name, points=1, every=3)
    assert [(one.cycle, one.drop) for one in scenes.ids] == [(0, 1), (0, 4), (0, 7), (3, 2), (4, 1)]


def test_part_objects_are_chosen_among_those_that_are_there():
    both = listed({0: 2}, part_index=3) + listed({1: 1}, part_index=5)
    scenes = PublicScenes(both, name, points=1, keep=lambda there: there - {3} if there == {3, 5} else there)
    assert [(one.part_index, one.drop) for one in scenes.ids] == [(5, 1)]


def test_the_digest_knows_which_scenes_there_are_and_not_where():
    some = listed({0: 2, 1: 1})
    digest = listing_digest(ROOT, some)
    assert digest == listing_digest(ROOT, some[::-1])
    moved = [Listed(one.id, Path("/else") / one.folder.name, one.name) for one in some]
    assert digest == listing_digest(Path("/else"), moved)
    others = [some[:2], listed({0: 2, 1: 1}, split="train"), listed({0: 2, 2: 1}), listed({0: 1, 1: 2})]
    assert digest not in {listing_digest(ROOT, other) for other in others}


def test_the_manifest_counts_the_scenes_of_every_split():
    some = listed({0: 2}) + listed({1: 3}, split="test_l")
    made = public_manifest("bins", {"points": 5}, ROOT, some, None)
    assert made == {
        "source": "bins",
        "points": 5,
        "camera": None,
        "scenes": {"test_l": 3, "val": 2},
        "listing": listing_digest(ROOT, some),
    }
