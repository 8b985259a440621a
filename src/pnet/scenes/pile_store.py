"""The store of piles: one file a cycle, a few kB a pile, from which any camera's scenes can be rendered."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from pnet.scenes.pile import Pile
from pnet.scenes.record_file import RecordFile, RecordFormat, write_records

PILES = RecordFormat(
    name="pnet-piles",
    version=1,
    what="pile",
    own={"escaped": "I64", "settled": "U8"},
    bodies={"R": "F64", "t": "F64"},
    remedy="run pnet-generate stage=simulate again, which makes only what is missing",
)


@dataclass(frozen=True)
class PileHeader:
    """What a pile file says of itself.

    Attributes:
        fingerprint: digest of the settings that made it. part: the template's name.
        split, kind, cycle, part_index: as in `SceneId`. grid: "L" or "G".
        parameters: (k) of the part object, metres. drops: (piles) bodies dropped before each.
    """

    fingerprint: str
    part: str
    split: str
    kind: str
    grid: str
    cycle: int
    part_index: int
    parameters: tuple[float, ...]
    drops: tuple[int, ...]


def write_piles(path: Path, header: PileHeader, piles: Sequence[Pile]) -> None:
    """Write a cycle's piles; nothing appears under the final name before it is whole."""
    records = [
        {"R": p.R, "t": p.t, "escaped": np.array(p.escaped), "settled": np.array(p.settled)} for p in piles
    ]
    write_records(path, PILES, asdict(header), records)


class PileFile:
    """A pile file, opened lazily; piles are read and checked one by one.

    Args:
        path: the file.
    Raises:
        FileNotFoundError, PermissionError, ValueError: where the file is no whole pile file; names it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = RecordFile(path, PILES)
        try:
            fields = {key: self._file.header[key] for key in PileHeader.__dataclass_fields__}
            fields.update({key: tuple(fields[key]) for key in ("parameters", "drops")})
            self.header = PileHeader(**fields)
            if len(self.header.drops) != len(self._file):
                raise ValueError("pile counts disagree")
        except (LookupError, TypeError, ValueError) as fault:
            raise PILES.damaged(path, str(fault)) from fault

    def __len__(self) -> int:
        return len(self.header.drops)

    def pile(self, index: int) -> Pile:
        """Read one pile and check it against its checksum."""
        arrays = self._file.record(index)
        drop = self.header.drops[index]
        return Pile(arrays["R"], arrays["t"], drop, int(arrays["escaped"]), bool(arrays["settled"]))
