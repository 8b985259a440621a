"""Scenes in the layout of the BOP benchmark (Hodaň et al. 2018), depth only: there is no colour.

    models/obj_OOOOOO.ply, models_info.json       millimetres, see `bop_models`
    SPLIT/SSSSSS/depth/IIIIII.png                 16 bits, in steps of `depth_scale` millimetres; 0: nothing
    SPLIT/SSSSSS/mask/IIIIII_GGGGGG.png           the body's silhouette within the image, 255
    SPLIT/SSSSSS/mask_visib/IIIIII_GGGGGG.png     its visible part, 255
    SPLIT/SSSSSS/scene_camera.json, scene_gt.json, scene_gt_info.json
    camera.json, test_targets_bop19.json

A BOP scene is a cycle of one part object, an image a scene of it. All four numbers follow from a `SceneId`:
see `bop_scene_id`, `bop_object_id`; the image's number is that of the bodies dropped, G a body's place.
"""

from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnet.data.export.bop_masks import NOWHERE, box_of, silhouette
from pnet.data.export.bop_models import add_model
from pnet.data.export.depth_view import EXACT, DepthView, Imaging
from pnet.data.export.files import Advance, write_json, write_png
from pnet.data.export.object_scenes import ObjectScenes, object_scenes, split_of
from pnet.data.source import SceneSet
from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.records import Scene, SceneId
from pnet.scenes.record_file import remove_left_overs

MOST_CYCLES, MOST_OBJECTS = 10_000, 1_000
DEPTH_SCALES = (0.1, 1.0)  # millimetres; the first with which 16 bits reach the camera's far end
TO_BE_FOUND = 0.1  # least visible share of a target
IMAGES = ("depth", "mask", "mask_visib")

Fields = dict[str, Any]


def export_bop(
    scenes: SceneSet,
    part: ParametricPart,
    out: Path,
    imaging: Imaging = EXACT,
    advance: Advance = lambda scenes: None,
) -> Path:
    """Write the scenes of a split.

    The same call writes the same bytes, so one that was interrupted is repeated. Other splits of the same
    part objects may go to the same folder, but one test split only: the benchmark knows no more.

    Args:
        scenes: read one by one. part: what they show. out: made where missing.
        imaging: how depth is measured and what lies behind the bodies.
        advance: called with the number of scenes done, after each.
    Returns:
        The split's folder.
    Raises:
        ValueError: the scenes of a part object differ in size or camera, or `out` holds other part objects of
            the same numbers or another test split.
    """
    targets: list[Fields] = []
    split = split_of(scenes)
    _check_test_split(out, split)
    for shown in object_scenes(scenes, part):
        add_model(out / "models", bop_object_id(shown.ids[0]), shown)
        write_json(out / "camera.json", _camera_json(shown.camera))
        for scene_id, cycle in groupby(shown, lambda scene: bop_scene_id(scene.id)):
            targets += _write_cycle(out / split / f"{scene_id:06d}", shown, cycle, imaging, advance)
    write_json(out / f"{split.partition('_')[0]}_targets_bop19.json", targets)
    return out / split


def bop_scene_id(scene: SceneId) -> int:
    """Number of a scene's cycle: the part object's place, then four digits of the cycle; clutter: + 10⁷."""
    if not (0 <= scene.cycle < MOST_CYCLES and 0 <= scene.part_index < MOST_OBJECTS):
        raise ValueError(
            f"{scene}: BOP's scene ids hold cycles below {MOST_CYCLES} and part objects below {MOST_OBJECTS}"
        )
    return (scene.kind != "pile") * MOST_CYCLES * MOST_OBJECTS + scene.part_index * MOST_CYCLES + scene.cycle


def bop_object_id(scene: SceneId) -> int:
    """Number of a scene's part object: one more than its place in the grid."""
    return scene.part_index + 1


def depth_scale(camera: Camera) -> float:
    """Millimetres of a step of the depth images.

    Raises:
        ValueError: the camera sees farther than 16 bits reach.
    """
    for scale in DEPTH_SCALES:
        if 1000 * camera.far / scale <= np.iinfo(np.uint16).max:
            return scale
    raise ValueError(f"camera.far is {camera.far} m, BOP's depth images hold 65 m; set a lower camera.far")


