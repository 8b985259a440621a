"""Detections in the frames of the Siléane data set, for its benchmark."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import torch

from pnet.data.public.object_frame import ObjectFrame
from pnet.data.public.sileane import CAMERA, SileaneData
from pnet.data.public.sileane_camera import PlacedCamera, read_camera
from pnet.records import Detections


def world_detections(data: SileaneData, found: Iterable[Detections]) -> list[Detections]:
    """Detections with poses object → world, metres, as the data set gives its own.

    Args:
        data: the data set. found: in each of some of its scenes, part → camera.
    """
    camera = read_camera(Path(data.root) / CAMERA)
    return [_placed(data.frame, camera, one) for one in found]


def _placed(frame: ObjectFrame, camera: PlacedCamera, found: Detections) -> Detections:
    R, t = frame.object_poses(found.R.cpu().double().numpy(), found.t.cpu().double().numpy())
    R, t = camera.R @ R, t @ camera.R.T + camera.t
    return replace(found, R=torch.from_numpy(R), t=torch.from_numpy(t))
