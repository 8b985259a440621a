"""The Parametric data set, from the archive as published or from the H5 files that its converter makes.

<root>/<set>/<template>/ with the sets training_set, learning_test_set and generalization_test_set and the
templates TemplateNum06, 16, 34, 42 holds

- raw: gt/cycle_0000/5_002.csv, segment_images/cycle_0000/5_002/Image0001.exr (or segmentation_images) and
  depth_images/cycle_0000/5_002/Image0001.png: part object 5, two bodies dropped;
- h5: cycle_0000/5_002.h5, up to three folders deeper where the converter put them so. A folder h5 or
  h5_dataset may lie between set and template.

The nearest parameter.json above a cycle, up to the root, has the camera.
"""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pnet.data.public.checks import check_points
from pnet.data.public.object_frame import ObjectFrame
from pnet.data.public.parametric_camera import CAMERA_FILE, find_camera
from pnet.data.public.parametric_h5 import H5Scenes
from pnet.data.public.parametric_listing import LAYOUTS, SETS, find_layout, find_templates, list_split
from pnet.data.public.parametric_raw import RawScenes
from pnet.data.public.public_scenes import Listed, PublicScenes, public_manifest
from pnet.data.source import Keep
from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart


@dataclass(frozen=True)
class ParametricData:
    """A `DataSource`: one template's scenes.

    Attributes:
        root: the folder that holds training_set/, learning_test_set/ and generalization_test_set/.
        points: N of a scene. template: the template's folder, say TemplateNum06; None: by the part's name.
        val_cycles: the last so many cycles of the training set are the split "val", the others "train".
        frame: where the data's object frame lies in pnet's part frame.
        layout: "raw" or "h5"; None: what is there, raw first.
        camera: of H5 files without a parameter.json.
    """

    root: str
    points: int = 16384
    template: str | None = None
    val_cycles: int = 1
    frame: ObjectFrame = field(default_factory=ObjectFrame)
    layout: str | None = None
    camera: Camera | None = None

    def __post_init__(self) -> None:
        check_points(self.points)
        if self.val_cycles < 0:
            raise ValueError(f"data.source.val_cycles is {self.val_cycles}, expected 0 or more")
        if self.layout is not None and self.layout not in LAYOUTS:
            raise ValueError(
                f"data.source.layout is {self.layout!r}, expected {' or '.join(LAYOUTS)}, or null"
            )
        if self.template is not None and not re.fullmatch(r"\w[\w.-]*", self.template):
            raise ValueError(f"data.source.template is {self.template!r}, expected a folder's name")

    def manifest(self) -> dict[str, Any]:
        """See `DataSource`: the settings, and which scenes there are of the template (None: of any)."""
        root = Path(self.root)
        templates = [self.template] if self.template is not None else find_templates(root)
        listed = [one for template in templates for split in SETS for one in self._list(split, template)]
        if not listed:
            sets = ", ".join(dict.fromkeys(SETS.values()))
            raise FileNotFoundError(f"{root}: no scenes of {self.template or 'any template'} in {sets}")
        settings = {
            "template": self.template,
            "points": self.points,
            "val_cycles": self.val_cycles,
            "frame": {"R": np.array(self.frame.R).tolist(), "t": np.array(self.frame.t).tolist()},
        }
        found = find_camera(root, listed[0].folder) if self.camera is None else None
        camera = self.camera if found is None else found.camera
        return public_manifest("parametric", settings, root, listed, camera)

    def scenes(
        self, split: str, part: ParametricPart, every: int = 1, keep: Keep | None = None
    ) -> PublicScenes:
        """See `DataSource`."""
        if split not in SETS:
            raise ValueError(f"split is {split!r}, expected one of {', '.join(SETS)}")
        root, template = Path(self.root), self.template or _template_of(part)
        layout = self.layout or find_layout(root, split, template)
        listed = list_split(root, split, template, layout, self.val_cycles)
        if not listed:
            raise FileNotFoundError(
                f"{root / SETS[split] / template}: no scenes of the split {split} in the layout {layout}"
                + (f" with data.source.val_cycles={self.val_cycles}" if split in ("train", "val") else "")
            )
        read = self._reader(layout, listed[0], part)
        return PublicScenes(listed, read, self.points, every, keep)

    def _list(self, split: str, template: str) -> list[Listed]:
        root = Path(self.root)
        try:
            layout = self.layout or find_layout(root, split, template)
        except FileNotFoundError:
            return []  # only part of the archive is here
        return list_split(root, split, template, layout, self.val_cycles)

    def _reader(self, layout: str, first: Listed, part: ParametricPart) -> RawScenes | H5Scenes:
        root, folder = Path(self.root), first.folder.parent
        sensor = find_camera(root, folder)
        if layout == "raw":
            if sensor is None:
                raise FileNotFoundError(f"{folder}: no {CAMERA_FILE} there or above it up to {root}")
            return RawScenes(part, sensor, self.frame, self.points)
        camera = self.camera if sensor is None else sensor.camera
        if camera is None:
            raise FileNotFoundError(
                f"{folder}: no {CAMERA_FILE} there or above it up to {root}; copy it there from the archive, "
                "or set data.source.camera"
            )
        grid = "G" if first.id.split == "test_g" else "L"
        return H5Scenes(part, grid, camera, self.frame, self.points)


def _template_of(part: ParametricPart) -> str:
    """The folder of a template."""
    if match := re.fullmatch(r"tn([0-9]{2})", part.name):
        return f"TemplateNum{match[1]}"
    raise ValueError(
        f"the Parametric data set has no part {part.name}; set data.source.template to the folder of its "
        "template, say TemplateNum06"
    )
