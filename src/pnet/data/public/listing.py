"""Which files a data set's folders hold: paired by name, listed in order."""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from pnet.data.public.public_scenes import Listed


def files_by_stem(folder: Path, pattern: re.Pattern[str]) -> dict[str, Path]:
    """The files of a folder whose whole name matches, by the pattern's first group, sorted.

    Raises:
        FileNotFoundError: without the folder. ValueError: where two files have the same first group.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder}: no such folder")
    found: dict[str, Path] = {}
    for name in sorted(os.listdir(folder)):
        match = pattern.fullmatch(name)
        if match is None or name.startswith("."):  # macOS leaves ._copies beside files
            continue
        if match[1] in found:
            raise ValueError(f"{folder / name}: stands for the same scene as {found[match[1]].name}")
        found[match[1]] = folder / name
    return found


def check_counterparts(files: Mapping[str, Mapping[str, Path]]) -> None:
    """Raise FileNotFoundError where a scene has not all of its files.

    Args:
        files: the name that a missing file would have, with {} for the stem, from its folder on → what is
            there, by stem.
    """
    there = {stem: path for some in files.values() for stem, path in some.items()}
    for name, some in files.items():
        missing = sorted(set(there) - set(some))
        if missing:
            raise FileNotFoundError(
                f"{name.replace('{}', missing[0])}: no such file, though there is {there[missing[0]]} "
                f"({len(missing)} such of {len(there)})"
            )


def check_distinct(listed: Sequence[Listed]) -> None:
    """Raise ValueError where two of the scenes have the same id."""
    seen: dict[str, Listed] = {}
    for one in listed:
        other = seen.setdefault(str(one.id), one)
        if other is not one:
            raise ValueError(
                f"{one.folder / one.name}: has the same numbers as {other.folder / other.name}; "
                "keep one object's files in a folder"
            )
