"""The model card: what it says, what it leaves out, and that it says nothing that does not follow."""

import re
from copy import deepcopy
from dataclasses import replace

import pytest
from tests.conftest import Marble

from pnet.geometry.camera import Camera
from pnet.parts.tn34 import TN34
from pnet.reporting.model_card import TITLE, CardContent, model_card

CAMERA = {"width": 640, "height": 512, "fx": 1500.0, "fy": 1500.0, "cx": 319.5, "cy": 255.5}
PROTOCOL = {
    "name": "small",
    "drop_limit": 30,
    "drop_step": 4,
    "splits": {
        "train": {"grid": "L", "cycles": 4, "count": 3, "clutter": 0.5},
        "test_l": {"grid": "L", "cycles": 1},
        "test_g": {"grid": "G", "cycles": 1},
    },
}
ABOUT = {
    "steps": 6000,
    "training_seconds": 5266.8,
    "precision": "bf16",
    "machine": "Linux x86_64",
    "device": "cpu",
    "threads": 2,
    "seed": 3,
    "commits": ["abc1234", "def5678+changes"],
    "packages": {"pnet": "0.1.0", "torch": "2.13.0", "numpy": "2.4.6"},
    "network": {"parameters": 735045, "operations": 955607040},
    "training": {"data.batch_size": 4, "data.learn": 1},
    "data": {
        "protocol": PROTOCOL,
        "files": {"train": 8, "test_l": 1},
        "physics": {"_target_": "pnet.scenes.mujoco_world.MujocoPhysics", "friction": 0.2},
        "bin": {"width": 0.15, "depth": 0.12, "height": 0.1},
        "camera": {"_target_": "pnet.geometry.camera.Camera", **CAMERA},
        "view": {"distance": [0.65, 0.65], "tilt": [0, 0], "turn": False},
        "noise": {"_target_": "pnet.scenes.noise.NoNoise"},
        "noise_in": ["train"],
        "seed": 9,
    },
    "evaluations": {
        "test_g": {"mAP": 0.9, "AP": 0.91, "parameter_error_mm": 0.86, "scenes": 240},
        "test_l": {
            "mAP": 0.9958,
            "AP": 0.9962,
            "recall_at_precision_99": 0.9955,
            "position_error_mm": 0.558,
            "axis_error_deg": 2.862,
            "parameter_error_mm": 0.8055,
            "parameter_error_mm/r": 0.5,
            "parameter_error_mm/h": None,
            "scenes": 240,
            "truths_to_find": 3424,
        },
    },
    "validation": {"AP": 0.5},
}
SETTINGS = {
    "method": {"name": "parametricnet"},
    "backbone": {"_target_": "pnet.backbones.range_unet.RangeUNet"},
    "postprocess": {
        "_target_": "pnet.postprocess.pipeline.PoseRecovery",
        "voting": {"_target_": "pnet.postprocess.folded_vote.FoldedVote"},
        "scene_parameters": True,
    },
}


@pytest.fixture
def content():
    part = TN34({"r": [12, 18], "h": [10, 14.5]}, {"r": [13], "h": [11]})
    return CardContent(
        file="tn34.safetensors",
        digest="0f" * 32,
        size=2967332,
        licence="Apache-2.0",
        part=part,
        settings=deepcopy(SETTINGS),
        about=deepcopy(ABOUT),
        points=4096,
        camera=Camera(**CAMERA),
        weights=737350,
    )


def tables(card):
    """First cell → the others, of every table's rows."""
    lines = [line[2:-2].split(" | ") for line in card.splitlines() if line.startswith("| ")]
    return {cells[0]: cells[1:] for cells in lines}


def limits(card):
    return re.findall(r"^- (.*)$", card, re.MULTILINE)


def test_the_card_says_what_the_weights_find_and_which_file_it_is_of(content):
    card = model_card(content)
    assert card.startswith(
        f"{TITLE}TN34\n\n`tn34.safetensors` finds every instance of the part template TN34 in"
    )
    assert "A stepped round flange with an axial hole." in card and "Outer radius r, total height h" in card
    found = tables(card)
    assert found["SHA-256"] == [f"`{'0f' * 32}`"] and "2,967,332 bytes" in found["file"][0]
    assert found["parameter"] == ["grid L, for training, mm", "grid G, for tests alone, mm"]
    assert found["r"] == ["12, 18", "13"] and found["h"] == ["10, 14.5", "11"]
    assert "Of the 4 part objects in grid L 3 were in the training." in card


def test_the_card_tells_of_network_data_and_training(content):
    found = {name: cells[0] for name, cells in tables(model_card(content)).items()}
    expected = {
        "backbone": "RangeUNet",
        "votes": "FoldedVote",
        "learnt parameters": "735,045",
        "numbers in the file": "737,350",
        "points of a scene": "4,096",
        "protocol": "small",
        "scenes": "train 64, test_l 8",
        "clutter": "50 % of the training's scenes: bodies at random orientations, without physics",
        "bodies in a scene": "up to 30",
        "bin": "150 × 120 mm, 100 mm high",
        "physics": "MujocoPhysics: friction 0.2",
        "camera": "640 × 512 pixels, fx 1500, fy 1500, cx 319.5, cy 255.5",
        "camera's place": "0.65 m from the middle of the bin's floor, straight above it",
        "field of view": "277 × 222 mm at 0.65 m, 0.43 mm a pixel",
        "sensor noise": "none",
        "steps": "6,000",
        "scenes drawn in all": "24,000",
        "time": "5,267 s",
        "precision": "bf16",
        "threads": "2",
        "commit": "abc1234, def5678+changes",
        "packages": "pnet 0.1.0, torch 2.13.0",
    }
    assert {name: found.get(name) for name in expected} == expected


