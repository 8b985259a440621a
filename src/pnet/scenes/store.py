"""The store of scenes: one file a cycle."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from pnet.geometry.camera import Camera
from pnet.records import Scene, SceneId
from pnet.scenes.record_file import RecordFile, RecordFormat, write_records

SCENES = RecordFormat(
    name="pnet-cycle",
    version=2,
    what="cycle",
    own={"points": "F32", "instance": "I16"},
    bodies=dict.fromkeys(("R", "t", "parameters", "visibility", "occlusion"), "F64"),
    optional={"incidence": "U8", "edge": "U8"},
    remedy="run pnet-generate again, which makes only what is missing",
)


@dataclass(frozen=True)
class CycleHeader:
    """What a cycle file says of itself.

    Attributes:
        fingerprint: digest of the settings that made it. part: the template's name.
        camera: intrinsics. split, kind, cycle, part_index: as in `SceneId`.
        drops: (scenes) bodies dropped before each scene. escaped: bodies that left the bin in all.
        unsettled: scenes taken before everything was at rest. empty: scenes left out, nothing visible.
    """

    fingerprint: str
    part: str
    camera: Camera
    split: str
    kind: str
    cycle: int
    part_index: int
    drops: tuple[int, ...]
    escaped: int = 0
    unsettled: int = 0
    empty: int = 0


def write_cycle(path: Path, header: CycleHeader, scenes: Sequence[Scene]) -> None:
    """Write a cycle's scenes; nothing appears under the final name before it is whole.

    Args:
        path: final name. header: its drops must match the scenes. scenes: all with the same N.
    """
    names = [*SCENES.own, *SCENES.optional, *SCENES.bodies]
    records = [{n: v for n in names if (v := getattr(scene, n)) is not None} for scene in scenes]
    write_records(path, SCENES, asdict(header), records)


class CycleFile:
    """A cycle file, opened lazily; scenes are read and checked one by one.

    Args:
        path: the file.
    Attributes:
        header: see `CycleHeader`. points_per_scene: N; 0 in a file without scenes.
    Raises:
        FileNotFoundError, PermissionError, ValueError: where the file is no whole cycle file that this
            version reads; names it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = RecordFile(path, SCENES)
        try:
            content = self._file.header
            fields = {key: content[key] for key in CycleHeader.__dataclass_fields__}
            fields["camera"] = Camera(**content["camera"])
            fields["drops"] = tuple(content["drops"])
            self.header = CycleHeader(**fields)
            if len(self.header.drops) != len(self._file):
                raise ValueError("scene counts disagree")
            self.points_per_scene = self._file.shape("points")[0] if len(self) else 0
        except (LookupError, TypeError, ValueError) as fault:
            raise SCENES.damaged(path, str(fault)) from fault

    def __len__(self) -> int:
        return len(self.header.drops)

    def scene_id(self, index: int) -> SceneId:
        """Where scene `index` comes from."""
        h = self.header
        return SceneId(h.split, h.kind, h.cycle, h.part_index, h.drops[index])

    def scene(self, index: int) -> Scene:
        """Read one scene and check it against its checksum."""
        arrays = self._file.record(index)
        arrays["instance"] = arrays["instance"].astype(np.int64)
        return Scene(**arrays, camera=self.header.camera, part=self.header.part, id=self.scene_id(index))
