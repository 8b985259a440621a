"""The Siléane bin-picking data set (Brégier et al. 2017) as its authors laid it out.

An object's folder holds `camera_params.txt`, `depth/`, perhaps `depth_gt/`, `segmentation/` and `gt/`. Scenes
are named like bunny_3_070: cycle 3, 70 bodies; those with 0 bodies show the empty bin.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pnet.data.json_files import read_json
from pnet.data.public.checks import PARAMETERS, FixedPart, check_points, check_poses_fit, fixed_part
from pnet.data.public.coded_depth import read_coded_depth, read_codes
from pnet.data.public.labelled_image import LabelledImage, instance_indices, scene_of_image
from pnet.data.public.listing import check_counterparts, check_distinct, files_by_stem
from pnet.data.public.object_frame import ObjectFrame
from pnet.data.public.public_scenes import Listed, PublicScenes, public_manifest
from pnet.data.public.sileane_camera import PlacedCamera, read_camera
from pnet.data.public.sileane_truth import Truth, read_truth
from pnet.data.source import Keep, SceneSet
from pnet.parts.base import ParametricPart
from pnet.records import Scene, SceneId

SPLITS = ("train", "val", "test_l")
DEPTHS = ("depth", "depth_gt")
CAMERA = "camera_params.txt"
MISSING = (65535,)  # code of a pixel without depth
_NAME = r".+_([0-9]{1,6})_([0-9]{1,6})"
_IMAGE = re.compile(rf"({_NAME})\.(?:png|PNG)")
_TRUTH = re.compile(rf"({_NAME})\.json")
_EMPTY = re.compile(r".+_0+")


def _everywhere() -> dict[str, Sequence[int] | None]:
    return {"test_l": None}


@dataclass(frozen=True)
class SileaneData:
    """A `DataSource` over one object of the Siléane data set.

    Attributes:
        root: the object's folder. points: N of a scene.
        depth: "depth", with the sensor's noise, or "depth_gt", where the authors give it.
        splits: split → numbers of its cycles; None: all cycles. By default all are for tests.
        frame: from the data set's object frame to the part frame.
    """

    root: str
    points: int = 16384
    depth: str = "depth"
    splits: Mapping[str, Sequence[int] | None] = field(default_factory=_everywhere)
    frame: ObjectFrame = field(default_factory=ObjectFrame)

    def __post_init__(self) -> None:
        check_points(self.points)
        if self.depth not in DEPTHS:
            raise ValueError(f"data.source.depth is {self.depth!r}, choose {' or '.join(DEPTHS)}")
        if not isinstance(self.splits, Mapping):
            raise ValueError(f"data.source.splits is {self.splits!r}, expected cycles by split")
        for split, cycles in self.splits.items():
            if split not in SPLITS or not _are_cycles(cycles):
                raise ValueError(
                    f"data.source.splits has {split}: {cycles!r}, expected {', '.join(SPLITS)} with lists of "
                    "cycles, for instance {val: [0], test_l: [1, 2]}, or null for all cycles"
                )

    def manifest(self) -> dict[str, Any]:
        """See `DataSource`."""
        listed = [
            one
            for split, cycles in self.splits.items()
            if cycles or cycles is None
            for one in self._listed(split)
        ]
        settings = {
            "points": self.points,
            "depth": self.depth,
            "splits": {split: None if c is None else list(c) for split, c in self.splits.items()},
            "frame": {name: np.asarray(value, float).tolist() for name, value in asdict(self.frame).items()},
        }
        root = Path(self.root)
        sizes = root / PARAMETERS
        if sizes.is_file():
            settings["parameters"] = read_json(sizes)
        return public_manifest("sileane", settings, root, listed, read_camera(root / CAMERA).camera)

    def scenes(self, split: str, part: ParametricPart, every: int = 1, keep: Keep | None = None) -> SceneSet:
        """See `DataSource`; `part` has one part object, as all bodies have the same size."""
        shown, listed = fixed_part(part, Path(self.root)), self._listed(split)
        camera = read_camera(Path(self.root) / CAMERA)
        nothing = self._background({one.id.cycle for one in listed}, camera)
        return PublicScenes(listed, _Reader(self, camera, shown, nothing), self.points, every, keep)

    def _listed(self, split: str) -> list[Listed]:
        """The scenes of a split, by cycle and number of bodies."""
        if split not in SPLITS:
            raise ValueError(f"{self.root}: this data set has no split {split}, only {', '.join(SPLITS)}")
        cycles = self.splits.get(split, [])
        if cycles is not None and not list(cycles):
            raise ValueError(
                f"{self.root}: split {split} has no cycles; set them, for instance "
                f"data.source.splits.{split}=[0,1] (null: all)"
            )
        there = self._all_scenes(split)
        numbers = {one.id.cycle for one in there}
        strangers = sorted(set(cycles or ()) - numbers)
        if strangers:
            raise ValueError(
                f"{self.root}: has no cycle {strangers[0]} (data.source.splits.{split}), only "
                f"{', '.join(map(str, sorted(numbers)))}"
            )
        return [one for one in there if cycles is None or one.id.cycle in cycles]

    def _all_scenes(self, split: str) -> list[Listed]:
        """Every scene but those of the empty bin, with all of its files."""
        root = Path(self.root)
        patterns = {f"{self.depth}/{{}}.PNG": _IMAGE, "segmentation/{}.PNG": _IMAGE, "gt/{}.json": _TRUTH}
        files = {
            str(root / name): {
                stem: path
                for stem, path in files_by_stem(root / Path(name).parent, pattern).items()
                if not _EMPTY.fullmatch(stem)
            }
            for name, pattern in patterns.items()
        }
        check_counterparts(files)
        stems = next(iter(files.values()))
        listed = [Listed(SceneId(split, "pile", *_numbers(stem)), root, stem) for stem in stems]
        if not listed:
            raise FileNotFoundError(f"{root / self.depth}: no images there named like bunny_3_070.PNG")
        check_distinct(listed)
        return sorted(listed, key=lambda one: (one.id.cycle, one.id.drop))

    def _background(self, cycles: set[int], camera: PlacedCamera) -> dict[int, frozenset[int]]:
        """Cycle → the values of the empty bin's segmentation, where there is one."""
        found = files_by_stem(Path(self.root) / "segmentation", _IMAGE)
        empty = [(_numbers(stem)[0], path) for stem, path in found.items() if _EMPTY.fullmatch(stem)]
        return {
            cycle: frozenset(np.unique(read_codes(path, camera.camera, np.uint16)).tolist())
            for cycle, path in empty
            if cycle in cycles
        }