def test_the_figures_are_a_table_with_every_parameters_error(content):
    card = model_card(content)
    found = tables(card)
    assert found["mAP"] == ["0.996", "0.900"] and found["Scenes"] == ["240", "240"]
    assert found["Parameter error"] == ["0.81 mm", "0.86 mm"]
    assert found["Parameter error, r"] == ["0.50 mm", "–"] and found["Parameter error, h"] == ["–", "–"]
    assert found["Axis error"] == ["2.86°", "–"]
    assert (
        "| test_l | test_g |" in card and "test_l shows sizes of grid L, test_g shows sizes of grid G" in card
    )
    assert "validation" not in card


def test_without_an_evaluation_the_validation_is_shown_and_called_so(content):
    del content.about["evaluations"]
    card = model_card(content)
    assert "From the last validation in the training" in card and tables(card)["AP"] == ["0.500"]
    del content.about["validation"]
    assert "## Figures" not in model_card(content)


def test_limits_follow_from_the_settings(content):
    assert limits(model_card(content)) == [
        "The training's scenes are synthetic; no real image was among them.",
        "They show the parts alone, without bin and floor: take the background away (`background=`).",
        "They have no sensor noise and no missing pixels.",
        "Their view: 0.65 m from the middle of the bin's floor, straight above it, 277 × 222 mm at 0.65 m, "
        "0.43 mm a pixel. Other distances, angles and resolutions were not seen.",
        "Their piles: up to 30 bodies of one size in a bin of 150 × 120 mm, 100 mm high.",
        "Sizes outside of r 12 to 18 mm, h 10 to 14.5 mm were not in the training.",
        "All parts in an image are taken to be of one size; `+postprocess.scene_parameters=false` takes each "
        "by itself.",
    ]


def test_a_limit_that_does_not_hold_is_not_told(content):
    content.settings["postprocess"]["scene_parameters"] = False
    content.about["data"]["noise"] = {"_target_": "pnet.scenes.noise.GaussianNoise", "sigma": 0.0005}
    card = model_card(content)
    assert "of one size;" not in card and "no sensor noise" not in card
    assert tables(card)["sensor noise"] == ["GaussianNoise: sigma 0.0005 in the scenes"]


def test_a_public_data_set_is_named_and_not_called_synthetic(content):
    data = {"source": "ipa", "scenes": {"train": 5, "val": 2}, "camera": CAMERA}
    card = model_card(replace(content, about={"data": data}))
    assert tables(card)["made by"] == ["ipa"] and tables(card)["scenes"] == ["train 5, val 2"]
    assert "synthetic" not in card and "background=" not in card


def test_what_nobody_knows_has_no_line(content):
    card = model_card(replace(content, about={}, camera=None))
    assert re.findall("^## (.*)$", card, re.MULTILINE) == [
        "What it finds",
        "Network",
        "Use",
        "Limits",
        "Licence",
    ]
    assert "None" not in card and "nan" not in card and "Without a camera" not in card
    assert len(limits(card)) == 2


@pytest.mark.parametrize("path", [(key,) for key in ABOUT] + [("data", key) for key in ABOUT["data"]])
def test_each_note_may_be_missing(content, path):
    node = content.about
    for name in path[:-1]:
        node = node[name]
    del node[path[-1]]
    card = model_card(content)
    assert "None" not in card and card.endswith("## Licence\n\nApache-2.0.\n")


@pytest.mark.parametrize(
    "change",
    [
        {"steps": "many"},
        {"evaluations": {"test_l": 3}},
        {"evaluations": {"test_l": {"AP": "high"}}},
        {"data": [1]},
        {"data": {"camera": {"width": 3}}},
        {"data": {"protocol": {"drop_limit": 3, "drop_step": 0}, "files": {"train": 1}}},
        {"training_seconds": []},
        {"training": {"data.clutter": "1/0"}},
        {"network": 7},
    ],
    ids=str,
)
def test_notes_of_another_kind_are_one_error_that_names_the_file(content, change):
    with pytest.raises(ValueError, match=r"tn34\.safetensors: what it says of its training is not as pnet"):
        model_card(replace(content, about={**content.about, **change}))


def test_text_cannot_break_a_table(content):
    content.about["machine"] = "a | b\n# c"
    assert "| machine | a \\| b # c |" in model_card(content)


def test_a_part_of_another_name_is_used_by_its_file_alone(content):
    assert 'Estimator.pretrained("tn34")' in model_card(content)
    card = model_card(replace(content, file="flange.pnet"))
    assert "pretrained" not in card and "pnet-predict run=flange.pnet" in card


def test_a_part_of_one_known_size_has_no_words_on_sizes(content):
    part = Marble({"r": [10]})
    part.is_fixed = True
    card = model_card(replace(content, part=part))
    assert (
        card.startswith(f"{TITLE}MARBLE") and "6DoF pose and a score" in card and "Sizes outside" not in card
    )


def test_the_card_of_a_method_that_says_no_sizes_promises_none(content):
    assert "its 6DoF pose, its parameters and a score" in model_card(content)
    content.settings["model"] = {"_target_": "pnet.models.pprnet.PPRNet"}
    assert "its 6DoF pose and a score" in model_card(content)


def test_scenes_of_a_step_are_those_of_all_devices(content):
    batch = content.about["training"]["data.batch_size"]
    content.about["training"]["trainer.devices"] = 2
    assert tables(model_card(content))["scenes in a step"] == [str(2 * batch)]
