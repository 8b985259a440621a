"""Table I as tasks, and what a plan may not say."""

from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf
from tests.conftest import load_part

from pnet.cli.instantiate import instantiate
from pnet.parts.base import ParametricPart
from pnet.parts.spread import spread_order
from pnet.records import SceneId
from pnet.scenes.protocol import CycleTask, Protocol, SplitPlan

CONF = Path(__file__).parents[2] / "conf" / "protocol"
PROTOCOLS = sorted(path.stem for path in CONF.glob("*.yaml"))
PARTS = sorted(path.stem for path in (CONF.parent / "part").glob("*.yaml"))
TASK = CycleTask("train", "pile", "L", 3, 5)


def protocol(drop_limit=3, drop_step=1, points=16, **splits) -> Protocol:
    return Protocol("mine", drop_limit, points, splits, drop_step)


def config(name: str) -> Protocol:
    return instantiate(OmegaConf.load(CONF / f"{name}.yaml"))


@pytest.mark.parametrize(
    ("part", "drop_limit"), [("candlestick", 60), ("gear", 60), ("tless20", 99), ("tless29", 79)]
)
def test_the_paper_has_sileanes_own_numbers(part, drop_limit):
    """Table I: 500 cycles to learn from (one of them for validation), two to test, no G."""
    plan = config("paper").for_part(part)
    assert plan.drop_limit == plan.scene_drops()[-1] == drop_limit and plan.points == 16_384
    cycles = {split: (p.first_cycle, p.cycles) for split, p in plan.splits.items()}
    assert cycles == {"train": (0, 499), "val": (499, 1), "test_l": (500, 2)}
    assert len(plan.tasks({"L": [0]})) == 502


def test_what_cannot_differ_by_part_is_named():
    with pytest.raises(ValueError, match=r"protocol x, by_part\.tn34: points cannot differ by part"):
        Protocol("x", 3, 10, {}, by_part={"tn34": {"points": 3}})


def test_a_part_without_numbers_of_its_own_has_the_plans():
    plan = config("paper")
    assert plan.for_part("tn06") is plan and plan.for_part("tn06").drop_limit == 60


def test_the_real_world_has_60_part_objects_to_learn_and_4_unseen():
    """Section III.C: 28,800 scenes and 1,920."""
    plan = config("real_world")
    tasks = plan.tasks({"L": range(64), "G": range(64)})
    scenes = {split: 16 * sum(task.split == split for task in tasks) for split in plan.splits}
    assert scenes == {"train": 29 * 60 * 16, "val": 60 * 16, "test_g": 1920}
    assert scenes["train"] + scenes["val"] == 28_800
    assert plan.scene_drops() == list(range(1, 17))


@pytest.mark.parametrize("objects", [64, 16])
def test_the_paper_has_29_cycles_to_learn_from_and_one_for_each_test(objects):
    """Table I: 64 part objects of TN06, 16 of TN34, 60 drops, 29 + 1 + 1 cycles."""
    plan = config("paper")
    tasks = plan.tasks({"L": range(objects), "G": range(objects)})
    counts = {split: sum(t.split == split for t in tasks) for split in plan.splits}
    assert counts["train"] + counts["val"] == 29 * objects
    assert counts["test_l"] == counts["test_g"] == objects
    assert plan.scene_drops() == list(range(1, 61)) and plan.points == 16_384
    assert {t.grid for t in tasks if t.split == "test_g"} == {"G"}
    assert {t.kind for t in tasks} == {"pile"}


def test_the_parametric_data_set_has_386_880_scenes():
    """Three templates of 64 part objects and one of 16, 31 cycles, 60 drops each."""
    plan = config("paper")
    cycles = sum(len(plan.tasks({"L": range(n), "G": range(n)})) for n in (64, 64, 64, 16))
    assert cycles * len(plan.scene_drops()) == 386_880


def test_a_split_of_some_objects_makes_those():
    tasks = protocol(train=SplitPlan("L", cycles=2, objects=[0, 5])).tasks({"L": range(64)})
    assert [(t.cycle, t.part_index) for t in tasks] == [(0, 0), (0, 5), (1, 0), (1, 5)]


