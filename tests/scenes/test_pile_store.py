"""Pile files: piles come back exactly, and messages name the stage that makes them."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from pnet.scenes.pile import Pile
from pnet.scenes.pile_store import PileFile, PileHeader, write_piles

HEADER = PileHeader("0123abcd", "tn34", "train", "pile", "L", 3, 5, (0.01, 0.0234), (2, 4, 5))
AGAIN = "delete it and run pnet-generate stage=simulate again"


def make_pile(bodies: int, drop: int, settled: bool = True) -> Pile:
    rng = np.random.default_rng([bodies, drop])
    R = Rotation.random(bodies, rng).as_matrix().reshape(-1, 3, 3)
    return Pile(R, rng.normal(size=(bodies, 3)), drop, drop - bodies, settled)


PILES = [make_pile(2, 2), make_pile(3, 4, settled=False), make_pile(4, 5)]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "pile_0003_part_05.safetensors"


@pytest.fixture
def whole(path) -> bytes:
    write_piles(path, HEADER, PILES)
    return path.read_bytes()


def assert_reads_as(path, header, piles) -> None:
    file = PileFile(path)
    assert file.header == header and len(file) == len(piles)
    for i, expected in enumerate(piles):
        pile = file.pile(i)
        assert pile.R.tobytes() == expected.R.tobytes() and pile.R.shape == expected.R.shape
        assert pile.t.tobytes() == expected.t.tobytes() and pile.t.shape == expected.t.shape
        assert (pile.drop, pile.escaped, pile.settled) == (expected.drop, expected.escaped, expected.settled)
        assert type(pile.escaped) is int and type(pile.settled) is bool


def test_piles_come_back_exactly(path, whole):
    assert_reads_as(path, HEADER, PILES)
    assert [PileFile(path).pile(i).settled for i in (2, 1, 0)] == [True, False, True]


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 3), st.booleans()), max_size=4))
def test_any_piles_come_back_exactly(tmp_path, counts):
    """Also those whose bodies all left the bin."""
    piles = [make_pile(bodies, bodies + escaped, settled) for bodies, escaped, settled in counts]
    header = replace(HEADER, drops=tuple(pile.drop for pile in piles))
    write_piles(tmp_path / "piles", header, piles)
    assert_reads_as(tmp_path / "piles", header, piles)


def test_parameters_keep_every_digit(path):
    header = replace(HEADER, parameters=(0.1 + 0.2, 1e-17, 1 / 3))
    write_piles(path, header, PILES)
    assert PileFile(path).header.parameters == (0.1 + 0.2, 1e-17, 1 / 3)


def test_equal_piles_give_equal_bytes(tmp_path, whole):
    write_piles(
        tmp_path / "again", HEADER, [make_pile(2, 2), make_pile(3, 4, settled=False), make_pile(4, 5)]
    )
    assert (tmp_path / "again").read_bytes() == whole


def test_a_pile_of_60_bodies_takes_a_few_kilobytes(path):
    write_piles(path, replace(HEADER, drops=(60,)), [make_pile(60, 60)])
    assert 60 * 12 * 8 < path.stat().st_size < 60 * 12 * 8 + 1000


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.9, 0.9999])
def test_a_truncated_file_names_the_stage_that_makes_it(path, whole, share):
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match=f"{path}: not a whole pile file .*; {AGAIN}"):
        PileFile(path)


def test_a_flipped_bit_names_the_stage_that_makes_the_file(path, whole):
    for place in range(8 + int.from_bytes(whole[:8], "little"), len(whole), 7):
        garbled = bytearray(whole)
        garbled[place] ^= 1 << place % 8
        path.write_bytes(garbled)
        with pytest.raises(ValueError, match=f"{path}: not a whole pile file .*; {AGAIN}"):
            [PileFile(path).pile(i) for i in range(3)]


def test_a_missing_file_names_the_stage_that_makes_it(path):
    with pytest.raises(
        FileNotFoundError, match=f"{path}: no such pile file; run pnet-generate stage=simulate"
    ):
        PileFile(path)


def test_drops_that_disagree_with_the_piles_are_refused(path):
    write_piles(path, replace(HEADER, drops=(1, 2)), PILES)
    with pytest.raises(ValueError, match=f"{path}: not a whole pile file .pile counts disagree"):
        PileFile(path)


def test_scenes_are_no_piles(path, make_scene, tn34, camera):
    from pnet.scenes.store import CycleHeader, write_cycle

    scene = make_scene(tn34)
    header = CycleHeader("tiny", "tn34", camera, "train", "pile", 0, 0, (4,))
    write_cycle(path, header, [scene])
    with pytest.raises(ValueError, match=f"{path}: not a whole pile file"):
        PileFile(path)
