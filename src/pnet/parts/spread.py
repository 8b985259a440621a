"""An order of a grid's part objects of which every beginning is spread over the grid."""

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

_DRAWS = 4096  # of the sequence; what it does not meet comes last


def spread_order(grid: NDArray[np.float64]) -> list[int]:
    """Places of the part objects in an order that spreads: that of the cells which Sobol's sequence visits.

    Where each parameter has four values, the first four objects have each value once, the first eight twice.
    So a share of the objects (Table IV: 1/3, 1/5) covers every parameter's range evenly, and a smaller share
    is part of a larger one.

    Args:
        grid: (n, k) parameters of the part objects, all combinations of each parameter's values, metres.
    Returns:
        a permutation of 0 … n−1.
    """
    axes = [np.unique(column, return_inverse=True) for column in grid.T]
    sizes = np.array([len(values) for values, _ in axes])
    cells = {tuple(cell): place for place, cell in enumerate(np.stack([i for _, i in axes], -1).tolist())}
    draws = qmc.Sobol(len(sizes), scramble=False).random(_DRAWS)
    visited = (cells.get(tuple(cell)) for cell in (draws * sizes).astype(int).tolist())
    found = [place for place in visited if place is not None]
    return list(dict.fromkeys([*found, *range(len(grid))]))
