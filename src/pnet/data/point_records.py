"""Coordinates x, y, z out of the two forms that cloud files hold them in: rows of text, records of bytes."""

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
NAMES = ("x", "y", "z")


def read_rows(
    path: Path, lines: Iterable[str], columns: tuple[int, int, int], comments: list[str] | None = None
) -> Points:
    """Rows of numbers between white space, read one after the other.

    Args:
        path: for the error. lines: blank ones are skipped. columns: where x, y and z stand.
        comments: what starts a comment.
    Returns:
        (n, 3); a row may have more columns, and not all rows equally many.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # no rows: the caller says so
            rows = np.loadtxt(lines, np.float64, usecols=columns, comments=comments, ndmin=2)
    except (ValueError, OverflowError) as fault:
        told = " ".join(str(fault).split(";")[0].split())[:200]
        raise ValueError(f"{path}: a point is not readable ({told}), expected x y z ...") from None
    return np.asarray(rows).reshape(-1, 3)


def read_records(
    path: Path, data: bytes, start: int, count: int, size: int, fields: list[tuple[np.dtype[Any], int]]
) -> Points:
    """Records of the same size, one after the other.

    Args:
        path: for the error. data: the file. start: where the first record begins.
        count: of the records. size: of one, bytes.
        fields: number type of x, y and z, and how many bytes into the record each stands.
    Returns:
        (count, 3).
    """
    check_length(path, len(data) - start, count, size)
    if count == 0:
        return np.empty((0, 3))
    formats, offsets = zip(*fields, strict=True)
    record = np.dtype({"names": NAMES, "formats": formats, "offsets": offsets, "itemsize": size})
    records = np.frombuffer(data, record, count, start)
    points = np.empty((count, 3))
    for axis, name in enumerate(NAMES):
        points[:, axis] = records[name]
    return points


def check_length(path: Path, left: int, count: int, size: int) -> None:
    """Raise ValueError where `count` records of at least `size` bytes do not fit in the bytes left."""
    if count * size > left:
        raise ValueError(
            f"{path}: claims {count:,} records of {size:,} bytes or more, but only {max(left, 0):,} bytes "
            f"are left; the file is cut off or its header damaged"
        )


def read_count(path: Path, word: str, what: str) -> int:
    """A whole number, 0 or more, of a header."""
    if not (word.isascii() and word.isdigit() and len(word) <= 18):
        raise ValueError(f"{path}: {what} is {word[:40]!r}, expected a whole number, 0 or more")
    return int(word)
