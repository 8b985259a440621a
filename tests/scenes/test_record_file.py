"""Files of records: exact, repeatable, never read wrongly, never seen half written."""

import errno
import json
import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from safetensors.numpy import load, save

from pnet.scenes.record_file import (
    RecordFile,
    RecordFormat,
    remove_left_overs,
    write_atomically,
    write_records,
)

SHELF = RecordFormat(
    name="test-shelf",
    version=3,
    what="shelf",
    own={"grid": "F32", "label": "I64"},
    bodies={"place": "F64", "kind": "I16"},
    remedy="fill it again",
    optional={"shade": "U8"},
)
HEADER = {"owner": "nobody", "sizes": [1.5, 2.5], "drops": [3, 1]}
TYPES = {"grid": np.float32, "label": np.int64, "place": np.float64, "kind": np.int16, "shade": np.uint8}


def make_record(bodies: int, seed: int = 0, shade: bool = True) -> dict[str, np.ndarray]:
    rng = np.random.default_rng([bodies, seed])
    record = {
        "grid": rng.normal(size=(4, 2)).astype(np.float32),
        "label": np.array(rng.integers(-(2**40), 2**40)),
        "place": rng.normal(size=(bodies, 3)),
        "kind": rng.integers(-300, 300, bodies).astype(np.int16),
    }
    return {**record, "shade": rng.integers(0, 256, 5).astype(np.uint8)} if shade else record


RECORDS = [make_record(bodies) for bodies in (2, 0, 3)]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "shelf.safetensors"


@pytest.fixture
def whole(path) -> bytes:
    write_records(path, SHELF, HEADER, RECORDS)
    return path.read_bytes()


def assert_reads_as(path, records, header=HEADER) -> None:
    file = RecordFile(path, SHELF)
    assert len(file) == len(records) and header.items() <= file.header.items()
    for i, expected in enumerate(records):
        found = file.record(i)
        assert found.keys() == expected.keys()
        for name, array in found.items():
            assert array.dtype == TYPES[name]
            np.testing.assert_array_equal(array, expected[name])


def is_refused(path) -> bool:
    """True where the file is refused with its name, False where it reads as what was written."""
    try:
        assert_reads_as(path, RECORDS)
    except ValueError as fault:
        assert str(path) in str(fault)
        return True
    return False


def edit_header(whole: bytes, **changes) -> bytes:
    """The file with other header entries and no checksum of the header."""
    length = int.from_bytes(whole[:8], "little")
    top = json.loads(whole[8 : 8 + length])
    content = json.loads(top["__metadata__"]["test-shelf"])
    del content["header_crc32"]
    content.update(changes)
    top["__metadata__"]["test-shelf"] = json.dumps(content)
    header = json.dumps(top).encode()
    return len(header).to_bytes(8, "little") + header + whole[8 + length :]


# what is written is read


def test_records_come_back_exactly_and_in_any_order(path, whole):
    assert_reads_as(path, RECORDS)
    file = RecordFile(path, SHELF)
    for i in (2, 0, 1, 2):
        np.testing.assert_array_equal(file.record(i)["place"], RECORDS[i]["place"])
    assert file.shape("grid") == (4, 2) and file.shape("label") == () and file.shape("shade") == (5,)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.integers(0, 5), max_size=5), st.booleans(), st.data())
def test_any_records_come_back_exactly(tmp_path, counts, shade, data):
    numbers = st.floats(allow_nan=False) | st.just(-0.0)
    records = [
        {**make_record(n, seed, shade), "place": data.draw(arrays(np.float64, (n, 3), elements=numbers))}
        for seed, n in enumerate(counts)
    ]
    write_records(tmp_path / "shelf", SHELF, HEADER, records)
    assert_reads_as(tmp_path / "shelf", records)


