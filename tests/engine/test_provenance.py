"""What a run stood on, and JSON files that are whole or absent."""

import errno
import json
import os

import pytest

from pnet.engine.provenance import git_state, package_versions, provenance, read_json, write_json


def test_nan_becomes_null_at_any_depth(tmp_path):
    path = tmp_path / "new" / "metrics.json"
    write_json(path, {"b": float("nan"), "a": [1, float("nan"), {"c": (0.5, float("nan"))}], 3: "x"})
    assert json.loads(path.read_text()) == {"3": "x", "a": [1, None, {"c": [0.5, None]}], "b": None}
    assert read_json(path)["b"] is None


def test_infinity_is_refused_and_the_old_file_stays(tmp_path):
    path = tmp_path / "metrics.json"
    write_json(path, {"AP": 1})
    with pytest.raises(ValueError):
        write_json(path, {"AP": float("inf")})
    assert read_json(path) == {"AP": 1}


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_on_a_full_disk_the_old_file_stays(tmp_path, monkeypatch, call):
    path = tmp_path / "metrics.json"
    write_json(path, {"AP": 1})

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, call, full)
    with pytest.raises(OSError, match="No space left"):
        write_json(path, {"AP": 2})
    assert read_json(path) == {"AP": 1} and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("content", [b"{", b"", b"\xff\xfe\x00", b"[1]", b"nonsense"])
def test_what_is_no_json_object_is_refused_with_its_name(tmp_path, content):
    path = tmp_path / "metrics.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"metrics\.json"):
        read_json(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"metrics\.json: no such file"):
        read_json(tmp_path / "metrics.json")


def test_provenance_is_plain_and_complete():
    state = provenance(seed=7)
    assert json.loads(json.dumps(state)) == state
    assert state["seed"] == 7 and set(state) >= {"git", "python", "packages", "device", "threads"}
    assert state["packages"]["torch"] != "absent"
    assert set(package_versions()) >= {"pnet", "torch", "numpy", "hydra-core", "lightning"}


def test_outside_a_checkout_the_commit_is_unknown(tmp_path):
    assert git_state(tmp_path) == {"commit": "unknown", "changed": False}
