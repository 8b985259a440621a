"""Which scenes the Parametric data set's folders hold, by names alone: there are hundreds of thousands."""

import os
import re
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from pnet.data.public.listing import check_distinct
from pnet.data.public.public_scenes import Listed
from pnet.records import SceneId

SETS = {
    "train": "training_set",
    "val": "training_set",
    "test_l": "learning_test_set",
    "test_g": "generalization_test_set",
}
LAYOUTS = {"raw": ".csv", "h5": ".h5"}  # and what a scene's file ends in
TRUTH, DEPTH, SEGMENTATION = "gt", "depth_images", ("segmentation_images", "segment_images")
_LEVELS = (".", "h5", "h5_dataset")  # between set and template, for H5
_DEPTH = 3  # folders between template and cycle, at most
_CYCLE = re.compile(r"cycle_([0-9]{1,9})")
_SCENE = re.compile(r"([0-9]{1,9})_([0-9]{1,9})")  # part and drop: 5_002


def find_templates(root: Path) -> list[str]:
    """Names of the template folders in any of the sets, sorted."""
    places = [root / name / level for name in set(SETS.values()) for level in _LEVELS]
    return sorted({name for place in places for name in _folders(place) if name.startswith("TemplateNum")})


def find_layout(root: Path, split: str, template: str) -> str:
    """How a template's scenes are kept in the set of a split: "raw" or "h5"; raw where both are there.

    Raises:
        FileNotFoundError: neither is.
    """
    folder = root / SETS[split] / template
    if (folder / TRUTH).is_dir():
        return "raw"
    if _cycles(root, split, template, "h5"):
        return "h5"
    raise FileNotFoundError(
        f"{folder}: holds neither {TRUTH}/cycle_0000 (the raw data) nor a cycle_0000 with H5 files; set "
        f"data.source.root to the folder of {', '.join(dict.fromkeys(SETS.values()))}, "
        "and data.source.template"
    )


def list_split(root: Path, split: str, template: str, layout: str, val_cycles: int) -> list[Listed]:
    """The scenes of a split by cycle, part and drop.

    Args:
        root: the data set's folder. split: a key of `SETS`. template: a folder's name. layout: "raw" or "h5".
        val_cycles: the last so many cycles of the training set are "val", the others "train".
    Returns:
        What is there; nothing where the set's folder is missing or all cycles belong to the other split.
    Raises:
        ValueError: two files claim to be the same scene.
    """
    cycles = _cycles(root, split, template, layout)
    if split in ("train", "val"):
        numbers = sorted({number for number, _ in cycles})
        last = set(numbers[max(len(numbers) - val_cycles, 0) :])
        cycles = [cycle for cycle in cycles if (cycle[0] in last) == (split == "val")]
    listed = [
        Listed(SceneId(split, "pile", number, part, drop), folder, name)
        for number, folder in cycles
        for part, drop, name in _scenes(folder, LAYOUTS[layout], folder.stat().st_mtime_ns)
    ]
    listed.sort(key=lambda one: (one.id.cycle, one.id.part_index, one.id.drop))
    check_distinct(listed)
    return listed


def _cycles(root: Path, split: str, template: str, layout: str) -> list[tuple[int, Path]]:
    """Number and folder of the cycles of a set, by number."""
    place = root / SETS[split]
    if layout == "raw":
        found = list(_cycle_folders(place / template / TRUTH, 0))
    else:
        found = [c for level in _LEVELS for c in _cycle_folders(place / level / template, _DEPTH)]
    return sorted(found)


def _cycle_folders(folder: Path, depth: int) -> Iterator[tuple[int, Path]]:
    """The cycles in a folder and so many levels below it, but not those of the raw data."""
    for name in _folders(folder):
        if match := _CYCLE.fullmatch(name):
            yield int(match[1]), folder / name
        elif depth and name not in (TRUTH, DEPTH, *SEGMENTATION):
            yield from _cycle_folders(folder / name, depth - 1)


def _folders(folder: Path) -> list[str]:
    """Names of a folder's folders, sorted; none where it is missing."""
    if not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        return sorted(entry.name for entry in entries if entry.is_dir())


@lru_cache(maxsize=512)
def _scenes(folder: Path, ending: str, changed: int) -> tuple[tuple[int, int, str], ...]:
    """Part, drop and name of a cycle's scenes but those without a body. changed: when the folder was, ns."""
    with os.scandir(folder) as entries:
        names = [entry.name.removesuffix(ending) for entry in entries if entry.name.endswith(ending)]
    matches = [match for name in names if (match := _SCENE.fullmatch(name))]
    return tuple(sorted((int(m[1]), int(m[2]), m[0]) for m in matches if int(m[2]) > 0))