def _check_test_split(out: Path, split: str) -> None:
    others = [path for path in out.glob("test*") if path.is_dir() and path.name != split]
    if split.startswith("test") and others:
        raise ValueError(
            f"{others[0]}: another test split is there, and {out / 'test_targets_bop19.json'} is its; export "
            f"{split} to another folder"
        )


def _write_cycle(
    folder: Path, shown: ObjectScenes, scenes: Iterable[Scene], imaging: Imaging, advance: Advance
) -> list[Fields]:
    """Write the images of one BOP scene and what is known of them; the targets."""
    for name in IMAGES:
        (folder / name).mkdir(parents=True, exist_ok=True)
    remove_left_overs(folder)
    targets: list[Fields] = []
    files: dict[str, dict[int, Any]] = {"scene_camera": {}, "scene_gt": {}, "scene_gt_info": {}}
    for scene in scenes:
        im_id, view = scene.id.drop, imaging.view(scene, shown.mesh)
        infos = _write_images(folder, im_id, scene, shown, view)
        files["scene_camera"][im_id] = _scene_camera(scene.camera)
        files["scene_gt"][im_id] = list(_truth(scene))
        files["scene_gt_info"][im_id] = infos
        found = sum(info["visib_fract"] >= TO_BE_FOUND for info in infos)
        if found:
            ids = {"im_id": im_id, "inst_count": found, "obj_id": bop_object_id(scene.id)}
            targets.append({**ids, "scene_id": bop_scene_id(scene.id)})
        advance(1)
    for name, content in files.items():
        write_json(folder / f"{name}.json", content)
    return targets


def _write_images(
    folder: Path, im_id: int, scene: Scene, shown: ObjectScenes, view: DepthView
) -> list[Fields]:
    """Write depth and masks; the bodies' entries of scene_gt_info.json."""
    depth, infos = _depth_numbers(view.measured, scene.camera), []
    write_png(folder / "depth" / f"{im_id:06d}.png", depth)
    for body in range(len(scene.R)):
        whole, box = silhouette(scene.camera, shown.mesh, scene.R[body], scene.t[body])
        visible = view.instance == body
        whole |= visible  # a ray along a body's border may be rounded either way
        for kind, mask in (("mask", whole), ("mask_visib", visible)):
            write_png(
                folder / kind / f"{im_id:06d}_{body:06d}.png", np.where(mask, np.uint8(255), np.uint8(0))
            )
        pixels, seen = int(view.silhouette[body]), int(view.visible[body])
        infos.append(
            {
                "bbox_obj": box if seen else NOWHERE,
                "bbox_visib": box_of(visible),
                "px_count_all": pixels,
                "px_count_valid": int((depth[whole] > 0).sum()),
                "px_count_visib": seen,
                "visib_fract": seen / pixels if pixels else 0.0,
            }
        )
    return infos


def _depth_numbers(depth: NDArray[np.float64], camera: Camera) -> NDArray[np.uint16]:
    """(h, w) depth in metres, NaN where nothing was measured → steps of `depth_scale`, 0 for NaN."""
    return np.rint(np.nan_to_num(1000 * depth / depth_scale(camera))).astype(np.uint16)


def _truth(scene: Scene) -> Iterator[Fields]:
    """The bodies' entries of scene_gt.json: part → camera, millimetres."""
    for R, t in zip(scene.R, scene.t, strict=True):
        pose = {"cam_R_m2c": R.reshape(-1).tolist(), "cam_t_m2c": (1000 * t).tolist()}
        yield {**pose, "obj_id": bop_object_id(scene.id)}


def _scene_camera(camera: Camera) -> Fields:
    K = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    return {"cam_K": K, "depth_scale": depth_scale(camera)}


def _camera_json(camera: Camera) -> Fields:
    values = {name: getattr(camera, name) for name in ("cx", "cy", "fx", "fy", "height", "width")}
    return {**values, "depth_scale": depth_scale(camera)}
