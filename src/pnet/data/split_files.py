"""The files of a split as one row of records, each opened where it is read."""

from bisect import bisect_right
from collections.abc import Callable, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Generic, TypeVar

File = TypeVar("File")


class SplitFiles(Generic[File]):
    """Finds the file of a record; travels to a loader's workers without the handles, which do not.

    Args:
        reader: opens a file. paths: of the files. counts: how many records of each are in the row.
    """

    def __init__(self, reader: Callable[[Path], File], paths: Sequence[Path], counts: Sequence[int]) -> None:
        self._reader, self._paths = reader, list(paths)
        self._ends = list(accumulate(counts))
        self._open: dict[int, File] = {}

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def locate(self, index: int) -> tuple[int, File, int]:
        """Number of the file that holds record `index`, the file, and the record's place in it."""
        if not 0 <= index < len(self):
            raise IndexError(index)
        number = bisect_right(self._ends, index)
        if number not in self._open:
            self._open[number] = self._reader(self._paths[number])
        return number, self._open[number], index - (self._ends[number - 1] if number else 0)

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_open": {}}
