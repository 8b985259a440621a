"""Damage for files, as disks, networks and tools do it: nothing worse than an error may follow."""

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

Mutation = Callable[[Path, np.random.Generator], str]
STRANGE = [
    "nan",
    "inf",
    "-inf",
    "1e400",
    "-1",
    "0",
    "1e30",
    "99999999999",
    "",
    "x",
    "1.5",
    "null",
    "[]",
    "-0.0",
    "65536",
]


def truncate(path: Path, rng: np.random.Generator) -> str:
    """Cut the end off."""
    size = path.stat().st_size
    kept = int(rng.integers(0, max(size, 1)))
    os.truncate(path, kept)
    return f"truncated to {kept} of {size} bytes"


def empty(path: Path, rng: np.random.Generator) -> str:
    """Leave nothing."""
    path.write_bytes(b"")
    return "emptied"


def delete(path: Path, rng: np.random.Generator) -> str:
    """Remove the file."""
    path.unlink()
    return "deleted"


def flip_bytes(path: Path, rng: np.random.Generator) -> str:
    """Overwrite some bytes, most often near the beginning, where headers are."""
    content = bytearray(path.read_bytes())
    if not content:
        return "left empty"
    count = int(rng.integers(1, 9))
    reach = len(content) if rng.random() < 0.5 else min(len(content), 200)
    places = rng.integers(0, reach, count)
    for place in places:
        content[place] = int(rng.integers(0, 256))
    path.write_bytes(content)
    return f"bytes overwritten at {sorted(places.tolist())}"


def swap_number(path: Path, rng: np.random.Generator) -> str:
    """Replace a number of a text file (another file's bytes are flipped)."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        return flip_bytes(path, rng)
    numbers = list(re.finditer(r"-?\d+(\.\d+)?([eE][-+]?\d+)?", text))
    if not numbers:
        return flip_bytes(path, rng)
    one = numbers[int(rng.integers(len(numbers)))]
    new = STRANGE[int(rng.integers(len(STRANGE)))]
    path.write_text(text[: one.start()] + new + text[one.end() :], encoding="utf-8")
    return f"{one.group()} at character {one.start()} became {new!r}"


def drop_line(path: Path, rng: np.random.Generator) -> str:
    """Leave a line of a text file out, or repeat it."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    except UnicodeDecodeError:
        return truncate(path, rng)
    if not lines:
        return "left empty"
    place = int(rng.integers(len(lines)))
    again = rng.random() < 0.5
    lines[place : place + 1] = [lines[place]] * 2 if again else []
    path.write_text("".join(lines), encoding="utf-8")
    return f"line {place} {'repeated' if again else 'left out'}"


def swap_files(path: Path, rng: np.random.Generator) -> str:
    """Put another file of the same folder in this one's place."""
    others = sorted(other for other in path.parent.iterdir() if other.is_file() and other != path)
    if not others:
        return truncate(path, rng)
    other = others[int(rng.integers(len(others)))]
    shutil.copyfile(other, path)
    return f"replaced by {other.name}"


def append(path: Path, rng: np.random.Generator) -> str:
    """Add bytes at the end."""
    count = int(rng.integers(1, 100))
    with path.open("ab") as file:
        file.write(rng.bytes(count))
    return f"{count} bytes appended"


MUTATIONS: tuple[Mutation, ...] = (
    truncate,
    empty,
    delete,
    *[flip_bytes] * 2,
    *[swap_number] * 3,
    drop_line,
    swap_files,
    append,
)


def mutate_folder(folder: Path, rng: np.random.Generator) -> str:
    """Damage one file of a folder (one or two, in one case of four); what was done, for the message."""
    done = []
    for _ in range(1 if rng.random() < 0.75 else 2):
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        if not files:
            break
        path = files[int(rng.integers(len(files)))]
        mutation = MUTATIONS[int(rng.integers(len(MUTATIONS)))]
        done.append(f"{path.relative_to(folder)}: {mutation(path, rng)}")
    return "; ".join(done)