@pytest.mark.parametrize("counts", [[0], [0, 0], [0, 2], [2, 0], [1, 0, 0, 3, 0]])
def test_records_without_bodies_come_back_wherever_they_are(path, counts):
    records = [make_record(bodies, seed) for seed, bodies in enumerate(counts)]
    write_records(path, SHELF, HEADER, records)
    assert_reads_as(path, records)
    assert RecordFile(path, SHELF).record(counts.index(0))["place"].shape == (0, 3)


def test_numbers_that_are_none_come_back(path):
    record = {**RECORDS[0], "place": np.array([[np.nan, np.inf, -np.inf]]), "kind": np.zeros(1)}
    write_records(path, SHELF, HEADER, [record])
    np.testing.assert_array_equal(RecordFile(path, SHELF).record(0)["place"], record["place"])


def test_an_optional_array_may_be_absent(path):
    bare = [make_record(bodies, shade=False) for bodies in (1, 2)]
    write_records(path, SHELF, HEADER, bare)
    assert_reads_as(path, bare)
    assert "shade" not in load(path.read_bytes())


def test_an_array_that_must_be_there_is_missed_when_writing(path):
    record = {name: array for name, array in RECORDS[0].items() if name != "grid"}
    with pytest.raises(KeyError, match="grid"):
        write_records(path, SHELF, HEADER, [record])
    assert not path.exists()


def test_a_file_without_records_can_be_written_and_read(path):
    write_records(path, SHELF, HEADER, [])
    assert_reads_as(path, [])
    assert RecordFile(path, SHELF).shape("grid") == ()


def test_equal_records_give_equal_bytes_and_others_do_not(tmp_path, whole):
    reordered = [dict(reversed(make_record(bodies).items())) for bodies in (2, 0, 3)]
    write_records(tmp_path / "again", SHELF, dict(reversed(HEADER.items())), reordered)
    assert (tmp_path / "again").read_bytes() == whole
    write_records(tmp_path / "other", SHELF, HEADER, [make_record(bodies, 1) for bodies in (2, 0, 3)])
    assert (tmp_path / "other").read_bytes() != whole


# what is not whole is refused


def test_a_file_cut_off_at_any_byte_is_refused(path, whole):
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        assert is_refused(path), size


def test_a_file_with_something_behind_is_refused(path, whole):
    path.write_bytes(whole + b"\0")
    assert is_refused(path)


def test_every_flipped_bit_of_the_data_is_found(path, whole):
    start = 8 + int.from_bytes(whole[:8], "little")
    for place in range(start, len(whole)):
        garbled = bytearray(whole)
        garbled[place] ^= 1 << place % 8
        path.write_bytes(garbled)
        assert is_refused(path), place


def test_a_garbled_header_is_never_read_as_other_records(path, whole):
    start = 8 + int.from_bytes(whole[:8], "little")
    rng, refused = np.random.default_rng(1), 0
    for _ in range(400):
        garbled = bytearray(whole)
        for place in rng.integers(0, start, rng.choice([1, 1, 3])):
            garbled[place] = rng.integers(256)
        path.write_bytes(garbled)
        refused += is_refused(path)
    assert refused > 380  # a byte may be replaced by itself


def test_every_digit_of_the_header_counts(path, whole):
    """A digit for another: the file stays well-formed, only the checksums can tell."""
    start = 8 + int.from_bytes(whole[:8], "little")
    digits = [place for place in range(8, start) if whole[place : place + 1].isdigit()]
    assert len(digits) > 80
    for place in digits:
        garbled = bytearray(whole)
        garbled[place] = ord("0") + (garbled[place] - ord("0") + 1) % 10
        path.write_bytes(garbled)
        assert is_refused(path), whole[place - 20 : place + 20]


