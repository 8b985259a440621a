"""The Fraunhofer IPA bin-picking data set (Kleeberger et al. 2019) as its authors laid it out.

A part folder <object>_part_<k> holds `parameter.json`, `p_depth`, `p_segmentation` and `gt`, perhaps
`p_depth_real_world`, and in each a folder cycle_%04d a cycle. Scenes are numbered by bodies; 000 shows the
empty bin.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnet.data.public.checks import FixedPart, check_points, check_poses_fit, fixed_part
from pnet.data.public.coded_depth import read_coded_depth, read_codes
from pnet.data.public.ipa_camera import read_camera
from pnet.data.public.ipa_folders import (
    DEPTH,
    DEPTH_NAME,
    EMPTY_BIN,
    REAL,
    SEGMENTATION_NAME,
    TRUTH_NAME,
    Cycle,
    cycles_of,
    parameter_file,
    part_folders,
)
from pnet.data.public.ipa_truth import BIN, HIGHEST_ID, read_truth
from pnet.data.public.labelled_image import LabelledImage, instance_indices, scene_of_image
from pnet.data.public.listing import check_distinct
from pnet.data.public.object_frame import ObjectFrame
from pnet.data.public.public_scenes import Listed, PublicScenes, public_manifest
from pnet.data.source import Keep, SceneSet
from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.records import Scene
from pnet.scenes.limits import require_number

SPLITS = ("train", "val", "test_l")
# Codes of pixels without depth: what lies at a clip plane cannot be told from what the plane cuts off.
MISSING = (0, 65535)


@dataclass(frozen=True)
class IpaData:
    """A `DataSource` over one object of the Fraunhofer IPA data set.

    Cycles of all parts count as one row, by part and number; in ids cycle c of part k is 10000 k + c.

    Attributes:
        root: the folder that holds the object's part folders, or one of those.
        val_cycles, test_cycles: the row's last test_cycles are test_l, the val_cycles before them val, the
            others train.
        points: N of a scene.
        real_world: test_l is every cycle of p_depth_real_world, with p_segmentation_real_world and
            gt_real_world where there are such folders, p_segmentation and gt where not. The synthetic
            cycles' split stays; those of test_l are not used.
        background: a pixel is on a body where its depth differs from the empty bin's by more than this,
            metres, and the segmentation names a body. None: the segmentation alone decides.
        frame: from the data set's object frame to the part frame.
    """

    root: str
    val_cycles: int
    test_cycles: int
    points: int = 16384
    real_world: bool = False
    background: float | None = 0.001
    frame: ObjectFrame = field(default_factory=ObjectFrame)

    def __post_init__(self) -> None:
        check_points(self.points)
        for key in ("val_cycles", "test_cycles"):
            value = getattr(self, key)
            if type(value) is not int or value < 0:
                raise ValueError(f"data.source.{key} is {value!r}, expected a number of cycles, 0 or more")
        if self.background is not None:
            require_number("data.source.background", self.background, 0)

    def manifest(self) -> dict[str, Any]:
        """See `DataSource`."""
        settings = asdict(self)
        del settings["root"]
        settings["frame"] = {key: np.asarray(x, float).tolist() for key, x in settings["frame"].items()}
        listed = [one for split, cycles in self._split().items() for one in _scenes(cycles, split)]
        parts = [cycle.part for cycles in self._split().values() for cycle in cycles]
        camera = read_camera(parameter_file(parts[0])) if parts else None
        return public_manifest("ipa", settings, Path(self.root).resolve(), listed, camera)

    def scenes(self, split: str, part: ParametricPart, every: int = 1, keep: Keep | None = None) -> SceneSet:
        """See `DataSource`; `part` has one part object, as all bodies have the same size."""
        if split not in SPLITS:
            raise ValueError(f"{self.root}: this data set has no split {split}, only {', '.join(SPLITS)}")
        shown, cycles = fixed_part(part, Path(self.root)), self._split()[split]
        listed = _scenes(cycles, split)
        if not listed:
            raise ValueError(
                f"{self.root}: no scenes are left for {split}; change data.source.val_cycles "
                f"({self.val_cycles}), test_cycles ({self.test_cycles}) or real_world ({self.real_world})"
            )
        cameras = {folder: read_camera(parameter_file(folder)) for folder in {cycle.part for cycle in cycles}}
        views = {cycle.depth: (cycle, cameras[cycle.part]) for cycle in cycles}
        return PublicScenes(listed, _Reader(self, views, shown), self.points, every, keep)

    def _split(self) -> dict[str, list[Cycle]]:
        """The cycles of every split."""
        parts = part_folders(Path(self.root))
        row, real = cycles_of(parts, DEPTH), cycles_of(parts, DEPTH + REAL)
        train = len(row) - self.val_cycles - self.test_cycles
        if train < 0:
            raise ValueError(
                f"{self.root}: has {len(row)} cycles, fewer than data.source.val_cycles ({self.val_cycles}) "
                f"and test_cycles ({self.test_cycles}) take"
            )
        return {
            "train": row[:train],
            "val": row[train : train + self.val_cycles],
            "test_l": real if self.real_world else row[train + self.val_cycles :],
        }


def _scenes(cycles: list[Cycle], split: str) -> list[Listed]:
    listed = [one for cycle in cycles for one in cycle.scenes(split)]
    check_distinct(listed)
    return listed


@dataclass(frozen=True, eq=False)
class _Reader:
    """Reads one scene. data: its settings. views: depth folder → cycle and camera. part: what they show."""

    data: IpaData
    views: Mapping[Path, tuple[Cycle, Camera]]
    part: FixedPart

    def __call__(self, one: Listed) -> Scene:
        cycle, camera = self.views[one.folder]
        truth_path = cycle.truth / TRUTH_NAME.format(one.name)
        truth = read_truth(truth_path)
        R, t = self.data.frame.part_poses(truth.R, truth.t)
        depth = read_coded_depth(cycle.depth / DEPTH_NAME.format(one.name), camera, MISSING)
        path = cycle.segmentation / SEGMENTATION_NAME.format(one.name)
        codes = read_codes(path, camera, np.uint8)
        # some files have the highest id for nothing
        instance = instance_indices(codes, truth.ids, {BIN, HIGHEST_ID}, path, truth_path)
        if self.data.background is not None:
            instance[self._is_bin(depth, cycle, camera)] = -1
        parameters = np.tile(self.part.parameters, (len(R), 1))
        image = LabelledImage(depth, instance, R, t, parameters, truth.occlusion)
        scene = scene_of_image(image, camera, self.part.name, one.id, self.data.points)
        check_poses_fit(scene, self.part.radius, str(truth_path))
        return scene

    def _is_bin(self, depth: NDArray[np.float64], cycle: Cycle, camera: Camera) -> NDArray[np.bool_]:
        """(h, w) pixels with the depth of the empty bin."""
        path = cycle.depth / DEPTH_NAME.format(EMPTY_BIN)
        if not path.is_file():
            raise FileNotFoundError(
                f"{path}: no such file; it tells the bin from bodies, unless data.source.background is null"
            )
        empty = read_coded_depth(path, camera, MISSING)
        return np.abs(depth - empty) <= self.data.background  # not where either is missing