def test_small_splits_come_first():
    plan = protocol(
        train=SplitPlan("L", cycles=1), val=SplitPlan("L", cycles=1, first_cycle=1), test_g=SplitPlan("G", 1)
    )
    assert [t.split for t in plan.tasks({"L": range(1), "G": range(1)})] == ["val", "test_g", "train"]


def test_no_two_tasks_are_one_file():
    plan = protocol(train=SplitPlan("L", cycles=3, clutter=0.5), val=SplitPlan("L", 1, first_cycle=3))
    names = [(t.split, t.scene_id(0).file_stem) for t in plan.tasks({"L": range(4)})]
    assert len(set(names)) == len(names) == 3 * 4 * 2 + 4


@pytest.mark.parametrize(
    ("cycles", "share", "clutter"), [(18, 0.63, 31), (1, 0.5, 1), (10, 0.0, 0), (3, 0.75, 9), (28, 0.2, 7)]
)
def test_clutter_is_that_share_of_all_cycles(cycles, share, clutter):
    plan = SplitPlan("L", cycles, clutter=share)
    assert plan.clutter_cycles == clutter
    assert clutter / (clutter + cycles) == pytest.approx(share, abs=0.01)


@pytest.mark.parametrize(
    ("limit", "step", "drops"),
    [
        (6, 1, [1, 2, 3, 4, 5, 6]),
        (6, 4, [2, 6]),
        (7, 3, [1, 4, 7]),
        (5, 5, [5]),
        (5, 9, [5]),
        (1, 1, [1]),
    ],
)
def test_the_full_bin_is_always_a_scene(limit, step, drops):
    assert protocol(limit, step).scene_drops() == drops


def test_the_same_task_draws_the_same_numbers():
    first, again = (TASK.rng(0, "tn34").random(4) for _ in range(2))
    np.testing.assert_array_equal(first, again)


@pytest.mark.parametrize(
    "other",
    [
        CycleTask("train", "clutter", "L", 3, 5),
        CycleTask("train", "pile", "G", 3, 5),
        CycleTask("train", "pile", "L", 4, 5),
        CycleTask("train", "pile", "L", 3, 6),
        CycleTask("val", "pile", "L", 5, 3),
    ],
)
def test_another_task_draws_other_numbers(other):
    assert TASK.rng(0, "tn34").random() != other.rng(0, "tn34").random()


def test_another_seed_or_part_draws_other_numbers():
    numbers = {TASK.rng(seed, part).random() for seed in (0, 1) for part in ("tn34", "tn06")}
    assert len(numbers) == 4


def test_a_view_draws_other_numbers_than_the_pile_and_than_other_views():
    numbers = {TASK.rng(0, "tn34", *more).random() for more in ((), *((drop,) for drop in range(61)))}
    assert len(numbers) == 62


def planned(name: str, part: ParametricPart) -> list[CycleTask]:
    return config(name).tasks({which: spread_order(grid) for which, grid in part.grids.items()})


@pytest.mark.parametrize("part", PARTS)
def test_no_two_tasks_of_any_split_draw_the_same_numbers(part):
    """So no scene of one split is a scene of another, whatever the shipped protocol."""
    template = load_part(part)
    for name in PROTOCOLS:
        tasks = planned(name, template)
        numbers = {task.rng(0, template.name).random() for task in tasks}
        assert len(numbers) == len(tasks) > 0, name
        places = {(task.grid, task.kind, task.cycle, task.part_index) for task in tasks}
        assert len(places) == len(tasks), name


def test_no_two_scenes_of_a_data_set_draw_the_same_numbers(tn34):
    """Views and noise, beside the piles' own numbers."""
    tasks, drops = planned("small", tn34), config("small").scene_drops()
    keys = [(task, more) for task in tasks for more in ((), *((drop,) for drop in drops))]
    assert len({task.rng(0, "tn34", *more).random() for task, more in keys}) == len(tasks) * 31


@pytest.mark.parametrize("part", PARTS)
def test_no_part_object_of_test_g_is_one_that_training_may_see(part):
    template = load_part(part)
    for name in PROTOCOLS:
        tested = {task.part_index for task in planned(name, template) if task.grid == "G"}
        learnt = template.grids["L"]
        for index in tested:
            gap = np.abs(learnt - template.part_object("G", index)).max(1).min()
            assert gap > 1e-5, (name, index)  # metres; a hundredth of a millimetre is another object


