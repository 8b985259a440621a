"""Records of several files as one row; files are opened once, where they are read."""

import pickle
from pathlib import Path

import pytest

from pnet.data.split_files import SplitFiles


class Reader:
    """Counts what it opens."""

    def __init__(self) -> None:
        self.opened: list[str] = []

    def __call__(self, path: Path) -> str:
        self.opened.append(path.name)
        return path.name


def test_every_record_is_found_in_its_file_also_beside_an_empty_one():
    files = SplitFiles(Reader(), [Path(name) for name in "abc"], [2, 0, 3])
    assert len(files) == 5
    expected = [(0, "a", 0), (0, "a", 1), (2, "c", 0), (2, "c", 1), (2, "c", 2)]
    assert [files.locate(i) for i in range(5)] == expected


@pytest.mark.parametrize("index", [-1, 5])
def test_a_record_that_is_not_there_is_an_index_error(index):
    with pytest.raises(IndexError):
        SplitFiles(Reader(), [Path("a")], [5]).locate(index)


def test_a_file_is_opened_once_in_each_process():
    reader = Reader()
    files = SplitFiles(reader, [Path("a"), Path("b")], [2, 2])
    for index in (3, 2, 3):
        files.locate(index)
    assert reader.opened == ["b"]
    copy = pickle.loads(pickle.dumps(files))
    assert copy.locate(3) == (1, "b", 1)
    assert copy._reader.opened == ["b", "b"]  # its own handle, not the one of before
