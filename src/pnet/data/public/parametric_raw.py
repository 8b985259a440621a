"""A scene of the Parametric data set as its archive has it: truth, segmentation and depth in three files."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pnet.data.images import read_exr, read_image
from pnet.data.public.labelled_image import LabelledImage, scene_of_image
from pnet.data.public.object_frame import ObjectFrame
from pnet.data.public.parametric_bodies import check_bodies_fit, part_mesh, silhouettes
from pnet.data.public.parametric_camera import RadialDepth
from pnet.data.public.parametric_listing import DEPTH, SEGMENTATION
from pnet.data.public.parametric_truth import read_truth
from pnet.data.public.public_scenes import Listed
from pnet.parts.base import ParametricPart
from pnet.records import Scene

_OFF = 0.25  # how far a body's id times its step may be from a whole number


@dataclass(frozen=True)
class RawScenes:
    """Reads the scenes of one template: gt/cycle_0000/5_002.csv, and Image0001 in the folder 5_002 of
    segmentation and depth.

    Poses are taken as object → camera, which the data's documents don't say; points far from their body are
    an error. Visibility is the file's, occlusion comes from the silhouette of pnet's own mesh.

    Attributes:
        part: what they show. sensor: the camera. frame: the data's object frame. points: N of a scene.
    """

    part: ParametricPart
    sensor: RadialDepth
    frame: ObjectFrame
    points: int

    def __call__(self, listed: Listed) -> Scene:
        """Read one scene.

        Raises:
            FileNotFoundError, ValueError: names the file and the fault.
        """
        path, camera = listed.folder / f"{listed.name}.csv", self.sensor.camera
        truth = read_truth(path, self.part, most=listed.id.drop)
        mesh = part_mesh(self.part, truth.parameters, str(path))
        R, t = self.frame.part_poses(truth.R, truth.t)
        silhouette = silhouettes(camera, mesh, R, t, str(path))
        instance = self._instances(listed, len(R))
        visible = np.bincount(instance[instance >= 0], minlength=len(R))
        image = LabelledImage(
            depth=self._depth(listed),
            instance=instance,
            R=R,
            t=t,
            parameters=np.tile(truth.parameters, (len(R), 1)),
            occlusion=np.clip(1 - visible / np.maximum(silhouette, 1), 0, 1),
        )
        scene = scene_of_image(image, camera, self.part.name, listed.id, self.points)
        check_bodies_fit(scene, mesh, str(path))
        return replace(scene, visibility=truth.visibility)

    def _depth(self, listed: Listed) -> NDArray[np.float64]:
        path = _image(listed, (DEPTH,), "png")
        return self.sensor.planar(read_image(path, self._shape), str(path))

    def _instances(self, listed: Listed, bodies: int) -> NDArray[np.int64]:
        """(height, width) body of every pixel, −1 for background."""
        path = _image(listed, SEGMENTATION, "exr")
        channels = read_exr(path, self._shape)
        if not {"R", "G", "B"} <= set(channels):
            raise ValueError(f"{path}: has the channels {', '.join(sorted(channels))}, expected R, G and B")
        R, G, B = (channels[name] for name in "RGB")
        if any(x.dtype.kind != "f" or x.shape != self._shape for x in (R, G, B)):
            found = ", ".join(f"{x.dtype} {x.shape}" for x in (R, G, B))
            raise ValueError(f"{path}: R, G and B are {found}, expected floats of shape {self._shape}")
        foreground = (B == 0) & (R == 1)
        scaled = G[foreground].astype(np.float64) * (bodies - 1)
        whole = np.clip(np.rint(scaled), 0, bodies - 1)
        if not (np.abs(scaled - whole) <= _OFF).all():  # NaN is not
            raise ValueError(
                f"{path}: green times {bodies - 1} gives ids of {scaled.min():.4g} to {scaled.max():.4g}, "
                f"expected whole numbers, 0 to {bodies - 1}, for the {bodies} rows of {listed.name}.csv"
            )
        instance = np.full(self._shape, -1, np.int64)
        instance[foreground] = whole
        return instance

    @property
    def _shape(self) -> tuple[int, int]:
        return self.sensor.camera.height, self.sensor.camera.width


def _image(listed: Listed, folders: tuple[str, ...], ending: str) -> Path:
    """A scene's image in the one of the folders beside gt that is there."""
    place = listed.folder.parents[1]
    name = next((name for name in folders if (place / name).is_dir()), folders[0])
    return place / name / listed.folder.name / listed.name / f"Image0001.{ending}"