def test_only_test_g_uses_the_other_grid():
    for name in PROTOCOLS:
        assert all((plan.grid == "G") == (split == "test_g") for split, plan in config(name).splits.items())


@pytest.mark.parametrize("name", PROTOCOLS)
def test_a_shipped_protocol_says_how_bodies_are_dropped(name):
    assert config(name).dropping == "one_by_one"
    assert config(name).name == name


@pytest.mark.parametrize("dropping", ["one_by_one", "anew"])
def test_both_ways_of_dropping_are_taken(dropping):
    assert Protocol("mine", 3, 16, {}, dropping=dropping).dropping == dropping


@pytest.mark.parametrize("dropping", ["", "Anew", "one by one", None])
def test_another_way_of_dropping_is_refused(dropping):
    with pytest.raises(
        ValueError, match=f"protocol mine: dropping is {dropping!r}, choose one_by_one or anew"
    ):
        Protocol("mine", 3, 16, {}, dropping=dropping)


def test_the_way_of_dropping_changes_no_task():
    splits = {"train": SplitPlan("L", 2, clutter=0.5)}
    first, second = (Protocol("mine", 3, 16, splits, dropping=way) for way in ("one_by_one", "anew"))
    assert first.tasks({"L": range(3)}) == second.tasks({"L": range(3)})
    assert first.scene_drops() == second.scene_drops() == [1, 2, 3]


def test_a_task_names_its_scenes():
    assert TASK.scene_id(7) == SceneId("train", "pile", 3, 5, 7)


def test_splits_that_share_a_cycle_are_refused():
    with pytest.raises(ValueError, match="protocol mine: splits train and val share cycle 4 of grid L"):
        protocol(train=SplitPlan("L", cycles=5), val=SplitPlan("L", cycles=1, first_cycle=4))


def test_splits_of_different_grids_may_share_a_cycle():
    protocol(test_l=SplitPlan("L", cycles=1), test_g=SplitPlan("G", cycles=1))


def test_clutter_outside_training_is_refused():
    with pytest.raises(ValueError, match="protocol mine, split val: clutter belongs in training only"):
        protocol(val=SplitPlan("L", cycles=1, clutter=0.5))


@pytest.mark.parametrize(
    ("splits", "message"),
    [
        ({"test": SplitPlan("L", 1)}, "split test: no such split, choose from train, val, test_l, test_g"),
        ({"train": SplitPlan("X", 1)}, "split train: grid is 'X', choose L or G"),
        ({"train": SplitPlan("L", 0)}, "split train: cycles is 0, expected at least 1"),
        (
            {"train": SplitPlan("L", 1, clutter=1.0)},
            r"split train: clutter is 1.0, expected a share in \[0, 1\)",
        ),
        ({"train": SplitPlan("L", 1, clutter=-0.1)}, "split train: clutter is -0.1"),
        ({"train": SplitPlan("L", 1, count=0)}, "split train: count is 0, expected at least 1"),
        (
            {"val": SplitPlan("L", 1, count=2, objects=[0])},
            "split val: count is 2, expected at least 1, and no objects beside it",
        ),
    ],
)
def test_a_split_that_makes_no_sense_is_named(splits, message):
    with pytest.raises(ValueError, match=f"protocol mine, {message}"):
        protocol(**splits)


@pytest.mark.parametrize(("limit", "step", "points"), [(0, 1, 1), (1, 0, 1), (1, 1, 0)])
def test_counts_below_one_are_refused(limit, step, points):
    with pytest.raises(ValueError, match=f"at least 1, got {limit}, {step}, {points}"):
        protocol(limit, step, points)


@pytest.mark.parametrize(("size", "places"), [(16, [0, 11]), (64, [0, 44]), (1, [0])])
def test_a_share_of_a_grid_is_a_place_in_it(size, places):
    tasks = protocol(train=SplitPlan("L", cycles=1, objects=[0, 0.7])).tasks({"L": range(size)})
    assert [task.part_index for task in tasks] == places


def test_a_part_without_a_generalization_grid_has_no_split_of_it():
    plan = protocol(train=SplitPlan("L", cycles=1), test_g=SplitPlan("G", cycles=1))
    assert {task.split for task in plan.tasks({"L": range(2)})} == {"train"}
    assert {task.split for task in plan.tasks({"L": range(2), "G": range(2)})} == {"train", "test_g"}