def _are_cycles(cycles: Any) -> bool:
    if cycles is None:
        return True
    return isinstance(cycles, list | tuple) and all(type(c) is int and c >= 0 for c in cycles)


def _numbers(stem: str) -> tuple[int, int, int]:
    """Cycle, part object and bodies of a scene's name."""
    cycle, drop = stem.rsplit("_", 2)[1:]
    return int(cycle), 0, int(drop)


def _image(folder: Path, stem: str) -> Path:
    """An image's file, whichever way its ending is written."""
    small = folder / f"{stem}.png"
    return small if small.is_file() else folder / f"{stem}.PNG"


@dataclass(frozen=True, eq=False)
class _Reader:
    """Reads one scene. data: its settings. camera: of all. part: what they show. nothing: see
    `SileaneData._background`."""

    data: SileaneData
    camera: PlacedCamera
    part: FixedPart
    nothing: Mapping[int, frozenset[int]]

    def __call__(self, one: Listed) -> Scene:
        camera, truth_path = self.camera.camera, one.folder / "gt" / f"{one.name}.json"
        truth = read_truth(truth_path, one.id.drop)
        R, t = self.data.frame.part_poses(*self.camera.from_world(truth.R, truth.t))
        image = LabelledImage(
            depth=read_coded_depth(_image(one.folder / self.data.depth, one.name), camera, MISSING),
            instance=self._instances(one, truth, truth_path),
            R=R,
            t=t,
            parameters=np.tile(self.part.parameters, (len(R), 1)),
            occlusion=truth.occlusion,
        )
        scene = scene_of_image(image, camera, self.part.name, one.id, self.data.points)
        check_poses_fit(scene, self.part.radius, str(truth_path))
        return scene

    def _instances(self, one: Listed, truth: Truth, truth_path: Path) -> Any:
        """Index of the body at every pixel, by the segmentation.

        The authors do not say which value pixels beside bodies have: 0 and what the empty bin's segmentation
        holds are taken for it, unless the truth names a body so. The empty bin serves for nothing else.
        """
        path = _image(one.folder / "segmentation", one.name)
        codes = read_codes(path, self.camera.camera, np.uint16)
        background, ids = self.nothing.get(one.id.cycle, frozenset()) | {0}, set(truth.ids.tolist())
        if background & ids and not np.isin(codes, list(background - ids)).any():
            raise ValueError(
                f"{path}: the empty bin's segmentation has the value {min(background & ids)} too, which "
                f"{truth_path} gives a body; which pixels are of the body is not known"
            )
        return instance_indices(codes, truth.ids, background, path, truth_path)
