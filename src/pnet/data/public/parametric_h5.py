"""A scene of the Parametric data set as H5: the points that its converter sampled, with a label each."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pnet.data.public.labelled_image import FARTHEST
from pnet.data.public.object_frame import ObjectFrame
from pnet.data.public.parametric_bodies import check_bodies_fit, part_mesh, silhouettes
from pnet.data.public.parametric_truth import check_bodies
from pnet.data.public.public_scenes import Listed
from pnet.geometry.camera import Camera
from pnet.ops.sampling import farthest_point_order
from pnet.parts.base import ParametricPart
from pnet.records import Scene

Points = NDArray[np.float64]

_MOST_ROWS, _MOST_COLUMNS = 1 << 20, 128
_MOST_CHUNK = 1 << 26  # bytes, of which HDF5 reads at least one
_SAME = 1e-5  # between the rows of a body
_FOCAL = 600.0  # pixels; a nut of 12 mm half a metre away covers some 600
_LABELS = 14  # t, R, visibility, id; then keypoints


@dataclass(frozen=True)
class H5Scenes:
    """Reads the scenes of one template: cycle_0000/5_002.h5, with `data` (n, 3) metres and `labels`
    (n, 14 + 3 m): t, R row by row, visibility, id and m keypoints, which are not read.

    Poses are taken as object → camera. A body without a point has no label, so the scene lacks it. Parameters
    come from the part's grid. The pixels are gone, but visibility V = N_j / N_max over the silhouette of
    pnet's own mesh is in proportion to the visible share; occlusion takes the largest one for a body wholly
    visible, and is too small throughout where none is.

    Attributes:
        part: what they show. grid: "L" or "G". camera: the view. frame: the data's object frame.
        points: N of a scene, put in farthest-point-sampling order.
    """

    part: ParametricPart
    grid: str
    camera: Camera
    frame: ObjectFrame
    points: int

    def __call__(self, listed: Listed) -> Scene:
        """Read one scene.

        Raises:
            FileNotFoundError, ValueError: names the file and the fault.
            ModuleNotFoundError: h5py is missing.
        """
        path = listed.folder / f"{listed.name}.h5"
        cloud, labels = _read_arrays(path)
        rows, owner = _bodies(labels, listed.id.drop, str(path))
        R, t = self.frame.part_poses(rows[:, 3:12].reshape(-1, 3, 3), rows[:, :3])
        parameters = self._parameters(listed.id.part_index, path)
        mesh = part_mesh(self.part, parameters, str(path))
        order = farthest_point_order(cloud, self.points)
        scene = Scene(
            points=cloud[order],
            instance=owner[order],
            R=R,
            t=t,
            parameters=np.tile(parameters, (len(rows), 1)),
            visibility=rows[:, 12],
            occlusion=_occlusion(rows[:, 12], silhouettes(self._coarse, mesh, R, t, str(path))),
            camera=self.camera,
            part=self.part.name,
            id=listed.id,
        )
        check_bodies_fit(scene, mesh, str(path))
        return scene

    @property
    def _coarse(self) -> Camera:
        """The view in larger pixels: only ratios of silhouettes count."""
        c, scale = self.camera, min(1.0, _FOCAL / self.camera.fx)
        return replace(c, fx=scale * c.fx, fy=scale * c.fy, cx=scale * c.cx, cy=scale * c.cy)

    def _parameters(self, index: int, path: Path) -> Points:
        try:
            return self.part.part_object(self.grid, index)
        except ValueError as fault:
            raise ValueError(f"{path}: {fault}") from fault


def _occlusion(visibility: Points, silhouette: NDArray[np.int64]) -> Points:
    """(d,) 1 − visible share, where the largest one is taken for 1; (d,) of both."""
    share = visibility / np.maximum(silhouette, 1)
    return 1 - share / share.max() if share.max() > 0 else np.ones(len(share))


def _bodies(labels: Points, most: int, where: str) -> tuple[Points, NDArray[np.int64]]:
    """The bodies' rows (d, 14), by id, and the body (n,) of every row of `labels` (n, 14).

    Args:
        most: bodies dropped. where: the file, for the error.
    """
    ids = labels[:, 13]
    if not (np.array_equal(ids, np.rint(ids)) and ids.min() >= 0 and ids.max() < most):
        raise ValueError(
            f"{where}: ids are {ids.min():g} to {ids.max():g}, expected whole numbers, 0 to {most - 1} "
            "for the bodies that its name tells"
        )
    _, first, owner = np.unique(ids, return_index=True, return_inverse=True)
    rows = labels[first]
    difference = np.abs(labels - rows[owner]).max(1)
    if difference.max() > _SAME:
        raise ValueError(
            f"{where}: labels of body {ids[difference.argmax()]:g} differ by {difference.max():.2g} "
            "from row to row, expected one pose and visibility a body"
        )
    check_bodies(rows[:, 3:12].reshape(-1, 3, 3), rows[:, :3], rows[:, 12], where)
    return rows, owner.astype(np.int64)


def _read_arrays(path: Path) -> tuple[NDArray[np.float32], Points]:
    """`data` (n, 3) float32 and the first columns of `labels` (n, 14)."""
    try:
        import h5py
    except ModuleNotFoundError as fault:
        raise ModuleNotFoundError(
            f'{path}: H5 files need the package h5py: pip install "pnet[formats]"'
        ) from fault
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with h5py.File(path, "r") as file:
            data, labels = (_read_array(h5py, file, name) for name in ("data", "labels"))
    except Exception as fault:  # the library raises classes of many kinds
        raise ValueError(f"{path}: {' '.join(str(fault).split())[:200]}") from fault
    _check_shapes(data, labels, path)
    for name, values in (("data", data), ("labels", labels[:, :_LABELS])):
        if not (np.abs(values) <= FARTHEST).all():  # NaN is not
            raise ValueError(f"{path}: `{name}` holds NaN, infinity or more than {FARTHEST:g} m")
    return data.astype(np.float32), labels[:, :_LABELS].astype(np.float64)


def _read_array(h5py: Any, file: Any, name: str) -> NDArray[np.floating]:
    """An array of floats that lies in this very file, after a look at its size."""
    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"holds no `{name}`, expected `data` and `labels`")
    found = file[name]
    if not isinstance(found, h5py.Dataset) or found.is_virtual or found.external:
        raise ValueError(f"`{name}` is no array of this file")
    if found.dtype.kind != "f" or found.ndim != 2:
        raise ValueError(f"`{name}` is {found.dtype} {found.shape}, expected floats with two axes")
    rows, columns = found.shape
    chunk = int(np.prod(found.chunks or (1,), dtype=float)) * found.dtype.itemsize
    if not (1 <= rows <= _MOST_ROWS and columns <= _MOST_COLUMNS and chunk <= _MOST_CHUNK):
        raise ValueError(
            f"`{name}` has shape {found.shape} in chunks of {chunk:,} bytes, expected at most "
            f"{_MOST_ROWS:,} x {_MOST_COLUMNS}"
        )
    return np.asarray(found[:])


def _check_shapes(data: NDArray[np.floating], labels: NDArray[np.floating], path: Path) -> None:
    keypoints, rest = divmod(labels.shape[1] - _LABELS, 3)
    if data.shape[1] != 3 or len(data) != len(labels) or keypoints < 0 or rest:
        raise ValueError(
            f"{path}: `data` is {data.shape} and `labels` {labels.shape}, expected (n, 3) and (n, 23), "
            "or 14 columns and three for each keypoint"
        )
