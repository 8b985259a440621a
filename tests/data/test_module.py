"""The loaders: shapes, order, and settings that do not fit."""

import pytest
import torch

from pnet.data.augmentation import Augmentation
from pnet.data.module import SceneDataModule, Targets
from pnet.ops.pyramid import Ball, Pyramid
from pnet.parts.choice import KeypointRule


@pytest.fixture(scope="module")
def root(tmp_path_factory, tn06, write_split):
    root = tmp_path_factory.mktemp("data")
    for split in ("train", "val"):
        write_split(root, tn06, split)
    return root


def module(root, part, **changes):
    settings = dict(points=None, batch_size=4, draws=None, val_every=1, workers=0, seed=0)
    return SceneDataModule(part, root, Targets(), Augmentation(), **{**settings, **changes})


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
    data = module(root, tn06, points=100, workers=workers, pyramid=pyramid)
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
