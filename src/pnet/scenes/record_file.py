"""A file of records: arrays with checksums under a JSON header, read one record at a time.

It is a safetensors file (nothing in it is ever run) whose single metadata entry is the header, with a
version, a checksum of its own and one per record. It is written under a temporary name and renamed when
whole. A record has some arrays of its own and some with one row for each of its bodies.
"""

import json
import os
import socket
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

SUFFIX = ".safetensors"
TEMPORARY = ".part"  # a file that is still being written
FIRST_BODY = "first_body"
_TYPES = {"F32": np.float32, "F64": np.float64, "I16": np.int16, "I64": np.int64, "U8": np.uint8}
_FAULTS = (SafetensorError, LookupError, TypeError, ValueError, AttributeError, OSError)

Record = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class RecordFormat:
    """What a kind of record file holds.

    Attributes:
        name, version: in the header. what: for messages.
        own: arrays with one entry a record (of one shape in a file) and their types.
        bodies: arrays with one row a body and their types.
        optional: own arrays that a file may lack.
        remedy: what to do where a file is missing or damaged.
    """

    name: str
    version: int
    what: str
    own: Mapping[str, str]
    bodies: Mapping[str, str]
    remedy: str
    optional: Mapping[str, str] = field(default_factory=dict)

    def damaged(self, path: Path, fault: str) -> ValueError:
        """The error for a file that is not whole."""
        return ValueError(f"{path}: not a whole {self.what} file ({fault}); delete it and {self.remedy}")


def write_records(
    path: Path, form: RecordFormat, header: Mapping[str, Any], records: Sequence[Record]
) -> None:
    """Write a file; nothing appears under the final name before it is whole.

    Args:
        path: final name. header: plain values. records: with the format's arrays.
    """
    counts = [len(record[next(iter(form.bodies))]) for record in records]
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    arrays: dict[str, NDArray[Any]] = {FIRST_BODY: first}
    present = {k: v for k, v in form.optional.items() if records and all(k in record for record in records)}
    for name, kind in {**form.own, **present}.items():
        arrays[name] = np.stack([r[name] for r in records]) if records else np.zeros(0)
        arrays[name] = arrays[name].astype(_TYPES[kind])
    for name, kind in form.bodies.items():
        arrays[name] = np.concatenate([r[name] for r in records]) if records else np.zeros(0)
        arrays[name] = arrays[name].astype(_TYPES[kind])
    rows = [(slice(i, i + 1), slice(first[i], first[i + 1])) for i in range(len(records))]
    single = [*form.own, *present]
    content = {
        **header,
        "format": form.name,
        "version": form.version,
        "crc32": [
            _digest([*(arrays[n][one] for n in single), *(arrays[n][many] for n in form.bodies)])
            for one, many in rows
        ],
    }
    content["header_crc32"] = _header_checksum(content)
    # one metadata entry only: the order of several is not fixed, and equal records must give equal bytes
    write_atomically(path, save(arrays, {form.name: json.dumps(content, sort_keys=True)}))