@pytest.mark.parametrize("first", [[0, 3, 2, 5], [0, 2, 2, 6], [-1, 2, 2, 5], [0, 2, 2, 2**62]])
def test_places_of_bodies_that_make_no_sense_are_refused_before_a_record_is_read(path, whole, first):
    start = 8 + int.from_bytes(whole[:8], "little")
    begin, end = json.loads(whole[8:start])["first_body"]["data_offsets"]
    right, wrong = (np.array(values, np.int64).tobytes() for values in ([0, 2, 2, 5], first))
    assert whole[start + begin : start + end] == right
    path.write_bytes(whole[: start + begin] + wrong + whole[start + end :])
    with pytest.raises(ValueError, match=f"{path}: not a whole shelf file .record or body counts disagree"):
        RecordFile(path, SHELF)


@pytest.mark.parametrize(
    ("old", "new"), [("F64", "I64"), ("F32", "I32"), ("I64", "U64"), ("I16", "U16"), ("U8", "I8")]
)
def test_another_array_type_of_the_same_size_is_refused(path, whole, old, new):
    assert f'"{old}"'.encode() in whole
    path.write_bytes(whole.replace(f'"{old}"'.encode(), f'"{new}"'.encode()))
    assert is_refused(path)


@pytest.mark.parametrize(
    "content",
    [b"", b"\0" * 8, b"not a shelf", b"\xff" * 100, b"{}", save({"grid": np.zeros(3)})],
    ids=["empty", "zeros", "text", "ones", "json", "other safetensors"],
)
def test_a_file_of_another_kind_is_refused(path, content):
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"{path}: not a whole shelf file .*delete it and fill it again"):
        RecordFile(path, SHELF)


def test_a_file_of_another_format_is_refused(path, whole):
    with pytest.raises(ValueError, match=f"{path}: not a whole book file"):
        RecordFile(path, replace(SHELF, name="test-book", what="book"))


def test_a_folder_is_refused(tmp_path):
    with pytest.raises((ValueError, OSError), match=str(tmp_path)):
        RecordFile(tmp_path, SHELF)


@pytest.mark.parametrize("content", ["[]", '"text"', "3", "null", "{}", '{"version": "3"}', "{"])
def test_a_header_of_another_shape_is_refused(path, content):
    path.write_bytes(save({"grid": np.zeros(3)}, {"test-shelf": content}))
    with pytest.raises(ValueError, match=f"{path}: not a whole shelf file"):
        RecordFile(path, SHELF)


def test_a_header_without_its_checksum_is_refused(path, whole):
    path.write_bytes(edit_header(whole))
    with pytest.raises(ValueError, match=f"{path}: not a whole shelf file"):
        RecordFile(path, SHELF)


def test_a_newer_version_asks_for_an_update(path, whole):
    path.write_bytes(edit_header(whole, version=99))
    message = (
        rf"{path}: written by a newer pnet \(format 99, this one reads 3\); update pnet or make the data"
    )
    with pytest.raises(ValueError, match=message):
        RecordFile(path, SHELF)


def test_an_older_version_asks_for_the_data_again(path, whole):
    message = rf"{path}: written by an older pnet \(format 3, this one reads 4\); make the data again"
    with pytest.raises(ValueError, match=message):
        RecordFile(path, replace(SHELF, version=4))


def test_a_missing_file_is_named_with_its_remedy(path):
    with pytest.raises(FileNotFoundError, match=f"{path}: no such shelf file; fill it again"):
        RecordFile(path, SHELF)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read anything")
def test_a_file_that_may_not_be_read_is_named(path, whole):
    path.chmod(0)
    with pytest.raises(PermissionError, match=f"{path}: not allowed to read it"):
        RecordFile(path, SHELF)


@pytest.mark.parametrize("fault", [FileNotFoundError, PermissionError])
def test_a_file_that_is_there_is_never_called_missing(path, whole, monkeypatch, fault):
    """What safetensors raises of a file that may not be read depends on its version."""

    def refuse(*_, **__):
        raise fault(f"No such file or directory: {path}")

    monkeypatch.setattr("pnet.scenes.record_file.safe_open", refuse)
    with pytest.raises(PermissionError, match=f"{path}: not allowed to read it"):
        RecordFile(path, SHELF)


# nothing appears before it is whole


