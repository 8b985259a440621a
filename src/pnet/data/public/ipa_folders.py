"""The Fraunhofer IPA data set's folders: parts, cycles, scenes."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from pnet.data.public.listing import check_counterparts, files_by_stem
from pnet.data.public.public_scenes import Listed
from pnet.records import SceneId

DEPTH, SEGMENTATION, TRUTH = "p_depth", "p_segmentation", "gt"
REAL = "_real_world"
EMPTY_BIN = "000"
DEPTH_NAME, SEGMENTATION_NAME, TRUTH_NAME = "{}_depth_uint16.png", "{}_segmentation.png", "{}.csv"
PARAMETERS = "parameter.json"
_PART = re.compile(r"(.+)_part_([0-9]{1,5})")
_CYCLE = re.compile(r"cycle_([0-9]{4})")


@dataclass(frozen=True)
class Cycle:
    """A cycle of scenes.

    Attributes:
        part: the folder that holds p_depth and so on. depth: the folder of its depth images.
        number: 10000 times the part folder's number plus the cycle's own: unlike any other's.
    """

    part: Path
    depth: Path
    number: int

    @property
    def segmentation(self) -> Path:
        """The folder of its segmentations."""
        return self._beside(SEGMENTATION)

    @property
    def truth(self) -> Path:
        """The folder of its poses."""
        return self._beside(TRUTH)

    def _beside(self, kind: str) -> Path:
        """The counterpart of the depth images' folder: of the real world where there is such a one."""
        real = self.part / f"{kind}{REAL}"
        of_real = self.depth.parent.name == f"{DEPTH}{REAL}" and real.is_dir()
        return (real if of_real else self.part / kind) / self.depth.name

    def scenes(self, split: str) -> list[Listed]:
        """Its scenes but the empty bin's, each with all of its files."""
        named = {
            self.depth: DEPTH_NAME,
            self.segmentation: SEGMENTATION_NAME,
            self.truth: TRUTH_NAME,
        }
        files = {
            str(folder / name): {
                stem: path for stem, path in files_by_stem(folder, _pattern(name)).items() if int(stem)
            }
            for folder, name in named.items()
        }
        check_counterparts(files)
        stems = next(iter(files.values()))
        ids = {stem: SceneId(split, "pile", self.number, 0, int(stem)) for stem in stems}
        return [Listed(ids[stem], self.depth, stem) for stem in sorted(stems, key=int)]


def _pattern(name: str) -> re.Pattern[str]:
    """Of the files with such a name."""
    return re.compile(re.escape(name).replace(r"\{\}", "([0-9]{3,6})"))


def part_folders(root: Path) -> list[tuple[int, Path]]:
    """Number and folder of every part below `root`, or of `root` itself, in the numbers' order.

    Raises:
        FileNotFoundError: where there is none. ValueError: where they are of several objects.
    """
    root = root.resolve()
    if not root.is_dir():
        raise FileNotFoundError(f"{root}: no such folder")
    if any((root / f"{DEPTH}{ending}").is_dir() for ending in ("", REAL)):
        match = _PART.fullmatch(root.name)
        return [(int(match[2]) if match else 0, root)]
    found = [
        (match, path) for path in root.iterdir() if path.is_dir() and (match := _PART.fullmatch(path.name))
    ]
    if not found:
        raise FileNotFoundError(f"{root}: holds neither {DEPTH} nor folders named like IPAGearShaft_part_1")
    objects = sorted({match[1] for match, _ in found})
    if len(objects) > 1:
        raise ValueError(
            f"{root}: holds folders of several objects ({', '.join(objects)}); give those of each object a "
            "folder of its own, or set data.source.root to one of them"
        )
    return sorted((int(match[2]), path) for match, path in found)


def cycles_of(parts: Sequence[tuple[int, Path]], images: str) -> list[Cycle]:
    """The cycles of all parts, in order. images: the folder of depth images, in each part's folder."""
    cycles = [
        Cycle(part, folder, 10_000 * number + int(match[1]))
        for number, part in parts
        if (part / images).is_dir()
        for folder in sorted((part / images).iterdir())
        if folder.is_dir() and (match := _CYCLE.fullmatch(folder.name))
    ]
    for first, second in pairwise(cycles):
        if first.number == second.number:
            raise ValueError(f"{second.depth}: has the same numbers as {first.depth}")
    return cycles


def parameter_file(part: Path) -> Path:
    """Where a part's camera is described: in its folder, in its gt folder or beside it."""
    places = [part / PARAMETERS, part / TRUTH / PARAMETERS, part.parent / PARAMETERS]
    for place in places:
        if place.is_file():
            return place
    raise FileNotFoundError(f"{places[0]}: no such file, nor {places[1]}, {places[2]}")
