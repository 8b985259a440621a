"""Scenes in the layout of the Siléane data set (Brégier et al. 2017).

A folder for each part object, `<part>_<place in its grid>` (`…_clutter` for scenes without physics):

    depth/NAME.PNG          16 bits, as the sensor measures it; 65535: nothing measured
    depth_gt/NAME.PNG       the same, exact
    segmentation/NAME.PNG   16 bits, the bodies' segmentation ids, 0: none
    gt/NAME.json            R, t (metres), segmentation_id and occlusion_rate of every body
    mesh.ply                metres, part frame
    poseutils.json, camera_params.txt, parameters.json (the template's, metres; ours)

NAME is `<part>_<cycle>_<bodies dropped>`. `<part>_<cycle>_000` is the empty bin; it has no `gt` file, so that
scoring counts no scene that shows nothing.

The world frame is the camera frame of each scene: `camera_params.txt` says location 0 and no rotation. That
holds for cameras that move from scene to scene, too.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnet.data.export.depth_view import EXACT, DepthView, Imaging
from pnet.data.export.files import Advance, ply_content, write_json, write_png
from pnet.data.export.object_scenes import ObjectScenes, object_scenes
from pnet.data.poseutils import write_poseutils
from pnet.data.source import SceneSet
from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.records import Scene, SceneId
from pnet.scenes.record_file import remove_left_overs, write_atomically

MISSING = 65535  # a depth that was not measured; the highest segmentation id
IMAGES = ("depth", "depth_gt", "segmentation")


def export_sileane(
    scenes: SceneSet,
    part: ParametricPart,
    out: Path,
    imaging: Imaging = EXACT,
    advance: Advance = lambda scenes: None,
) -> list[Path]:
    """Write the scenes of a split, one folder for each part object.

    The same call writes the same bytes, so one that was interrupted is repeated. Splits whose cycles are
    numbered apart share the folders of their part objects.

    Args:
        scenes: read one by one. part: what they show. out: made where missing.
        imaging: how depth is measured and what lies behind the bodies.
        advance: called with the number of scenes done, after each.
    Returns:
        The part objects' folders.
    Raises:
        ValueError: the scenes of a part object differ in size or camera, or its folder holds another one.
    """
    folders = []
    for shown in object_scenes(scenes, part):
        folder = out / sileane_folder(part.name, shown.ids[0])
        _begin(folder, shown)
        for cycle in sorted({one.cycle for one in shown.ids}):
            name = sileane_name(part.name, SceneId(shown.ids[0].split, "pile", cycle, 0, 0))
            _write_empty_bin(folder, name, shown.camera, imaging)
        for scene in shown:
            _write_scene(folder, scene, imaging.view(scene, shown.mesh))
            advance(1)
        folders.append(folder)
    return folders


def sileane_folder(part: str, scene: SceneId) -> str:
    """Name of the folder of a scene's part object. part: the template's name."""
    return f"{part}_{scene.part_index}" + ("" if scene.kind == "pile" else f"_{scene.kind}")


def sileane_name(part: str, scene: SceneId) -> str:
    """Name of a scene's files, without ending. part: the template's name."""
    return f"{part}_{scene.cycle}_{scene.drop:03d}"


def depth_to_numbers(depth: NDArray[np.float64], camera: Camera) -> NDArray[np.uint16]:
    """Depth in 65535 steps between the camera's near and far.

    Args:
        depth: (h, w) metres; NaN where nothing was measured. camera: gives the range.
    Returns:
        (h, w); `MISSING` for NaN alone: a depth at the far end is rounded down.
    """
    step = (camera.far - camera.near) / MISSING
    with np.errstate(invalid="ignore"):
        numbers = np.clip(np.rint((depth - camera.near) / step), 0, MISSING - 1)
    return np.where(np.isnan(depth), MISSING, numbers).astype(np.uint16)


def segmentation_ids(bodies: int) -> NDArray[np.int64]:
    """(bodies,) ids 65535 (n − k) / n of k = 0, …, n − 1, halves rounded up."""
    n = bodies
    return np.array([(2 * MISSING * (n - k) + n) // (2 * n) for k in range(n)], np.int64)


def camera_text(camera: Camera) -> str:
    """The content of `camera_params.txt`: near and far are the clip planes, the world is the camera frame."""
    values: dict[str, Any] = {
        "width": camera.width,
        "height": camera.height,
        "fu": camera.fx,
        "fv": camera.fy,
        "cu": camera.cx,
        "cv": camera.cy,
        "clip_start": camera.near,
        "clip_end": camera.far,
        "location": "0 0 0",
        "rotation": "1 0 0 0",
    }
    lines = [
        "# pixels and metres; poses are given in the camera frame",
        *(f"{k} {v}" for k, v in values.items()),
    ]
    return "\n".join(lines) + "\n"


def _begin(folder: Path, shown: ObjectScenes) -> None:
    """Write what all scenes of a part object share, unless the folder is another one's."""
    for name in (*IMAGES, "gt"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    remove_left_overs(folder)
    mesh = ply_content(shown.mesh, normals=False)
    for name, content in (("mesh.ply", mesh), ("camera_params.txt", camera_text(shown.camera).encode())):
        path = folder / name
        if path.exists() and path.read_bytes() != content:
            raise ValueError(
                f"{path}: is there already, of another part object or camera; export to another folder or "
                f"delete {folder}"
            )
        write_atomically(path, content)
    write_json(folder / "parameters.json", shown.named_parameters)
    write_poseutils(folder / "poseutils.json", shown.part.pose_space(shown.parameters))


def _write_empty_bin(folder: Path, name: str, camera: Camera, imaging: Imaging) -> None:
    depth = depth_to_numbers(imaging.empty(camera), camera)
    for kind, image in zip(IMAGES, (depth, depth, np.zeros_like(depth)), strict=True):
        write_png(folder / kind / f"{name}.PNG", image)


def _write_scene(folder: Path, scene: Scene, view: DepthView) -> None:
    if scene.id.drop == 0:
        if not len(scene.R):
            return  # the empty bin is there already
        raise ValueError(f"{scene.id}: shows {len(scene.R)} bodies, but 000 is the name of the empty bin")
    name, ids = sileane_name(scene.part, scene.id), segmentation_ids(len(scene.R))
    segmentation = np.append(ids, 0)[view.instance].astype(np.uint16)  # −1, no body, takes the 0
    depths = (depth_to_numbers(depth, scene.camera) for depth in (view.measured, view.exact))
    for kind, image in zip(IMAGES, (*depths, segmentation), strict=True):
        write_png(folder / kind / f"{name}.PNG", image)
    rows = zip(scene.R.tolist(), scene.t.tolist(), ids.tolist(), scene.occlusion.tolist(), strict=True)
    keys = ("R", "t", "segmentation_id", "occlusion_rate")
    # last, since a scene counts from its truth on
    write_json(folder / "gt" / f"{name}.json", [dict(zip(keys, row, strict=True)) for row in rows])
