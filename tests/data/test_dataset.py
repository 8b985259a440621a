"""Labelled scenes are pure functions; the order of training is fair."""

from collections import Counter

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pnet.data.augmentation import Augmentation
from pnet.data.dataset import Collate, EpochSampler, LabelledScenes, first_points
from pnet.data.scene_folder import SceneFolder
from pnet.data.scene_order import Permutations
from pnet.data.targets import point_labels
from pnet.parts.choice import KeypointChoice

CHOICE = KeypointChoice()


def row_of(size: int, seed: int, draws: int | None = None, rank: int = 0, world: int = 1) -> EpochSampler:
    return EpochSampler(Permutations(range(size), seed), draws, rank, world)


def epoch(sampler: EpochSampler, number: int) -> list[int]:
    sampler.set_epoch(number)
    draws = list(sampler)
    places = [place for _, place in draws]
    assert len(set(places)) == len(places)  # chance depends on them
    return [index for index, _ in draws]


@given(size=st.integers(1, 12), draws=st.integers(1, 30), seed=st.integers(0, 5))
def test_epochs_cut_an_endless_row_of_permutations(size, draws, seed):
    sampler = row_of(size, seed, draws)
    row = [index for number in range(6) for index in epoch(sampler, number)]
    assert len(row) == 6 * draws and len(sampler) == draws
    for start in range(0, len(row) - size + 1, size):
        assert sorted(row[start : start + size]) == list(range(size))
    counts = Counter(row)
    assert max(counts.values()) - min(counts[i] for i in range(size)) <= 1


def test_an_epoch_is_a_pure_function_of_seed_and_number():
    first, again = row_of(50, 3, 20), row_of(50, 3, 20)
    epoch(first, 0)
    epoch(first, 1)
    assert epoch(first, 7) == epoch(again, 7)
    assert epoch(again, 7) != epoch(again, 8)
    assert epoch(row_of(50, 4, 20), 7) != epoch(again, 7)


def test_without_draws_each_scene_comes_once():
    sampler = row_of(9, 0)
    assert sorted(epoch(sampler, 4)) == list(range(9)) and len(sampler) == 9


@pytest.fixture(scope="module")
def folder(tmp_path_factory, tn34, write_split):
    root = tmp_path_factory.mktemp("data")
    write_split(root, tn34, "train")
    return SceneFolder(root, "train", "tn34")


def test_an_item_depends_on_seed_epoch_and_index_only(folder, tn34):
    def dataset(seed):
        return LabelledScenes(folder, tn34.chain, CHOICE, 64, Augmentation(True, 0.001), seed)

    first, again = dataset(1), dataset(1)
    for draw in [(0, 0), (5, 3), (2, 3)]:
        first[draw]  # reading in between must not matter
    item, same = first[(4, 2)], again[(4, 2)]
    assert all(torch.equal(item[name], same[name]) for name in item)
    for other in (again[(4, 3)], again[(3, 2)], dataset(2)[(4, 2)]):
        assert not torch.equal(item["points"], other["points"])


def test_without_augmentation_items_are_the_stored_scenes(folder, tn34):
    dataset = LabelledScenes(folder, tn34.chain, CHOICE)
    expected = point_labels(folder[3], tn34.chain, CHOICE)
    assert len(dataset) == 6 and int(dataset[3]["scene"]) == 3
    for draw in (3, (3, 9)):
        assert all(torch.equal(dataset[draw][name], value) for name, value in expected.items())


def test_points_are_a_prefix(folder, tn34):
    item = LabelledScenes(folder, tn34.chain, CHOICE, points=10)[2]
    assert torch.equal(item["points"], torch.from_numpy(folder[2].points[:10]))
    assert item["keypoints"].shape == (10, 3, 3)
    assert first_points(folder[2], None).points.shape == (256, 3)


def test_more_points_than_stored_are_refused(folder, tn34):
    with pytest.raises(ValueError, match=r"data\.points is 257, the stored scenes have 256"):
        LabelledScenes(folder, tn34.chain, CHOICE, points=257)


def test_collate_stacks(folder, tn34):
    dataset = LabelledScenes(folder, tn34.chain, CHOICE, points=10)
    batch = Collate()([dataset[1], dataset[4]])
    assert batch.points.shape == (2, 10, 3) and batch.keypoints.shape == (2, 10, 3, 3)
    assert batch.scene.tolist() == [1, 4]
    assert torch.equal(batch.centroid[1], dataset[4]["centroid"])
    assert batch.margin.shape == (2, 10, 3)
    assert torch.equal(batch.margin[0], dataset[1]["margin"])


def parts_of_an_epoch(size: int, seed: int, draws: int, world: int, number: int) -> list[list[int]]:
    return [epoch(row_of(size, seed, draws, rank, world), number) for rank in range(world)]


@given(
    size=st.integers(1, 12),
    seed=st.integers(0, 5),
    draws=st.integers(1, 20),
    world=st.integers(1, 5),
    number=st.integers(0, 4),
)
def test_processes_together_see_what_one_would(size, seed, draws, world, number):
    """Taken in turn they make the row of a single process whose epochs are `world` times as long."""
    each = parts_of_an_epoch(size, seed, draws, world, number)
    assert [len(part) for part in each] == [draws] * world
    assert [len(row_of(size, seed, draws, rank, world)) for rank in range(world)] == [draws] * world
    together = [index for position in zip(*each, strict=True) for index in position]
    assert together == epoch(row_of(size, seed, world * draws), number)


@given(size=st.integers(2, 12), seed=st.integers(0, 5), world=st.integers(2, 5))
def test_no_scene_comes_to_two_processes_in_one_turn(size, seed, world):
    """Epochs that end with a permutation: each scene once in each."""
    each = [
        epoch(row_of(size * world, seed, size, rank, world), number)
        for number in range(2)
        for rank in range(world)
    ]
    for number in (0, 1):
        seen = [index for part in each[number * world : (number + 1) * world] for index in part]
        assert sorted(seen) == list(range(size * world))


@given(size=st.integers(1, 12), seed=st.integers(0, 5), draws=st.none() | st.integers(1, 20))
def test_one_process_alone_is_the_default(size, seed, draws):
    for number in (0, 3):
        assert epoch(row_of(size, seed, draws, 0, 1), number) == epoch(row_of(size, seed, draws), number)


def test_without_draws_each_process_takes_as_many_as_there_are_scenes():
    each = [epoch(row_of(5, 0, None, rank, 3), 1) for rank in range(3)]
    assert [len(part) for part in each] == [5, 5, 5]
    assert Counter(index for part in each for index in part) == dict.fromkeys(range(5), 3)


def test_the_draws_of_all_processes_and_epochs_say_different_places():
    """So that view, noise and augmentation never repeat, however often a scene comes."""
    places = []
    for number in range(3):
        for rank in range(2):
            sampler = row_of(6, 0, 8, rank, 2)
            sampler.set_epoch(number)
            places += [place for _, place in sampler]
    assert sorted(places) == list(range(48))


def test_the_order_of_one_process_is_as_it_was():
    """What trainings of before repeat: seed 3, epochs of five out of seven scenes."""
    row = [int(i) for turn in range(3) for i in np.random.default_rng([3, turn]).permutation(7)]
    sampler = row_of(7, 3, 5)
    assert [epoch(sampler, number) for number in range(4)] == [row[5 * n : 5 * n + 5] for n in range(4)]
