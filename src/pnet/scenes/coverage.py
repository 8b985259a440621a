"""How evenly a set of scenes shows a part from all sides, modulo its symmetry.

A pile of flat parts hardly shows any of them standing up; here is the number for it. Directions from which
the part is seen are counted in cells of equal area, and the entropy of the counts is compared with that of
uniform ones.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pnet.geometry.symmetry import FiniteSymmetry, RevolutionSymmetry, Symmetry

Points = NDArray[np.float64]

POLAR_CELLS = 12  # of the height over a revolution's equator
SPHERE_CELLS = 96  # of the whole sphere
RARE = 0.25  # of the uniform share: cells that hold less are rare directions


@dataclass(frozen=True)
class Coverage:
    """How evenly directions are covered.

    Attributes:
        instances: how many were counted. cells: of how many directions.
        share: exp(entropy) / cells in (0, 1], as if so large a share of the cells were covered evenly and
            the rest not at all; 1 is uniform, NaN without instances.
        rare: share of the cells that hold less than a quarter of the uniform share; NaN likewise. Below
            some ten instances a cell, chance makes cells rare.
    """

    instances: int
    cells: int
    share: float
    rare: float


def orientation_coverage(R: Points, t: Points, symmetry: Symmetry) -> Coverage:
    """How evenly bodies are seen from all sides.

    Args:
        R: (d, 3, 3), t: (d, 3) part → camera, metres. symmetry: of the part, a revolution's axis is z.
    """
    return direction_coverage(viewing_directions(R, t), symmetry)


def viewing_directions(R: Points, t: Points) -> Points:
    """(d, 3) unit vectors from each body's centre to the camera, part frame.

    Args:
        R: (d, 3, 3), t: (d, 3) part → camera, metres, t not zero.
    """
    return -np.einsum("dji,dj->di", R, t / np.linalg.norm(t, axis=1, keepdims=True))


def direction_coverage(v: Points, symmetry: Symmetry) -> Coverage:
    """How evenly directions lie on the sphere modulo the symmetry.

    The entropy is Miller and Madow's: a histogram of n instances is less even than what it was drawn from,
    its entropy is on average (c − 1) / 2n too small with c cells in use. Where an instance counts in g
    equivalent directions its cells are not independent, c / g stands for c. Without the correction 100
    uniform instances in 12 cells would have 0.95 on average. It takes instances for independent; those of a
    pile that grows body by body come again in every scene, so ten cycles at least make a sound figure.

    Args:
        v: (d, 3) unit vectors, part frame; rows that are not finite are left out. symmetry: of the part.
    """
    v = v[np.isfinite(v).all(1)]
    weight, order = _histogram(v, symmetry)
    n, cells = len(v), len(weight)
    if not n:
        return Coverage(0, cells, math.nan, math.nan)
    used = weight[weight > 0] / n
    entropy = -float(used @ np.log(used)) + max(len(used) / order - 1, 0) / (2 * n)
    return Coverage(n, cells, min(math.exp(entropy) / cells, 1.0), float(np.mean(weight < RARE * n / cells)))


def sphere_directions(count: int) -> Points:
    """(count, 3) unit vectors spread evenly over the sphere: the Fibonacci lattice."""
    i = np.arange(count)
    z = 1 - (2 * i + 1) / count
    angle = np.pi * (3 - math.sqrt(5)) * i
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1)


def _histogram(v: Points, symmetry: Symmetry) -> tuple[Points, int]:
    """Instances in each cell, and in how many equivalent directions each instance was counted."""
    match symmetry:
        case FiniteSymmetry(rotations=G):
            # R g is as good as R, and shows the part from gᵀ v; with g its inverse is in the group
            equivalents = np.einsum("gij,dj->dgi", G.numpy().astype(np.float64), v).reshape(-1, 3)
            cell = cKDTree(sphere_directions(SPHERE_CELLS)).query(equivalents)[1]
            return np.bincount(cell, minlength=SPHERE_CELLS) / len(G), len(G)
        case RevolutionSymmetry(rotoreflection=reflected):
            # slices of a sphere of equal height have equal areas
            height = np.abs(v[:, 2]) if reflected else (v[:, 2] + 1) / 2
            cell = np.clip((height * POLAR_CELLS).astype(np.int64), 0, POLAR_CELLS - 1)
            return np.bincount(cell, minlength=POLAR_CELLS).astype(np.float64), 1
        case _:
            return np.array([float(len(v))]), 1