class RecordFile:
    """A file of records, opened lazily; they are read and checked one by one.

    Args:
        path: the file. form: what it has to hold.
    Attributes:
        header: as it was written, with "format", "version" and checksums beside.
    Raises:
        FileNotFoundError, PermissionError, ValueError: where the file is no whole one that this version
            reads; names it.
    """

    def __init__(self, path: Path, form: RecordFormat) -> None:
        self.path, self._form = path, form
        try:
            self._file = safe_open(path, framework="numpy")
            self.header: dict[str, Any] = json.loads((self._file.metadata() or {})[form.name])
            version = self.header["version"]
            newer = version > form.version
            if version == form.version:
                self._check()
        except (FileNotFoundError, PermissionError) as fault:  # safetensors raises the first for both
            if path.exists():
                raise PermissionError(f"{path}: not allowed to read it") from fault
            raise FileNotFoundError(f"{path}: no such {form.what} file; {form.remedy}") from None
        except _FAULTS as fault:
            raise form.damaged(path, str(fault)) from fault
        if version != form.version:
            age, what = ("a newer", "update pnet or make") if newer else ("an older", "make")
            raise ValueError(
                f"{path}: written by {age} pnet (format {version}, this one reads {form.version}); "
                f"{what} the data again"
            )

    def _check(self) -> None:
        if self.header["header_crc32"] != _header_checksum(self.header):
            raise ValueError("the header does not match its checksum")
        there = set(self._file.keys())
        form = self._form
        kinds = {**form.own, **{k: v for k, v in form.optional.items() if k in there}}
        self._own, self._bodies = (
            {n: self._file.get_slice(n) for n in names} for names in (kinds, form.bodies)
        )
        for name, kind in {**kinds, **form.bodies}.items():
            if (self._own.get(name) or self._bodies[name]).get_dtype() != kind:
                raise ValueError("array types disagree")
        self._first = self._file.get_tensor(FIRST_BODY)
        self._crc32 = self.header["crc32"]
        records = {len(self._crc32), len(self._first) - 1, *(_rows(view) for view in self._own.values())}
        bodies = {int(self._first[-1]), *(_rows(view) for view in self._bodies.values())}
        if len(records) > 1 or len(bodies) > 1 or (np.diff(self._first, prepend=0) < 0).any():
            raise ValueError("record or body counts disagree")

    def __len__(self) -> int:
        return len(self._crc32)

    def shape(self, name: str) -> tuple[int, ...]:
        """Shape of one record's own array; () in a file without records."""
        return tuple(self._own[name].get_shape()[1:])

    def record(self, index: int) -> dict[str, NDArray[Any]]:
        """Read one record and check it against its checksum."""
        rows = slice(int(self._first[index]), int(self._first[index + 1]))
        try:
            own = {name: view[index : index + 1] for name, view in self._own.items()}
            none = rows.start == rows.stop  # at an array's end safetensors refuses to slice nothing
            bodies = {n: self._file.get_tensor(n)[:0] if none else v[rows] for n, v in self._bodies.items()}
        except (SafetensorError, ValueError, IndexError, OverflowError) as fault:
            raise self._form.damaged(self.path, f"record {index}: {fault}") from fault
        if _digest([*own.values(), *bodies.values()]) != self._crc32[index]:
            raise self._form.damaged(self.path, f"record {index} does not match its checksum")
        return {**{name: array[0] for name, array in own.items()}, **bodies}


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file under a temporary name, flush it to the disk and rename it."""
    temporary = path.with_name(f".{path.name}.{_host()}.{os.getpid()}{TEMPORARY}")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as fault:
        temporary.unlink(missing_ok=True)
        if isinstance(fault, OSError) and fault.errno is not None and fault.filename is None:
            fault.filename = str(path)  # a full disk says so without it
        raise


def remove_left_overs(folder: Path, pid: int | None = None) -> None:
    """Delete the unfinished files of this machine's processes that are gone (or of one process).

    Those of other machines stay: on a shared disk they may be at work.
    """
    for temporary in folder.rglob(f".*.{_host()}.{pid or '*'}{TEMPORARY}"):
        if pid is not None or not _is_running(temporary):
            temporary.unlink(missing_ok=True)


def _host() -> str:
    return socket.gethostname().split(".")[0] or "localhost"


def _is_running(temporary: Path) -> bool:
    try:
        pid = int(temporary.name.split(".")[-2])
        os.kill(pid, 0)
    except (ValueError, IndexError, ProcessLookupError):
        return False
    except PermissionError:
        return True
    return not _has_ended(pid)


def _has_ended(pid: int) -> bool:
    """Whether a process is dead but not yet collected by its parent; a container's first may never do so."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (OSError, IndexError):  # collected in this moment, or no Linux
        return False
    return state in "ZX"


def _rows(view: Any) -> int:
    return int(view.get_shape()[0])


def _header_checksum(content: Mapping[str, Any]) -> int:
    """Of everything in the header but itself."""
    rest = {key: value for key, value in content.items() if key != "header_crc32"}
    return zlib.crc32(json.dumps(rest, sort_keys=True).encode())


def _digest(arrays: Sequence[NDArray[Any]]) -> int:
    value = 0
    for array in arrays:
        value = zlib.crc32(np.ascontiguousarray(array).tobytes(), value)
    return value