def objects_of(plan: Protocol, split: str, orders) -> list[int]:
    return sorted({task.part_index for task in plan.tasks(orders) if task.split == split})


ORDER = [3, 0, 6, 5, 1, 4, 2, 7]


@pytest.mark.parametrize(
    ("count", "objects"),
    [(1, [3]), (3, [0, 3, 6]), (8, list(range(8))), (9, list(range(8))), (500, list(range(8)))],
)
def test_a_count_takes_so_many_objects_from_the_beginning_of_the_order(count, objects):
    plan = protocol(train=SplitPlan("L", cycles=2, count=count, clutter=0.5))
    tasks = plan.tasks({"L": ORDER})
    assert len(tasks) == 4 * len(objects)
    for kind in ("pile", "clutter"):
        places = [(t.cycle, t.part_index) for t in tasks if t.kind == kind]
        assert places == [(cycle, index) for cycle in (0, 1) for index in objects]


def test_a_smaller_count_takes_some_of_a_larger_ones():
    plan = protocol(
        train=SplitPlan("L", 1, count=5), val=SplitPlan("L", 1, 1, count=2), test_l=SplitPlan("L", 1, 2)
    )
    assert objects_of(plan, "val", {"L": ORDER}) == [0, 3]
    assert objects_of(plan, "train", {"L": ORDER}) == [0, 1, 3, 5, 6]
    assert objects_of(plan, "test_l", {"L": ORDER}) == list(range(8))


def test_places_are_those_of_the_grid_whatever_the_order():
    plan = protocol(train=SplitPlan("L", 1, objects=[0, 0.7]), val=SplitPlan("L", 1, 1))
    assert objects_of(plan, "train", {"L": ORDER}) == [0, 5]
    assert objects_of(plan, "val", {"L": ORDER}) == list(range(8))


@pytest.mark.parametrize("name", ["tn06", "tn16", "tn34", "tn42"])
def test_small_learns_eight_objects_in_four_cycles_and_tests_on_them(name):
    part, plan = load_part(name), config("small")
    orders = {which: spread_order(grid) for which, grid in part.grids.items()}
    trained = objects_of(plan, "train", orders)
    assert len(trained) == 8 and objects_of(plan, "test_l", orders) == trained
    for column in part.grids["L"][trained].T:
        assert np.unique(column, return_counts=True)[1].tolist() == [2, 2, 2, 2]
    assert len(objects_of(plan, "val", orders)) == 4 and set(objects_of(plan, "val", orders)) <= set(trained)
    for column in part.grids["L"][objects_of(plan, "val", orders)].T:
        assert len(np.unique(column)) == 4
    assert objects_of(plan, "test_g", orders) == trained  # the same places of the other grid
    tasks = plan.tasks(orders)
    numbers = {(split, kind): 0 for split in plan.splits for kind in ("pile", "clutter")}
    for task in tasks:
        numbers[task.split, task.kind] += 1
    assert numbers == {
        ("train", "pile"): 32,
        ("train", "clutter"): 32,
        ("val", "pile"): 4,
        ("val", "clutter"): 0,
        ("test_l", "pile"): 8,
        ("test_l", "clutter"): 0,
        ("test_g", "pile"): 8,
        ("test_g", "clutter"): 0,
    }


def test_smalls_splits_share_no_cycle_of_a_part_object():
    part, plan = load_part("tn34"), config("small")
    tasks = plan.tasks({which: spread_order(grid) for which, grid in part.grids.items()})
    made = [(task.grid, task.kind, task.cycle, task.part_index) for task in tasks]
    assert len(set(made)) == len(made) == 84
    assert {task.grid for task in tasks if task.split == "test_g"} == {"G"}
    assert {task.grid for task in tasks if task.split != "test_g"} == {"L"}
    assert plan.scene_drops() == list(range(1, 31)) and plan.points == 4096


def test_small_makes_do_with_fewer_objects():
    tasks = config("small").tasks({"L": [0]})
    assert {(task.split, task.part_index) for task in tasks} == {("train", 0), ("val", 0), ("test_l", 0)}
    assert len(tasks) == 8 + 1 + 1
