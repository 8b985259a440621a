"""What a card says of the training's scenes."""

import pytest

from pnet.reporting.card_data import (
    data_rows,
    field_text,
    learnt_sizes,
    noise_text,
    plan_of,
    scene_counts,
    view_text,
)

NO_NOISE = {"_target_": "pnet.scenes.noise.NoNoise"}
GAUSSIAN = {"_target_": "pnet.scenes.noise.GaussianNoise", "sigma": 0.0005}
ANEW = {"_target_": "pnet.data.views.RandomViews", "distance": [0.6, 0.7], "tilt": [0, 15], "turn": True}
ABOVE = {"distance": [0.65, 0.65], "tilt": [0, 0], "turn": False}
CAMERA = {"width": 100, "height": 50, "fx": 200.0, "fy": 100.0, "cx": 49.5, "cy": 24.5}


def planned(**plan):
    return {"data": {"protocol": plan}}


@pytest.mark.parametrize(
    ("train", "share", "count"),
    [
        ({}, 1, 16),
        ({"count": 8}, 1, 8),
        ({"count": 99}, 1, 16),
        ({"objects": [0, 5, 0.5]}, 1, 3),
        ({"objects": [0, 0.0, 0.01]}, 1, 1),
        ({"count": 8}, "1/3", 3),
        ({"count": 2}, 0.1, 1),
    ],
)
def test_the_learnt_part_objects_are_counted_as_training_chooses_them(train, share, count):
    about = {**planned(splits={"train": train}), "training": {"data.learn": share}}
    assert (
        learnt_sizes(about, "tn34", 16) == f"Of the 16 part objects in grid L {count} were in the training."
    )


def test_one_size_or_no_plan_has_no_words():
    assert learnt_sizes(planned(splits={"train": {}}), "tn34", 1) == ""
    assert learnt_sizes({}, "tn34", 16) == ""


def test_a_part_may_have_a_plan_of_its_own():
    plan = {"drop_limit": 60, "splits": {"train": {}}, "by_part": {"gear": {"drop_limit": 19}}}
    about = planned(**plan)
    about["data"]["files"] = {"val": 1, "train": 10}
    assert plan_of(about, "gear") == {"drop_limit": 19, "splits": {"train": {}}}
    assert scene_counts(about, "gear") == {"train": 190, "val": 19}
    assert scene_counts(about, "tn34") == {"train": 600, "val": 60}
    assert list(scene_counts(about, "tn34")) == ["train", "val"]


@pytest.mark.parametrize(("limit", "step", "each"), [(30, 1, 30), (30, 4, 8), (3, 5, 1)])
def test_scenes_are_counted_as_the_protocol_takes_them(limit, step, each):
    about = planned(drop_limit=limit, drop_step=step)
    about["data"]["files"] = {"train": 2}
    assert scene_counts(about, "tn34") == {"train": 2 * each}


def test_a_new_view_in_every_epoch_replaces_the_stored_one():
    about = {"data": {"view": ABOVE, "camera": CAMERA}, "training": {"views": ANEW}}
    assert view_text(about) == (
        "0.6 to 0.7 m from the middle of the bin's floor, 0 to 15° from the vertical, turned at random, "
        "drawn anew for every pile and epoch"
    )
    assert field_text(about) == "300 × 300 mm at 0.6 m, 3 mm a pixel"
    about["training"]["views"] = {"_target_": "pnet.data.views.StoredViews"}
    assert view_text(about) == "0.65 m from the middle of the bin's floor, straight above it"


@pytest.mark.parametrize(
    ("stored", "where", "added", "text"),
    [
        (NO_NOISE, ["train"], NO_NOISE, "none"),
        (GAUSSIAN, ["train", "val"], None, "GaussianNoise: sigma 0.0005 in the scenes"),
        (GAUSSIAN, ["val"], NO_NOISE, "none"),
        (NO_NOISE, ["train"], GAUSSIAN, "GaussianNoise: sigma 0.0005 added when a scene is read"),
        (None, [], GAUSSIAN, None),
    ],
)
def test_noise_is_that_of_the_trainings_scenes(stored, where, added, text):
    data = {"noise_in": where, **({"noise": stored} if stored else {})}
    assert noise_text({"data": data, "training": {"noise": added}}) == text


@pytest.mark.parametrize(
    ("plan", "drawn", "percent"), [({"clutter": 0.5}, None, "50 %"), ({"clutter": 0.5}, "1/8", "12.5 %"),
                                   ({}, None, None)]
)  # fmt: skip
def test_clutter_is_the_share_that_training_draws(plan, drawn, percent):
    about = planned(splits={"train": plan})
    about["training"] = {} if drawn is None else {"data.clutter": drawn}
    found = dict(data_rows(about, "tn34"))["clutter"]
    assert (found is None) == (percent is None) and (found or "").startswith(percent or "")
