"""Checkpoints are read without running anything in them."""

import pickle
import re

import pytest
import torch

from pnet.engine.checkpoints import read_checkpoint
from pnet.engine.training import check_identity


class Malicious:
    """Touches a file when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.fixture
def path(tmp_path):
    return tmp_path / "last.ckpt"


@pytest.mark.parametrize("zipped", [True, False])
def test_code_in_a_checkpoint_is_not_run(path, tmp_path, zipped):
    content = {"state_dict": {"w": torch.zeros(2)}, "extra": Malicious(tmp_path / "touched")}
    if zipped:
        torch.save(content, path)
    else:
        path.write_bytes(pickle.dumps(content))
    with pytest.raises(ValueError, match=re.escape(str(path)) + ": not a readable checkpoint"):
        read_checkpoint(path)
    assert not (tmp_path / "touched").exists()
    if zipped:  # the trap works: an ordinary load springs it
        torch.load(path, weights_only=False)
        assert (tmp_path / "touched").exists()


def test_a_plain_checkpoint_is_read(path):
    torch.save({"state_dict": {"w": torch.arange(3.0)}, "pnet": {"part": "tn34"}}, path)
    content = read_checkpoint(path)
    assert content["state_dict"]["w"].tolist() == [0, 1, 2] and content["pnet"] == {"part": "tn34"}


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.95])
def test_a_truncated_checkpoint_is_refused(path, share):
    torch.save({"state_dict": {"w": torch.randn(1000)}}, path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ValueError, match="not a readable checkpoint"):
        read_checkpoint(path)


@pytest.mark.parametrize("content", [b"garble", b"\x80\x05" + bytes(range(256)), bytes(4000)])
def test_garble_is_refused(path, content):
    path.write_bytes(content)
    with pytest.raises(ValueError, match="not a readable checkpoint"):
        read_checkpoint(path)


def test_other_torch_files_are_refused(path):
    torch.save([1, 2], path)
    with pytest.raises(ValueError, match="not a training checkpoint"):
        read_checkpoint(path)


def test_a_missing_checkpoint_says_what_to_run(path, tmp_path):
    for missing in (path, tmp_path):
        with pytest.raises(FileNotFoundError, match="train first with pnet-train"):
            read_checkpoint(missing)


def test_identity_names_what_differs():
    own = {"part": "tn34", "backbone": "a"}
    check_identity({"pnet": {**own, "more": "x"}}, own)
    with pytest.raises(ValueError, match="the checkpoint's backbone is 'b', this configuration's is 'a'"):
        check_identity({"pnet": {"part": "tn34", "backbone": "b"}}, own)
    for stranger in ({}, {"pnet": "text"}):
        with pytest.raises(ValueError, match="not written by pnet"):
            check_identity(stranger, own)
