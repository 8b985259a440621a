"""The points of a PCD file (Point Cloud Library): text, binary or compressed.

Readers at hand take memory for whatever the header claims. Here it is held against the file's size first;
only the decompression is a library's.
"""

import io
import struct
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from pnet.data.point_records import NAMES, Points, check_length, read_count, read_records, read_rows

_TYPES = {"F": (4, 8), "U": (1, 2, 4, 8), "I": (1, 2, 4, 8)}
_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_MOST_HEADER = 100_000  # bytes
_MOST_GROWTH = 88  # LZF: three bytes stand for 264 at most


class _Layout:
    """What a record holds.

    Attributes:
        fields: the names. types: number type of each. counts: numbers of each. count: of the points.
    """

    def __init__(self, path: Path, header: dict[str, list[str]]) -> None:
        for key in ("FIELDS", "SIZE", "TYPE", "DATA"):
            if key not in header:
                raise ValueError(f"{path}: the header lacks {key}")
        self.fields = header["FIELDS"]
        kinds, sizes = header["TYPE"], header["SIZE"]
        counts = header.get("COUNT", ["1"] * len(self.fields))
        if not len(self.fields) == len(kinds) == len(sizes) == len(counts):
            raise ValueError(f"{path}: FIELDS, SIZE, TYPE and COUNT of the header have unequal lengths")
        self.types = [_number_type(path, *pair) for pair in zip(kinds, sizes, strict=True)]
        self.counts = [read_count(path, word, "a COUNT") for word in counts]
        self.count = _count_points(path, header)
        lacking = [name for name in NAMES if name not in self.fields]
        if lacking:
            raise ValueError(f"{path}: the points lack the field {', '.join(lacking)}")
        self.places = [self.fields.index(name) for name in NAMES]
        if any(self.counts[place] != 1 for place in self.places):
            raise ValueError(f"{path}: COUNT of x, y and z must be 1")

    @property
    def sizes(self) -> list[int]:
        """Bytes of each field."""
        return [one.itemsize * count for one, count in zip(self.types, self.counts, strict=True)]


def read_pcd(path: Path) -> Points:
    """The coordinates of the points; VIEWPOINT is not applied: they are in the sensor's frame as they stand.

    Returns:
        (n, 3) as the file holds them.
    Raises:
        OSError, ValueError: names the file and the fault.
        ModuleNotFoundError: the file is compressed and the package for it missing.
    """
    data = path.read_bytes()
    header, start = _read_header(path, data)
    layout = _Layout(path, header)
    match header["DATA"]:
        case ["ascii"]:
            return _read_text(path, data, start, layout)
        case ["binary"]:
            return _read_binary(path, data, start, layout)
        case ["binary_compressed"]:
            return _read_columns(path, _decompress(path, data, start, layout), layout)
        case other:
            raise ValueError(
                f"{path}: DATA is {' '.join(other)[:40]!r}, expected ascii, binary or binary_compressed"
            )


def _read_header(path: Path, data: bytes) -> tuple[dict[str, list[str]], int]:
    """Words of each entry, and where the points begin."""
    header: dict[str, list[str]] = {}
    start = 0
    while (end := data.find(b"\n", start, _MOST_HEADER)) >= 0:
        words = data[start:end].decode("ascii", "replace").split()
        start = end + 1
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in _KEYS or words[0] in header:
            raise ValueError(f"{path}: the header's line {' '.join(words)[:80]!r} is not understood")
        header[words[0]] = words[1:]
        if words[0] == "DATA":
            return header, start
    raise ValueError(f"{path}: no PCD file: its header has no line DATA")


def _number_type(path: Path, kind: str, size: str) -> np.dtype[Any]:
    if not (size.isdigit() and int(size) in _TYPES.get(kind, ())):
        raise ValueError(f"{path}: TYPE {kind[:40]} with SIZE {size[:40]} is unknown, expected F, U or I")
    return np.dtype(f"<{kind.lower()}{size}")


def _count_points(path: Path, header: dict[str, list[str]]) -> int:
    """POINTS, or WIDTH times HEIGHT, which must agree."""
    found = {
        key: read_count(path, " ".join(header[key]), key)
        for key in ("WIDTH", "HEIGHT", "POINTS")
        if key in header
    }
    image = found["WIDTH"] * found.get("HEIGHT", 1) if "WIDTH" in found else None
    count = found.get("POINTS", image)
    if count is None:
        raise ValueError(f"{path}: the header lacks POINTS")
    if image is not None and image != count:
        raise ValueError(f"{path}: POINTS is {count:,}, WIDTH times HEIGHT {image:,}")
    return count


def _read_text(path: Path, data: bytes, start: int, layout: _Layout) -> Points:
    check_length(path, len(data) - start, layout.count, 1)
    text = io.TextIOWrapper(io.BytesIO(data), "ascii", "replace")
    text.seek(start)
    x, y, z = (sum(layout.counts[:place]) for place in layout.places)
    if max(x, y, z) > _MOST_HEADER:
        raise ValueError(f"{path}: x, y or z would stand in column {max(x, y, z):,}; the header is damaged")
    rows = islice((line for line in text if not line.isspace()), layout.count)
    points = read_rows(path, rows, (x, y, z))
    if len(points) != layout.count:
        raise ValueError(f"{path}: claims {layout.count:,} points, holds {len(points):,}")
    return points


def _read_binary(path: Path, data: bytes, start: int, layout: _Layout) -> Points:
    fields = [(layout.types[place], sum(layout.sizes[:place])) for place in layout.places]
    return read_records(path, data, start, layout.count, sum(layout.sizes), fields)


def _decompress(path: Path, data: bytes, start: int, layout: _Layout) -> bytes:
    check_length(path, len(data) - start, 1, 8)
    packed, size = struct.unpack_from("<II", data, start)
    check_length(path, len(data) - start - 8, 1, packed)
    if size != layout.count * sum(layout.sizes) or size > packed * _MOST_GROWTH:
        raise ValueError(
            f"{path}: {packed:,} bytes are said to hold {size:,}, {layout.count:,} points need "
            f"{layout.count * sum(layout.sizes):,}; the header is damaged"
        )
    try:
        import lzf  # type: ignore[import-not-found]
    except ModuleNotFoundError as fault:
        raise ModuleNotFoundError(
            f'{path}: compressed PCD files need the package python-neo-lzf: pip install "pnet[formats]"'
        ) from fault
    try:
        unpacked = lzf.decompress(data[start + 8 : start + 8 + packed], size) if size else b""
    except ValueError:
        unpacked = None
    if unpacked is None or len(unpacked) != size:
        raise ValueError(f"{path}: the compressed points are damaged")
    return bytes(unpacked)


def _read_columns(path: Path, data: bytes, layout: _Layout) -> Points:
    """Points whose fields follow one another: all x, then all y. data: checked for its length."""
    points = np.empty((layout.count, 3))
    for axis, place in enumerate(layout.places):
        start = layout.count * sum(layout.sizes[:place])
        points[:, axis] = np.frombuffer(data, layout.types[place], layout.count, start)
    return points
