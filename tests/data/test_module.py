"""The loaders: shapes, order, and settings that do not fit."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch

from pnet.data.augmentation import Augmentation
from pnet.data.module import SceneDataModule, Targets
from pnet.data.source import StoredData
from pnet.data.targets import pose_scale
from pnet.ops.pyramid import Ball, Pyramid
from pnet.parts.choice import KeypointRule
from pnet.parts.spread import spread_order
from pnet.records import SceneId
from pnet.scenes.store import CycleHeader, write_cycle


@pytest.fixture(scope="module")
def root(tmp_path_factory, tn06, write_split):
    root = tmp_path_factory.mktemp("data")
    for split in ("train", "val"):
        write_split(root, tn06, split)
    return root


def module(root, part, **changes):
    settings = dict(points=None, batch_size=4, draws=None, val_every=1, workers=0, seed=0)
    return SceneDataModule(part, StoredData(root), Targets(), Augmentation(), **{**settings, **changes})


def order(data, epochs):
    loader = data.train_dataloader()
    found = []
    for epoch in epochs:
        loader.sampler.set_epoch(epoch)
        found += [(batch.scene.tolist(), batch.points) for batch in loader]
    return found


def test_shapes_of_a_batch(root, tn06):
    batch = next(iter(module(root, tn06, points=100).train_dataloader()))
    assert batch.tables is None and batch.rotation is None and batch.scale is None
    shapes = {name: tuple(value.shape) for name, value in vars(batch).items() if value is not None}
    assert shapes == {
        "points": (4, 100, 3),
        "centroid": (4, 100, 3),
        "keypoints": (4, 100, 3, 3),
        "margin": (4, 100, 3),
        "parameters": (4, 100, 3),
        "visibility": (4, 100),
        "scene": (4,),
    }


@pytest.mark.parametrize("workers", [0, 1])
def test_the_loader_finds_the_tables_of_the_points_as_augmented(root, tn06, workers):
    pyramid = Pyramid([30, 8], [[Ball(0.01, 6)], [Ball(0.02, 4), Ball(0.04, 4)]], [0.01])
    data = module(root, tn06, points=100, workers=workers, tables=pyramid)
    for batch in (next(iter(data.train_dataloader())), next(iter(data.val_dataloader()))):
        expected = pyramid(batch.points)
        assert batch.tables.keys() == expected.keys() and len(expected) == 8
        for name, table in expected.items():
            assert torch.equal(batch.tables[name], table), name


def test_training_drops_the_rest_and_validation_does_not(root, tn06):
    data = module(root, tn06)
    assert [len(batch.points) for batch in data.train_dataloader()] == [4]
    assert [batch.scene.tolist() for batch in data.val_dataloader()] == [[0, 1, 2, 3], [4, 5]]


def test_validation_is_not_augmented(root, tn06):
    data = module(root, tn06)
    batch = next(iter(data.val_dataloader()))
    assert torch.equal(batch.points[2], torch.from_numpy(data.scenes("val")[2].points))


def test_val_every_thins_validation(root, tn06):
    assert [len(b.points) for b in module(root, tn06, val_every=3).val_dataloader()] == [2]


def test_draws_make_an_epoch_longer_than_the_data(root, tn06):
    assert len(module(root, tn06, draws=20).train_dataloader()) == 5


def same(first, second):
    return [a == b and torch.equal(p, q) for (a, p), (b, q) in zip(first, second, strict=True)]


def test_the_order_is_that_of_the_seed_also_from_a_later_epoch(root, tn06):
    first = order(module(root, tn06, draws=8), [0, 1])
    assert all(same(first, order(module(root, tn06, draws=8), [0, 1])))
    assert all(same(first[2:], order(module(root, tn06, draws=8), [1])))
    assert not all(same(first, order(module(root, tn06, draws=8, seed=1), [0, 1])))


def test_workers_do_not_change_it(root, tn06):
    first = order(module(root, tn06, draws=8), [0, 1])
    assert all(same(first, order(module(root, tn06, draws=8, workers=2), [0, 1])))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"batch_size": 7}, r"data\.batch_size is 7, but an epoch has only 6 scenes"),
        ({"batch_size": 7, "draws": 5}, r"an epoch has only 5 scenes"),
        ({"batch_size": 0}, r"data\.batch_size is 0, expected at least 1"),
        *(
            ({"learn": share}, rf"data\.learn is {share:g}, expected a share in \(0, 1\], for instance 1/3")
            for share in (0.0, -0.2, 1.01, 15.0, float("nan"))
        ),
        ({"points": 300}, r"data\.points is 300, the stored scenes have 256"),
    ],
)
def test_settings_that_do_not_fit_are_named(root, tn06, changes, message):
    with pytest.raises(ValueError, match=message):
        module(root, tn06, **changes).train_dataloader()


def test_a_missing_split_is_named(root, tn06):
    with pytest.raises(FileNotFoundError, match="test_g: no scenes there"):
        module(root, tn06).scenes("test_g")


def test_targets_say_which_rule():
    assert Targets().choice.rule is KeypointRule.CAMERA
    assert Targets().choice.direction == (0, 0, 1)
    assert Targets(rule="canonical").choice.rule is KeypointRule.CANONICAL
    assert Targets(rule="point").choice.rule is KeypointRule.POINT
    assert Targets(direction=[0, 1, 0]).choice.direction == (0, 1, 0)


@pytest.mark.parametrize("rule", ["gu", "", "CAMERA", True])
def test_an_unknown_rule_is_named_with_the_known_ones(rule):
    with pytest.raises(
        ValueError, match=rf"data\.targets\.rule is {rule!r}, choose camera, canonical, point"
    ):
        Targets(rule=rule).choice  # noqa: B018


def test_the_loaders_labels_follow_the_rule(root, tn06):
    """Under `point` labels differ between points of one body, under the other rules they do not."""
    for rule, differ in (("camera", False), ("canonical", False), ("point", True)):
        data = module(root, tn06, batch_size=1)
        data.targets = Targets(rule=rule)
        batch = next(iter(data.val_dataloader()))  # one body
        faces = batch.keypoints[0, :, 0]
        spread = (faces - faces[0]).norm(dim=-1).max()
        height = batch.parameters[0, 0, 1]
        assert float(spread) == pytest.approx(float(height) if differ else 0, abs=1e-7)
        assert bool(batch.margin.isinf().all()) == (rule == "canonical")


@pytest.mark.parametrize("direction", [[0, 0, 0], [1, 0], [0, 0, 1, 0]])
def test_a_direction_must_be_three_numbers(direction):
    with pytest.raises(ValueError, match=r"targets\.direction"):
        Targets(direction=direction).choice  # noqa: B018


def test_poses_are_labelled_where_a_method_asks(root, tn06):
    for split in ("train", "val"):
        data = module(root, tn06, points=50)
        data.targets = Targets(poses=True)
        batch = next(iter(data.train_dataloader() if split == "train" else data.val_dataloader()))
        assert batch.rotation.shape == (4, 50, 3, 3) and batch.scale.shape == (4, 3, 3)
        scenes = data.scenes(split)
        for scale, index in zip(batch.scale, batch.scene.tolist(), strict=True):
            expected = pose_scale(tn06, scenes[index].parameters[0])
            torch.testing.assert_close(scale.double(), expected, rtol=1e-5, atol=1e-9)
    first, instance = scenes[0], torch.from_numpy(scenes[0].instance[:50])
    torch.testing.assert_close(batch.rotation[0], torch.from_numpy(first.R).float()[instance])


@pytest.fixture(scope="module")
def many(tmp_path_factory, tn34, make_scene):
    """Every part object of the flange once in each split, one scene each."""
    root = tmp_path_factory.mktemp("many")
    for cycle, split in enumerate(("train", "val", "test_l")):
        (root / split).mkdir()
        for place in range(16):
            scene = replace(make_scene(tn34, 1, 16), id=SceneId(split, "pile", cycle, place, 1))
            header = CycleHeader("tiny", "tn34", scene.camera, split, "pile", cycle, place, (1,))
            write_cycle(root / split / f"{scene.id.file_stem}.safetensors", header, [scene])
    return root


def learnt(root, part, share) -> set[int]:
    return {i.part_index for i in module(root, part, learn=share).train_scenes().ids}


@pytest.mark.parametrize(
    ("share", "count"), [(1.0, 16), (0.9, 14), (0.5, 8), (1 / 3, 5), (0.25, 4), (0.2, 3), (0.1, 2), (1e-9, 1)]
)
def test_so_many_of_the_part_objects_are_learnt(many, tn34, share, count):
    assert learnt(many, tn34, share) == set(spread_order(tn34.grids["L"])[:count])


def test_a_smaller_share_is_part_of_a_larger_one(many, tn34):
    row = [learnt(many, tn34, share) for share in (0.05, 0.2, 1 / 3, 0.5, 0.8, 1.0)]
    assert all(small < large for small, large in pairwise(row))


def test_the_learnt_objects_are_spread(many, tn34):
    """A quarter of sixteen: each radius and each height once."""
    objects = tn34.grids["L"][sorted(learnt(many, tn34, 0.25))]
    assert [len(set(column)) for column in objects.T] == [4, 4]


def test_a_share_is_one_of_the_objects_that_are_there(many, tn34, tmp_path):
    """Of the five of a smaller protocol, in the order of the whole grid."""
    (tmp_path / "train").mkdir()
    there = [2, 7, 9, 11, 14]
    for place in there:
        name = f"pile_0000_part_{place:02d}.safetensors"
        (tmp_path / "train" / name).write_bytes((many / "train" / name).read_bytes())
    ordered = [place for place in spread_order(tn34.grids["L"]) if place in there]
    for share, count in ((1.0, 5), (0.6, 3), (1 / 3, 2), (0.2, 1), (0.01, 1)):
        assert learnt(tmp_path, tn34, share) == set(ordered[:count])


def test_only_training_learns_less(many, tn34):
    data = module(many, tn34, learn=1 / 3, batch_size=1)
    assert len(data.train_dataloader()) == len(data.train_scenes()) == 5
    assert len(data.val_dataloader()) == len(data.test_dataloader()) == 16
    assert len(data.scenes("train")) == 16


def test_a_batch_that_the_learnt_scenes_do_not_fill_is_refused(many, tn34):
    with pytest.raises(ValueError, match=r"data\.batch_size is 6, but an epoch has only 5 scenes"):
        module(many, tn34, learn=1 / 3, batch_size=6).train_dataloader()


def test_processes_that_train_together_share_an_epoch(many, tn34):
    """Two processes with eight draws: the sixteen scenes, none twice."""

    def order_of(rank, world):
        data = module(many, tn34, draws=8)
        data.trainer = SimpleNamespace(global_rank=rank, world_size=world)
        return [index for batch in data.train_dataloader() for index in batch.scene.tolist()]

    each = [order_of(rank, 2) for rank in (0, 1)]
    assert [len(part) for part in each] == [8, 8]
    assert sorted(each[0] + each[1]) == list(range(16))
    alone = [i for batch in module(many, tn34, draws=8).train_dataloader() for i in batch.scene.tolist()]
    assert order_of(0, 1) == alone == [i for pair in zip(*each, strict=True) for i in pair][:8]
