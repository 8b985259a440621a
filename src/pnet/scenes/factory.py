"""From a task to a cycle's scenes: simulate, render, sample."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import trimesh

from pnet.geometry.camera import Camera
from pnet.ops.sampling import farthest_point_order
from pnet.parts.base import ParametricPart, Points
from pnet.records import Scene, SceneId
from pnet.scenes.clutter import scatter_bodies
from pnet.scenes.pile import Bin, Pile
from pnet.scenes.piling import Physics, pile_bodies
from pnet.scenes.protocol import CycleTask, Protocol
from pnet.scenes.rendering import render_view
from pnet.scenes.store import CycleHeader

LOOKING_DOWN = np.diag([1.0, -1.0, -1.0])  # world → camera: x stays, y and z turn round


@dataclass
class StageTimes:
    """Seconds spent by stage, summed over scenes."""

    simulate: float = 0.0
    render: float = 0.0
    sample: float = 0.0
    write: float = 0.0


@dataclass
class Cycle:
    """A finished cycle: its scenes, and what its header has to tell."""

    header: CycleHeader
    scenes: list[Scene]
    times: StageTimes = field(default_factory=StageTimes)


@dataclass(frozen=True, eq=False)
class SceneFactory:
    """Everything that scenes are made from.

    Attributes:
        part, protocol, camera, box, physics: see their classes.
        camera_height: of the camera's centre above the bin's floor, metres; it looks straight down.
        clutter_spacing: see `scatter_bodies`. seed: of the whole data set.
        fingerprint: digest of the settings, kept in every file.
    """

    part: ParametricPart
    protocol: Protocol
    camera: Camera
    box: Bin
    physics: Physics
    camera_height: float
    clutter_spacing: float
    seed: int
    fingerprint: str

    def make_cycle(self, task: CycleTask) -> Cycle:
        """Make one cycle; a pure function of the settings and the task."""
        parameters = self.part.part_object(task.grid, task.part_index)
        mesh = self.part.mesh(parameters)
        times = StageTimes()
        scenes: list[Scene] = []
        escaped = unsettled = empty = 0
        for pile in self._timed(self._piles(task, parameters), times):
            escaped, unsettled = pile.escaped, unsettled + (not pile.settled)
            scene = self._view(pile, mesh, parameters, task.scene_id(pile.drop), times)
            if scene is None:
                empty += 1
            else:
                scenes.append(scene)
        drops = tuple(scene.id.drop for scene in scenes)
        place = (task.split, task.kind, task.cycle, task.part_index)
        header = CycleHeader(
            self.fingerprint, self.part.name, self.camera, *place, drops, escaped, unsettled, empty
        )
        return Cycle(header, scenes, times)

    def _piles(self, task: CycleTask, parameters: Points) -> Iterator[Pile]:
        """The piles of which views are taken."""
        rng = task.rng(self.seed, self.part.name)
        drops = self.protocol.scene_drops()
        if task.kind == "clutter":
            for drop in drops:
                yield scatter_bodies(self.part, parameters, self.box, drop, self.clutter_spacing, rng)
            return
        for pile in pile_bodies(self.part, parameters, self.box, drops[-1], self.physics, rng):
            if pile.drop in drops:
                yield pile

    def _timed(self, piles: Iterator[Pile], times: StageTimes) -> Iterator[Pile]:
        while True:
            start = time.perf_counter()
            pile = next(piles, None)
            times.simulate += time.perf_counter() - start
            if pile is None:
                return
            yield pile

    def _view(
        self,
        pile: Pile,
        mesh: trimesh.Trimesh,
        parameters: Points,
        scene_id: SceneId,
        times: StageTimes,
    ) -> Scene | None:
        """Render and sample one pile; None where the camera sees no body."""
        start = time.perf_counter()
        R = LOOKING_DOWN @ pile.R
        t = pile.t @ LOOKING_DOWN.T + [0.0, 0.0, self.camera_height]
        view = render_view(self.camera, mesh, R, t)
        rendered = time.perf_counter()
        times.render += rendered - start
        pixels = np.flatnonzero(view.instance >= 0)
        if not len(pixels):
            return None
        cloud = self.camera.depth_to_points(view.depth).reshape(-1, 3)[pixels].astype(np.float32)
        order = farthest_point_order(cloud, self.protocol.points)
        times.sample += time.perf_counter() - rendered
        return Scene(
            points=cloud[order],
            instance=view.instance.reshape(-1)[pixels[order]],
            R=R,
            t=t,
            parameters=np.tile(parameters, (len(R), 1)),
            visibility=view.visibility,
            occlusion=view.occlusion,
            camera=self.camera,
            part=self.part.name,
            id=scene_id,
        )
