"""What pnet-predict is given: files, cameras, and how they become clouds."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray
from omegaconf import DictConfig

from pnet.cli.app import closest, config_dir, hydra_value
from pnet.cli.instantiate import instantiate
from pnet.geometry.camera import Camera

if TYPE_CHECKING:
    from pnet.data.camera_files import CameraFile
    from pnet.engine.depth_estimator import DepthEstimator, SampledCloud

DEPTH_ENDINGS = (".png", ".tif", ".tiff", ".exr")
CLOUD_ENDINGS = (".ply", ".pcd", ".xyz", ".txt")
ENDINGS = (*DEPTH_ENDINGS, *CLOUD_ENDINGS, ".npy")
KINDS = ("auto", "depth", "cloud")

T = TypeVar("T")
Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class Prepared:
    """An input that was read and sampled.

    Attributes:
        path: of the file. cloud: what goes to the method. depth: (h, w) metres; None for a cloud.
    """

    path: Path
    cloud: "SampledCloud"
    depth: NDArray[np.float64] | None


@dataclass(frozen=True)
class DepthCoding:
    """How numbers of a depth image become metres; see `read_depth`."""

    scale: float | None = None
    offset: float = 0.0
    radial: bool = False
    missing: Sequence[float] | None = None
    of_integers: bool = False


@dataclass(frozen=True)
class Reading:
    """How files are read.

    Attributes:
        kind: "auto", "depth" or "cloud". camera: of depth images, or None where nobody knows it.
        coding: of depth images. unit: of clouds.
    """

    kind: str
    camera: Camera | None
    coding: DepthCoding
    unit: str

    def prepare(self, path: Path, estimator: "DepthEstimator") -> Prepared:
        """Read a file, take the background away and sample."""
        start, depth = perf_counter(), None
        if self._is_cloud(path):
            points = self._cloud(path)
            seconds = perf_counter() - start
            cloud = estimator.prepare_cloud(points)
        else:
            depth = self._depth(path)
            seconds = perf_counter() - start
            cloud = estimator.prepare(depth, self.camera)
        return Prepared(path, replace(cloud, seconds={"reading": seconds, **cloud.seconds}), depth)

    def _cloud(self, path: Path) -> NDArray[np.float32]:
        from pnet.data.cloud_files import check_cloud, read_cloud

        points = read_cloud(path, self.unit).points
        check_cloud(points, path)
        return points

    def _depth(self, path: Path) -> NDArray[np.float64]:
        from pnet.data.depth_files import check_depth, read_depth

        if self.camera is None:
            raise ValueError(f"{path}: its camera is not known: give camera=, a choice or a file")
        depth = read_depth(path, self.camera, **asdict(self.coding))
        if np.isfinite(depth).any():  # in a blank image nothing is found, which is no fault
            check_depth(depth, path, self.camera)
        return depth

    def _is_cloud(self, path: Path) -> bool:
        if self.kind != "auto":
            return self.kind == "cloud"
        if path.suffix.lower() != ".npy":
            return path.suffix.lower() in CLOUD_ENDINGS
        from pnet.data.cloud_files import MOST_COLUMNS
        from pnet.data.images import npy_shape

        shape = npy_shape(path)
        return len(shape) == 3 or (len(shape) == 2 and 3 <= shape[1] <= MOST_COLUMNS)


def build_reading(cfg: DictConfig, file: "CameraFile | None", usual: Camera | None) -> Reading:
    """How the settings of pnet-predict have files read.

    Args:
        file: the camera that they name, or None. usual: the camera of the training's scenes, or None.
    """
    if cfg.kind not in KINDS:
        raise ValueError(f"kind={cfg.kind}{closest(str(cfg.kind), list(KINDS))}: choose {', '.join(KINDS)}")
    scale, offset, told = cfg.depth.scale, cfg.depth.offset, False
    if scale is None and file is not None and file.depth_scale is not None:
        scale, told = file.depth_scale / 1000, True  # from mm; a camera file speaks of 16-bit images
        offset = file.depth_offset if offset is None else offset
    missing = None if cfg.depth.missing is None else list(cfg.depth.missing)
    camera = usual if file is None else file.camera
    coding = DepthCoding(scale, offset or 0.0, bool(cfg.depth.radial), missing, told)
    return Reading(cfg.kind, camera, coding, cfg.cloud.unit)


def find_inputs(path: Path, kind: str = "auto", others: Sequence[Path] = ()) -> list[Path]:
    """The file, or a folder's files that may be images or clouds, by name.

    Args:
        kind: "cloud" takes text files of a folder too. others: files that are no inputs, wherever they lie.
    """
    if path.is_file():
        if path.suffix.lower() not in ENDINGS:
            raise ValueError(f"{path}: ends in {path.suffix or 'nothing'}, expected {', '.join(ENDINGS)}")
        return [path]
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such file or folder; give input=")
    wanted = set(ENDINGS) if kind == "cloud" else set(ENDINGS) - {".txt"}
    known = {other.resolve() for other in others}
    files = (p for p in path.iterdir() if p.is_file() and p.suffix.lower() in wanted)
    found = sorted(p for p in files if p.resolve() not in known)
    if not found:
        raise FileNotFoundError(f"{path}: holds no depth image or cloud ({', '.join(ENDINGS)})")
    names: dict[str, Path] = {}
    for one in found:
        if one.stem in names:
            raise ValueError(f"{one}: {names[one.stem].name} would have the same results; rename one")
        names[one.stem] = one
    return found


def camera_words(arguments: list[str]) -> list[str]:
    """The command line with camera=FILE as the setting camera.file, as `camera` is a group of choices."""
    words = []
    for word in arguments:
        key, equals, value = word.partition("=")
        is_file = key == "camera" and equals and value not in ("null", *_cameras())
        words.append(f"+camera.file={hydra_value(value)}" if is_file else word)
    return words


def chosen_camera(cfg: DictConfig) -> "CameraFile | None":
    """The camera of a command's settings: a choice of conf/camera, a file, or None."""
    from pnet.data.camera_files import CameraFile, read_camera

    node = cfg.get("camera")
    if node is None:
        return None
    if "file" not in node:
        return CameraFile(instantiate(node), None)
    path = Path(str(node.file))
    if not path.is_file():
        near = closest(str(node.file), _cameras())
        raise FileNotFoundError(
            f"camera={node.file}: neither a file nor a choice{near}; there are {', '.join(_cameras())}"
        )
    return read_camera(path)


def _cameras() -> list[str]:
    return sorted(path.stem for path in (config_dir() / "camera").glob("*.yaml"))


def ahead(items: Iterable[T], work: Callable[[T], Result], count: int) -> Iterator[tuple[T, Future[Result]]]:
    """Each item with its result, while another thread already works on the next `count`."""
    waiting: deque[tuple[T, Future[Result]]] = deque()
    with ThreadPoolExecutor(1) as thread:
        try:
            for item in items:
                waiting.append((item, thread.submit(work, item)))
                if len(waiting) > count:
                    yield waiting.popleft()
            while waiting:
                yield waiting.popleft()
        finally:
            for _, future in waiting:
                future.cancel()
