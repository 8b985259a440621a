"""The few records that travel between rooms.

Poses are part → camera; the camera frame has x right, y down, z forward; metres and radians.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from pnet.geometry.camera import Camera


@dataclass(frozen=True)
class SceneId:
    """Where a scene comes from.

    Attributes:
        split: "train", "val", "test_l" or "test_g". kind: "pile" or "clutter".
        cycle: number of the cycle. part_index: the part object's place in its grid. drop: bodies dropped.
    """

    split: str
    kind: str
    cycle: int
    part_index: int
    drop: int

    @property
    def file_stem(self) -> str:
        """Name of the cycle's file, without folder and ending."""
        return f"{self.kind}_{self.cycle:04d}_part_{self.part_index:02d}"

    def __str__(self) -> str:
        return f"{self.split}/{self.file_stem}/{self.drop:03d}"


@dataclass(frozen=True, eq=False)
class Scene:
    """One view of a pile: what the sensor sees and what is true.

    Attributes:
        points: (N, 3) float32, camera frame, metres, in farthest-point-sampling order.
        instance: (N,) int64 index of the body that each point lies on, in [0, d).
        R: (d, 3, 3), t: (d, 3) float64, part → camera, metres.
        parameters: (d, k) float64 metres.
        visibility: (d,) the paper's V = N_j / N_max over the image's pixels, in [0, 1].
        occlusion: (d,) 1 − visible share of the body's own unclipped silhouette, in [0, 1].
        camera: the view. part: the template's name. id: where it comes from.
        incidence: (N,) uint8, 255 times the cosine of the angle between viewing ray and surface normal.
        edge: (N,) uint8 pixels to the nearest jump of the depth image. Both are what `SensorNoise` needs;
            None where nobody knows them.
    """

    points: NDArray[np.float32]
    instance: NDArray[np.int64]
    R: NDArray[np.float64]
    t: NDArray[np.float64]
    parameters: NDArray[np.float64]
    visibility: NDArray[np.float64]
    occlusion: NDArray[np.float64]
    camera: Camera
    part: str
    id: SceneId
    incidence: NDArray[np.uint8] | None = None
    edge: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class Batch:
    """B scenes as a network and its losses take them.

    Attributes:
        points: (B, N, 3) camera frame, metres.
        centroid: (B, N, 3) label: centroid of the instance that the point lies on, metres.
        keypoints: (B, N, m, 3) label: its keypoints under the keypoint rule, metres.
        margin: (B, N, m) by how much the runner-up among the equivalent keypoints is worse, metres;
            infinite where there is none.
        parameters: (B, N, k) label: its parameters, metres.
        visibility: (B, N) label: its visibility.
        scene: (B,) index of each scene in the data set.
        tables: the backbone's tables of the points, or None where it finds them itself.
        rotation: (B, N, 3, 3) label: rotation of the instance, part → camera; None where no method asks.
        scale: (B, 3, 3) Λ of each scene's part object in the part frame, metres (λ times the identity for a
            revolution), by which rotations are compared; None likewise.
        lookalike: (B, N) int64 which exchange of keypoints each point was taught, see
            `KeypointChain.exchanged`; None where there is none.
    """

    points: Tensor
    centroid: Tensor
    keypoints: Tensor
    margin: Tensor
    parameters: Tensor
    visibility: Tensor
    scene: Tensor
    tables: dict[str, Tensor] | None = None
    rotation: Tensor | None = None
    scale: Tensor | None = None
    lookalike: Tensor | None = None

    def pin_memory(self) -> "Batch":
        """A copy in page-locked memory, for asynchronous transfer; the loader calls it."""
        return self.map(lambda tensor: tensor.pin_memory())

    def map(self, change: Callable[[Tensor], Tensor]) -> "Batch":
        """A copy with every tensor changed."""
        own = {name: change(value) for name, value in vars(self).items() if isinstance(value, Tensor)}
        tables = None if self.tables is None else {k: change(v) for k, v in self.tables.items()}
        return Batch(**own, tables=tables)


@dataclass(frozen=True, eq=False)
class PosePrediction:
    """What PPR-Net says of every point.

    Attributes:
        centroid: (B, N, 3) metres, camera frame.
        rotation: (B, N, 3, 3) part → camera, one of the equivalents.
        visibility: (B, N) in [0, 1], or None without that head.
    """

    centroid: Tensor
    rotation: Tensor
    visibility: Tensor | None


@dataclass(frozen=True, eq=False)
class PointPrediction:
    """What ParametricNet says of every point.

    Attributes:
        centroid: (B, N, 3) metres, camera frame.
        keypoints: (B, N, m, 3) metres, camera frame.
        visibility: (B, N) in [0, 1], or None without M_V.
        doubt: (B, N, 1 + m + k) by how much the point expects its centroid, each keypoint and each parameter
            to be off, metres; None where the network has no such head.
        parameters: (B, N, k) the parameters of the point's part object, metres; None where they are measured
            between its keypoints alone, as in the paper.
    """

    centroid: Tensor
    keypoints: Tensor
    visibility: Tensor | None
    doubt: Tensor | None = None
    parameters: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Detections:
    """The instances found in one scene, best score first.

    Attributes:
        R: (d, 3, 3), t: (d, 3) part → camera, metres.
        parameters: (d, k) metres; NaN where the method knows nothing of them.
        score: (d,) higher is surer.
        keypoints: (d, m, 3) voted keypoints, camera frame, metres; NaN where the method has none.
        instance: (N,) int64 index of the detection that each point was clustered to, −1 for none.
    """

    R: Tensor
    t: Tensor
    parameters: Tensor
    score: Tensor
    keypoints: Tensor
    instance: Tensor
