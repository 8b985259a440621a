"""The weights that come with pnet: small, whole, of the part they are named after, each with its own card."""

import re
from hashlib import sha256
from pathlib import Path

import pytest

import pnet
from pnet.engine.bundle import read_bundle
from pnet.reporting.model_card import TITLE

FOLDER = Path(__file__).parents[1] / "weights"
LARGEST = 5_000_000  # bytes
BUNDLES = sorted(FOLDER.glob("*.safetensors"))

each = pytest.mark.parametrize("path", BUNDLES, ids=lambda path: path.stem)


def test_the_folder_holds_bundles_and_their_cards_alone():
    names = {path.name for path in FOLDER.iterdir()}
    expected = {f"{path.stem}{ending}" for path in BUNDLES for ending in (".safetensors", ".md")}
    assert names == expected | {"README.md"}


@each
def test_a_bundle_is_small_and_its_card_is_of_this_file(path):
    content, card = path.read_bytes(), path.with_suffix(".md").read_text(encoding="utf-8")
    assert len(content) <= LARGEST
    assert card.startswith(f"{TITLE}{path.stem.upper()}\n") and "Apache-2.0" in card
    assert re.findall(r"`([0-9a-f]{64})`", card) == [sha256(content).hexdigest()]


@each
def test_a_bundle_predicts_for_the_part_that_it_is_named_after(path):
    estimator = pnet.Estimator.pretrained(path.stem)
    assert estimator.part.name == path.stem and estimator.camera is not None
    assert {str(weight.dtype) for weight in read_bundle(path).weights.values()} <= {
        "torch.float32",
        "torch.int64",
    }


@each
def test_a_bundle_says_how_good_it_is_and_where_it_comes_from(path):
    about = read_bundle(path).about
    assert {"test_l", "test_g"} <= set(about["evaluations"]) and about["steps"] > 0
    assert about["data"]["protocol"]["name"] and about["data"]["files"]["train"] > 0
