"""Summaries and checks of folders made by hand, of which every number is known."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pnet.parts.tn34 import TN34
from pnet.scenes.inspection import DataSet, summarise, summarise_piles, whole_cycle
from pnet.scenes.pile import Pile
from pnet.scenes.pile_store import PileHeader, write_piles
from pnet.scenes.protocol import Protocol, SplitPlan
from pnet.scenes.record_file import SUFFIX, write_records
from pnet.scenes.store import SCENES, CycleFile, write_cycle
from pnet.scenes.verification import Verification, check_scenes, verify

FINGERPRINT, PILES = "tiny", "tiny piles"
SPLITS = {"train": SplitPlan("L", cycles=1, objects=[0])}
VAL = {**SPLITS, "val": SplitPlan("L", cycles=1, first_cycle=1, objects=[0])}
TEST = {**SPLITS, "test_g": SplitPlan("G", cycles=1, objects=[0])}


def data_set(root: Path, part, splits=SPLITS, points: int = 256) -> DataSet:
    """A plan of cycles of three scenes."""
    protocol = Protocol("hand", drop_limit=3, points=points, splits=splits)
    tasks = protocol.tasks({name: list(range(len(grid))) for name, grid in part.grids.items()})
    files = {split: 1 for split in splits}
    return DataSet(root, root / "piles", part, protocol, tasks, FINGERPRINT, PILES, files)


def rewrite(path: Path, header=None, change=None) -> None:
    """Write a cycle again with whole checksums: other fields in the header, each scene changed."""
    file = CycleFile(path)
    scenes = [file.scene(i) for i in range(len(file))]
    if change is not None:
        scenes = [change(scene) for scene in scenes]
    write_cycle(path, replace(file.header, **(header or {})), scenes)


def put_piles(data: DataSet, task, **changes) -> Path:
    """A file of piles as generation makes it."""
    parameters = data.part.part_object(task.grid, task.part_index)
    place = (task.split, task.kind, task.grid, task.cycle, task.part_index)
    header = PileHeader(PILES, data.part.name, *place, tuple(parameters.tolist()), (1, 2, 3))
    piles = [Pile(Rotation.random(d, 0).as_matrix(), np.zeros((d, 3)), d) for d in (1, 2, 3)]
    path = data.pile_path(task)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_piles(path, replace(header, **changes), piles)
    return path


def spoil(path: Path, place: float) -> None:
    """Turn one bit of the file, at a share of its size."""
    content = bytearray(path.read_bytes())
    content[int(place * len(content))] ^= 1
    path.write_bytes(content)


def faults(data: DataSet) -> list[tuple[str, str]]:
    return [(fault.kind, str(fault)) for fault in verify(data).faults]


@pytest.fixture
def made(tmp_path, tn34, write_split):
    """A whole training split: scenes of one, two and three bodies; and its plan."""
    return data_set(tmp_path, tn34), write_split(tmp_path, tn34, "train", cycles=1)


@pytest.fixture
def path(made) -> Path:
    data, _ = made
    return data.scene_path(data.tasks[0])


def test_a_summary_counts_what_is_there(made, path):
    data, scenes = made
    rewrite(path, {"escaped": 4, "unsettled": 2})
    done = []
    found = summarise(data, done.append)
    split = found.splits["train"]
    visibility = np.concatenate([scene.visibility for scene in scenes])
    assert (split.part_objects, split.planned, split.whole, split.missing, split.damaged) == (1, 1, 1, 0, 0)
    assert (split.scenes, split.instances, split.to_find, split.points) == (3, 6, 6, (256, 256))
    assert (split.escaped, split.unsettled, split.empty, split.extra) == (4, 2, 0, 0)
    assert split.size == path.stat().st_size
    assert split.visibility == np.histogram(visibility, 10, (0, 1))[0].tolist() and sum(split.visibility) == 6
    assert done == [1]
    assert list(found.coverage) == ["pile"]
    assert found.coverage["pile"].instances == 6 and found.coverage["pile"].cells == 12


def test_only_what_must_be_found_counts_as_such(made, path):
    data, _ = made
    rewrite(path, change=lambda scene: replace(scene, occlusion=np.linspace(0, 1, len(scene.R))))
    found = summarise(data)
    # occlusions 0; 0, 1; 0, 0.5, 1
    assert found.splits["train"].to_find == 4 and found.coverage["pile"].instances == 4


def test_a_set_in_the_making_has_a_summary(tmp_path, tn34):
    found = summarise(data_set(tmp_path, tn34))
    split = found.splits["train"]
    assert (split.planned, split.missing, split.scenes, split.size, split.points) == (1, 1, 0, 0, (0, 0))
    assert found.coverage == {} and found.piles.missing == 1 and found.piles.planned == 1


@pytest.mark.parametrize("fault", ["header", "short", "settings", "nothing"])
def test_what_cannot_be_used_is_damaged(made, path, fault):
    data, _ = made
    if fault == "header":
        spoil(path, 0.01)
    elif fault == "short":
        path.write_bytes(path.read_bytes()[:-100])
    elif fault == "settings":
        rewrite(path, {"fingerprint": "other"})
    else:
        path.write_bytes(b"")
    split = summarise(data).splits["train"]
    assert (split.whole, split.damaged, split.missing, split.scenes) == (0, 1, 0, 0)
    assert split.size == path.stat().st_size
    assert whole_cycle(data, data.tasks[0]) is None


def test_a_cycle_without_scenes_counts_as_whole(made, path):
    data, _ = made
    header = CycleFile(path).header
    write_cycle(path, replace(header, drops=(), empty=3), [])
    split = summarise(data).splits["train"]
    assert (split.whole, split.scenes, split.empty, split.points) == (1, 0, 3, (0, 0))
    assert faults(data) == []


def test_piles_are_counted(made):
    data, _ = made
    assert summarise_piles(data).missing == 1
    path = put_piles(data, data.tasks[0])
    found = summarise_piles(data)
    assert (found.whole, found.missing, found.damaged, found.size) == (1, 0, 0, path.stat().st_size)
    put_piles(data, data.tasks[0], fingerprint="other")
    assert summarise_piles(data).damaged == 1


def test_a_whole_set_has_no_fault(made):
    data, _ = made
    put_piles(data, data.tasks[0])
    done = []
    found = verify(data, done.append)
    assert found.faults == [] and (found.files, found.scenes, found.piles) == (2, 3, 3)
    assert sum(done) == 2 and found.missing_piles == []
    assert found.size == sum(file.stat().st_size for file in data.root.rglob(f"*{SUFFIX}"))


def test_missing_scenes_are_a_fault_and_missing_piles_are_none(made, path):
    data, _ = made
    path.unlink()
    found = verify(data)
    assert [str(fault) for fault in found.faults] == [f"{path}: missing"]
    assert found.faults[0].kind == "missing" and found.missing_piles == list(data.tasks)


@pytest.mark.parametrize("place", [0.0, 0.01, 0.3, 0.6, 0.9, 0.999])
def test_every_turned_bit_is_found(made, path, place):
    data, _ = made
    spoil(path, place)
    ((kind, text),) = faults(data)
    assert kind == "damaged" and text.startswith(f"{path}: ") and "not a whole cycle file" in text


@pytest.mark.parametrize(
    ("header", "text"),
    [
        ({"split": "val"}, "its header says split val, its place train"),
        ({"kind": "clutter"}, "its header says kind clutter, its place pile"),
        ({"cycle": 7}, "its header says cycle 7, its place 0"),
        ({"part_index": 3}, "its header says part_index 3, its place 0"),
        ({"fingerprint": "other"}, "made with other settings than dataset.json says"),
        ({"part": "tn06"}, "shows tn06, not tn34"),
        ({"drops": (1, 2, 4)}, "holds scenes after [1, 2, 4] drops, which the protocol does not plan"),
        ({"empty": 1}, "holds 3 scenes and 1 were empty, expected 3"),
    ],
)
def test_a_header_that_does_not_fit_is_a_fault(made, path, header, text):
    data, _ = made
    rewrite(path, header)
    assert faults(data) == [("damaged", f"{path}: {text}")]


@pytest.mark.parametrize(
    ("name", "change", "text"),
    [
        ("points", lambda points: points * np.nan, "points is not finite (and 2 more)"),
        ("t", lambda t: t + np.inf, "t is not finite (and 2 more)"),
        ("instance", lambda instance: instance + 2, "points belong to bodies that are not there, it has 1"),
        ("instance", lambda instance: -1 - instance, "points belong to bodies that are not there, it has 1"),
        ("R", lambda R: -R, "R is no rotation (and 2 more)"),
        ("R", lambda R: 1.001 * R, "R is no rotation (and 2 more)"),
        ("occlusion", lambda occlusion: occlusion + 1.5, "occlusion is outside of 0 to 1 (and 2 more)"),
        ("parameters", lambda parameters: parameters + 1e-6, "parameters are not the part object's"),
    ],
)
def test_impossible_values_are_a_fault(made, path, name, change, text):
    data, _ = made
    rewrite(path, change=lambda scene: replace(scene, **{name: change(getattr(scene, name))}))
    ((kind, told),) = faults(data)
    assert kind == "damaged" and told.startswith(f"{path}: scene 001: {text}")


def test_the_number_of_points_is_the_protocols(made, path, tn34):
    assert faults(data_set(made[0].root, tn34, points=512)) == [
        ("damaged", f"{path}: has 256 points a scene, expected 512")
    ]


def test_files_of_a_newer_pnet_are_not_to_be_deleted(made, path):
    data, _ = made
    write_records(path, replace(SCENES, version=SCENES.version + 1), {}, [])
    ((kind, text),) = faults(data)
    assert kind == "lasting" and "written by a newer pnet" in text


def test_extra_files_are_named(made, path):
    data, _ = made
    extra = path.with_name(f"pile_0009_part_00{SUFFIX}")
    extra.write_bytes(b"whatever")
    hidden = path.with_name(f".{path.name}.here.1.part")
    hidden.write_bytes(b"")
    assert faults(data) == [("lasting", f"{extra}: not of this data set's plan; move it away")]
    assert summarise(data).splits["train"].extra == 1


def test_splits_that_share_a_cycle_are_found(made, path, tn34, tmp_path):
    data = data_set(tmp_path, tn34, VAL)
    (tmp_path / "val").mkdir()
    (task,) = (task for task in data.tasks if task.split == "val")
    copy = data.scene_path(task)
    shutil.copy(path, copy)
    told = dict.fromkeys(text for _, text in faults(data))
    assert any(text.startswith(f"{copy}: its header says split train, its place val") for text in told)
    # small splits are read first, so training's file is the second
    assert f"{path}: is the cycle of another split's file: {copy}" in told
    assert f"{path}: holds the poses of another split's file: {copy}" in told
    # under a header of its own the copied poses still give it away
    rewrite(copy, {"split": "val", "cycle": 1})
    assert faults(data) == [("lasting", f"{path}: holds the poses of another split's file: {copy}")]


def test_part_objects_of_the_test_that_training_saw_are_found(flange_set):
    data = flange_set
    (train,) = (data.scene_path(task) for task in data.tasks if task.split == "train")
    (test,) = (data.scene_path(task) for task in data.tasks if task.split == "test_g")
    assert faults(data) == [
        (
            "lasting",
            f"{test}: its part object (r = 18 mm, h = 16 mm) is one of training's: {train}",
        )
    ]


@pytest.fixture
def flange_set(tmp_path, write_split) -> DataSet:
    """A part whose two grids are the same, once to train on and once as if unseen."""
    part = TN34(learning={"r": [18], "h": [16]}, generalization={"r": [18], "h": [16]})
    write_split(tmp_path, part, "train", cycles=1)
    write_split(tmp_path, part, "test_g", cycles=1)
    data = data_set(tmp_path, part, TEST)
    (test,) = (data.scene_path(task) for task in data.tasks if task.split == "test_g")
    rewrite(test, change=lambda scene: replace(scene, t=scene.t + 0.01))
    return data


def test_a_manifest_of_another_plan_is_a_fault(made):
    data, _ = made
    ((kind, text),) = faults(replace(data, files={"train": 2}))
    assert kind == "lasting" and text.startswith(f"{data.root / 'dataset.json'}: speaks of")


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"grid": "G"}, "its header says grid G, its place L"),
        ({"fingerprint": "other"}, "made with other settings than dataset.json says"),
        ({"drops": (1, 2, 4)}, "holds piles of [1, 2, 4] drops, expected [1, 2, 3]"),
        ({"parameters": (0.01, 0.02)}, "has parameters that are not the part object's"),
        ({"parameters": (0.01,)}, "has parameters that are not the part object's"),
    ],
)
def test_piles_that_do_not_fit_are_a_fault(made, changes, text):
    data, _ = made
    path = put_piles(data, data.tasks[0], **changes)
    assert faults(data) == [("damaged", f"{path}: {text}")]


def test_damaged_piles_are_found(made):
    data, _ = made
    path = put_piles(data, data.tasks[0])
    spoil(path, 0.9)
    ((kind, text),) = faults(data)
    assert kind == "damaged" and text.startswith(f"{path}: not a whole pile file")


def test_one_file_can_be_checked(made):
    data, _ = made
    found = Verification()
    check_scenes(data, data.tasks[0], found)
    assert (found.files, found.scenes, found.faults) == (1, 3, [])
