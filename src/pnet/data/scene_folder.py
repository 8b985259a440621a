"""The scenes of one split of pnet's own store, by index."""

from pathlib import Path

from pnet.data.source import Keep, SceneSet
from pnet.data.split_files import SplitFiles
from pnet.records import Scene, SceneId
from pnet.scenes.manifest import MANIFEST, read_manifest
from pnet.scenes.record_file import SUFFIX
from pnet.scenes.store import CycleFile


class SceneFolder(SceneSet):
    """All scenes of a split, read one by one.

    Args:
        root: the data set's folder. split: "train", "val", "test_l" or "test_g".
        part: the template's name that the scenes must show.
        every: keep every so many scenes only, counted from the end of each cycle.
        keep: of the part objects there (places in their grid) those to keep; None: all.
    Raises:
        FileNotFoundError, ValueError: where the split is missing, empty, damaged or of another part.
    """

    def __init__(
        self,
        root: Path,
        split: str,
        part: str,
        every: int = 1,
        keep: Keep | None = None,
    ) -> None:
        paths = sorted((root / split).glob(f"[!.]*{SUFFIX}"))
        if not paths:
            raise FileNotFoundError(
                f"{root / split}: no scenes there; run pnet-generate with the same part and protocol first"
            )
        check_complete(root, split, len(paths))
        files = [CycleFile(path) for path in paths]
        if len({file.header.fingerprint for file in files}) > 1:
            raise ValueError(
                f"{root / split}: made with different settings; delete it and make the data anew"
            )
        for file in files:
            if file.header.part != part:
                raise ValueError(
                    f"{file.path}: shows {file.header.part}, not {part}; set part={file.header.part} "
                    "or another data.root"
                )
        if keep is not None:
            objects = keep({file.header.part_index for file in files})
            files = [file for file in files if file.header.part_index in objects]
        self._points = min((file.points_per_scene for file in files if len(file)), default=0)
        chosen = [list(range(len(file)))[::-1][::every][::-1] for file in files]
        self._index = chosen
        if not any(chosen):
            raise ValueError(f"{root / split}: its files hold no scene; make the data anew")
        self._ids = [file.scene_id(i) for file, indices in zip(files, chosen, strict=True) for i in indices]
        self._files = SplitFiles(CycleFile, [file.path for file in files], [len(some) for some in chosen])

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: int) -> Scene:  # type: ignore[override]
        number, file, place = self._files.locate(index)
        return file.scene(self._index[number][place])

    @property
    def ids(self) -> list[SceneId]:
        """The scenes' ids, in order."""
        return self._ids

    @property
    def points_per_scene(self) -> int:
        """N, the smallest of all files."""
        return self._points


def check_complete(root: Path, split: str, found: int, how: str = "again") -> None:
    """Refuse a split of which generation has not made all files yet. how: to run pnet-generate then."""
    if not (root / MANIFEST).exists():
        return
    planned = read_manifest(root).get("files", {}).get(split, found)
    if found < planned:
        raise ValueError(
            f"{root / split}: only {found} of {planned} cycles are there; run pnet-generate {how}, "
            "which makes what is missing"
        )
