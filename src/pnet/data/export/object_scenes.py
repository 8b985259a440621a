"""The scenes of a set, part object by part object: both layouts keep one mesh for many images."""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import NDArray

from pnet.data.source import SceneSet
from pnet.geometry.camera import Camera
from pnet.parts.base import ParametricPart
from pnet.records import Scene, SceneId


@dataclass(frozen=True, eq=False)
class ObjectScenes:
    """The scenes that show one part object, all piles or all clutter.

    Attributes:
        part: the template. scenes: the whole set. ids: of those meant here, by cycle and drop.
        places: of the same in `scenes`. parameters: (k,) of the part object, metres. camera: of all.
    """

    part: ParametricPart
    scenes: SceneSet
    ids: Sequence[SceneId]
    places: Sequence[int]
    parameters: NDArray[np.float64]
    camera: Camera

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """The part object, part frame, metres."""
        return self.part.mesh(self.parameters)

    @property
    def named_parameters(self) -> dict[str, float]:
        """The parameters by name, metres."""
        return dict(zip(self.part.parameter_names, self.parameters.tolist(), strict=True))

    def __iter__(self) -> Iterator[Scene]:
        """Read one scene after the other.

        Raises:
            ValueError: a scene shows another part object, or by another camera.
        """
        for place in self.places:
            yield self._checked(self.scenes[place])

    def _checked(self, scene: Scene) -> Scene:
        if scene.part != self.part.name:
            raise ValueError(
                f"{scene.id}: shows {scene.part}, not {self.part.name}; choose the part {scene.part}"
            )
        if scene.camera != self.camera:
            raise ValueError(
                f"{scene.id}: seen by {scene.camera}, other scenes by {self.camera}; one folder has one "
                "camera, export the scenes of each camera apart"
            )
        for row in scene.parameters:
            if not np.array_equal(row, self.parameters):
                raise ValueError(
                    f"{scene.id}: shows {self.part.text(row)}, other bodies of this part object have "
                    f"{self.part.text(self.parameters)}; one folder has one mesh, export the scenes of each "
                    "part object apart"
                )
        return scene


def object_scenes(scenes: SceneSet, part: ParametricPart) -> Iterator[ObjectScenes]:
    """Divide a set by part object and kind, the part objects in order, piles before clutter.

    Raises:
        ValueError: the set is empty, of several splits, has two scenes of one id, or a part object without
            any body.
    """
    split_of(scenes)
    places: dict[tuple[int, bool], list[int]] = defaultdict(list)
    ids = scenes.ids
    for place, one in enumerate(ids):
        places[one.part_index, one.kind != "pile"].append(place)
    if len(set(ids)) < len(ids):
        raise ValueError("two scenes have the same id, so they would have the same file names")
    for key in sorted(places):
        chosen = sorted(places[key], key=lambda place: (ids[place].cycle, ids[place].drop))
        first = _first_with_bodies(scenes, chosen)
        yield ObjectScenes(
            part, scenes, [ids[place] for place in chosen], chosen, first.parameters[0], first.camera
        )


def split_of(scenes: SceneSet) -> str:
    """The split that all scenes are of; ValueError where there is none or several."""
    splits = sorted({one.split for one in scenes.ids})
    if not splits:
        raise ValueError("there is no scene to export")
    if len(splits) > 1:
        raise ValueError(f"the scenes are of the splits {', '.join(splits)}; export each split apart")
    return splits[0]


def _first_with_bodies(scenes: SceneSet, places: Sequence[int]) -> Scene:
    for place in places:
        scene = scenes[place]
        if len(scene.R):
            return scene
    raise ValueError(
        f"{scenes.ids[places[0]]} and the {len(places) - 1} others of its part object show no body, so its "
        "size is unknown; leave them out"
    )