@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_nothing_appears_when_writing_fails_midway(path, monkeypatch, step):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, step, full)
    with pytest.raises(OSError, match="No space left"):
        write_records(path, SHELF, HEADER, RECORDS)
    assert list(path.parent.iterdir()) == []


def test_a_failed_rewrite_leaves_the_old_file(path, whole, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, b"new")
    assert path.read_bytes() == whole and list(path.parent.iterdir()) == [path]


def test_an_atomic_write_replaces_the_file(path, whole):
    write_atomically(path, b"new")
    assert path.read_bytes() == b"new" and list(path.parent.iterdir()) == [path]


def test_writing_into_a_missing_folder_names_it(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        write_atomically(tmp_path / "nowhere" / "file", b"new")


# what killed processes leave

HOST = socket.gethostname().split(".")[0]


@pytest.fixture(scope="module")
def dead() -> int:
    """The number of a process that is gone."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def names_in(folder) -> set[str]:
    return {path.name for path in folder.rglob("*") if path.is_file()}


def test_the_unfinished_file_names_the_machine_and_the_process(path, monkeypatch):
    seen = []
    monkeypatch.setattr(os, "fsync", lambda _: seen.extend(names_in(path.parent)))
    write_atomically(path, b"new")
    assert seen == [f".{path.name}.{HOST}.{os.getpid()}.part"]


def test_only_this_machines_dead_processes_files_go(tmp_path, dead):
    gone = {f".pile.safetensors.{HOST}.{dead}.part", f".dataset.json.{HOST}.{dead}.part"}
    stay = {
        f".pile.safetensors.{HOST}.{os.getpid()}.part",  # at work
        f".pile.safetensors.{HOST}.1.part",  # at work, another user's
        f".pile.safetensors.elsewhere.{dead}.part",
        f".pile.safetensors.{HOST}b.{dead}.part",
        f".pile.safetensors.a{HOST}.{dead}.part",
        f"pile.safetensors.{HOST}.{dead}.part",  # not hidden: nobody's temporary file
        f".pile.safetensors.{HOST}.{dead}.partial",
        "pile.safetensors",
    }
    for folder in (tmp_path, tmp_path / "train" / "deep"):
        folder.mkdir(parents=True, exist_ok=True)
        for name in gone | stay:
            (folder / name).write_bytes(b"half")
    remove_left_overs(tmp_path)
    assert names_in(tmp_path) == stay
    assert len([path for path in tmp_path.rglob("*") if path.is_file()]) == 2 * len(stay)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="reads Linux's /proc")
def test_a_dead_process_that_nobody_collected_is_gone(tmp_path):
    """Its number is still taken: where a container's first process collects no orphans, for ever."""
    process = subprocess.Popen([sys.executable, "-c", "print()"], stdout=subprocess.PIPE)
    try:
        assert process.stdout.read() == b"\n"
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        os.kill(process.pid, 0)  # there, to all appearances
        left = tmp_path / f".pile.safetensors.{HOST}.{process.pid}.part"
        left.write_bytes(b"half")
        remove_left_overs(tmp_path)
        assert not left.exists()
    finally:
        process.communicate()


def test_one_processs_files_go_even_while_it_runs(tmp_path, dead):
    """What a parent does for a worker that it ended."""
    mine, others = (f".pile.safetensors.{HOST}.{pid}.part" for pid in (os.getpid(), dead))
    foreign = f".pile.safetensors.elsewhere.{os.getpid()}.part"
    for name in (mine, others, foreign):
        (tmp_path / name).write_bytes(b"half")
    remove_left_overs(tmp_path, os.getpid())
    assert names_in(tmp_path) == {others, foreign}


def test_a_machines_domain_does_not_count(tmp_path, dead, monkeypatch):
    monkeypatch.setattr(socket, "gethostname", lambda: "node7.cluster.example")
    (tmp_path / f".pile.safetensors.node7.{dead}.part").write_bytes(b"half")
    remove_left_overs(tmp_path)
    assert names_in(tmp_path) == set()
