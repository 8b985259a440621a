"""The vertices of a PLY file: text, or binary of either byte order.

Readers at hand make meshes: they merge or reorder vertices, misread lists of unequal lengths and trust the
header.
"""

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from pnet.data.point_records import NAMES, Points, check_length, read_count, read_records, read_rows

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MOST_HEADER = 100_000  # bytes


@dataclass(frozen=True)
class _Property:
    """A property of an element. length: type of a list's length, None where it is one number."""

    name: str
    type: np.dtype[Any]
    length: np.dtype[Any] | None

    @property
    def least(self) -> int:
        """Bytes that it takes at least."""
        return self.type.itemsize if self.length is None else self.length.itemsize


@dataclass(frozen=True)
class _Element:
    """A table of the file: its name, rows and properties."""

    name: str
    count: int
    properties: list[_Property]

    @property
    def has_lists(self) -> bool:
        return any(one.length is not None for one in self.properties)

    @property
    def least(self) -> int:
        """Bytes that a row takes at least; without lists: exactly."""
        return sum(one.least for one in self.properties)

    def place(self, name: str) -> int:
        """Index of a property."""
        return [one.name for one in self.properties].index(name)


def read_ply(path: Path) -> Points:
    """The coordinates of the vertices, whatever other properties and elements there are.

    A text file has one row a line, and no list before the coordinates.

    Returns:
        (n, 3) as the file holds them.
    Raises:
        OSError, ValueError: names the file and the fault.
    """
    data = path.read_bytes()
    order, elements, start = _read_header(path, data)
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise ValueError(f"{path}: the header names no element vertex")
    before, vertices = elements[: names.index("vertex")], elements[names.index("vertex")]
    lacking = [name for name in NAMES if name not in [one.name for one in vertices.properties]]
    if lacking:
        raise ValueError(f"{path}: the vertices lack the property {', '.join(lacking)}")
    if order == "":
        return _read_text(path, data, start, sum(one.count for one in before), vertices)
    for element in before:
        _, start = _read_binary(path, data, start, element)
    points, _ = _read_binary(path, data, start, vertices)
    return points


def _read_header(path: Path, data: bytes) -> tuple[str, list[_Element], int]:
    """Byte order ("" for text), the elements, and where their rows begin."""
    lines = _header_lines(path, data)
    if next(lines)[0] != ["ply"]:
        raise ValueError(f"{path}: does not begin with the line ply")
    order: str | None = None
    elements: list[_Element] = []
    for words, end in lines:
        match words:
            case ["format", str(name), "1.0"] if name in _ORDERS:
                order = _ORDERS[name]
            case ["element", str(name), str(count)]:
                elements.append(_Element(name, read_count(path, count, f"the count of {name[:40]!r}"), []))
            case ["property", *kind, str(name)] if elements and order is not None:
                elements[-1].properties.append(_read_property(path, name, kind, order))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["end_header"] if order is not None:
                return order, elements, end
            case _:
                raise ValueError(f"{path}: the header's line {' '.join(words)[:80]!r} is not understood")
    raise ValueError(f"{path}: the header has no end_header")


def _header_lines(path: Path, data: bytes) -> Iterator[tuple[list[str], int]]:
    """Words of each line, and where the next line begins."""
    start = 0
    while (end := data.find(b"\n", start, _MOST_HEADER)) >= 0:
        yield data[start:end].decode("ascii", "replace").split(), end + 1
        start = end + 1
    if start == 0:
        raise ValueError(f"{path}: does not begin with the line ply")


def _read_property(path: Path, name: str, kind: list[str], order: str) -> _Property:
    match kind:
        case [str(one)] if one in _TYPES:
            return _Property(name, np.dtype(order + _TYPES[one]), None)
        case ["list", str(length), str(one)] if one in _TYPES and _TYPES.get(length, "f")[0] in "iu":
            return _Property(name, np.dtype(order + _TYPES[one]), np.dtype(order + _TYPES[length]))
    raise ValueError(f"{path}: the property {name[:40]!r} is of an unknown type ({' '.join(kind)[:80]})")


def _read_text(path: Path, data: bytes, start: int, skipped: int, vertices: _Element) -> Points:
    places = sorted(vertices.place(name) for name in NAMES)
    if any(one.length is not None for one in vertices.properties[: places[-1]]):
        raise ValueError(
            f"{path}: the vertices have a list before their coordinates; save the file as binary"
        )
    check_length(path, len(data) - start, skipped + vertices.count, 1)
    text = io.TextIOWrapper(io.BytesIO(data), "ascii", "replace")
    text.seek(start)
    rows = islice((line for line in text if not line.isspace()), skipped, skipped + vertices.count)
    x, y, z = (vertices.place(name) for name in NAMES)
    points = read_rows(path, rows, (x, y, z))
    if len(points) != vertices.count:
        raise ValueError(f"{path}: claims {vertices.count:,} vertices, holds {len(points):,}")
    return points


def _read_binary(path: Path, data: bytes, start: int, element: _Element) -> tuple[Points, int]:
    """Coordinates of an element's rows (empty where it has none), and where the next element begins."""
    check_length(path, len(data) - start, element.count, element.least)
    if element.has_lists:
        return _walk(path, data, start, element)
    end = start + element.count * element.least
    if element.name != "vertex":
        return np.empty((0, 3)), end
    offsets = np.cumsum([0, *(one.least for one in element.properties)])
    places = [element.place(name) for name in NAMES]
    fields = [(element.properties[place].type, int(offsets[place])) for place in places]
    return read_records(path, data, start, element.count, element.least, fields), end


def _walk(path: Path, data: bytes, at: int, element: _Element) -> tuple[Points, int]:
    """As `_read_binary`, row by row: where the next one begins depends on the lengths of this one's lists."""
    steps = [(_structure(one.length or one.type), one.type.itemsize, one) for one in element.properties]
    wanted = (
        {element.place(name): axis for axis, name in enumerate(NAMES)} if element.name == "vertex" else {}
    )
    points = np.empty((element.count if wanted else 0, 3))
    try:
        for row in range(element.count):
            for place, (structure, size, one) in enumerate(steps):
                (value,) = structure.unpack_from(data, at)
                at += structure.size
                if one.length is not None:
                    if value < 0:
                        raise ValueError(f"{path}: a list {one.name[:40]!r} has the length {value}")
                    at += value * size
                elif place in wanted:
                    points[row, wanted[place]] = value
    except struct.error:
        at = len(data) + 1
    if at > len(data):
        raise ValueError(
            f"{path}: ends within the rows of {element.name[:40]!r}; the file is cut off or damaged"
        )
    return points, at


def _structure(kind: np.dtype[Any]) -> struct.Struct:
    # numpy's byte order is "|" for a single byte and "=" for the machine's own
    order = kind.str[0] if kind.str[0] in "<>" else "<"
    return struct.Struct(order + kind.char)
