"""Many small least-squares fits at once, compiled for the CPU: a pose hypothesis of every vote."""

import numpy as np
from torch import Tensor

from pnet.ops.cpu.compiled import in_parts, kernel
from pnet.ops.cpu.tree import Array

ROWS = 64  # fits that pay for a thread
SWEEPS = 20  # of Jacobi's method, which needs some five


def fit_rigid_many(source: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """See `pnet.postprocess.fit`; by Horn's quaternions (1987)."""
    shape = target.shape[:-2]
    flat = [x.reshape(-1, *x.shape[len(shape) :]).contiguous() for x in (source, target, weight)]
    R, t = target.new_empty(len(flat[0]), 3, 3), target.new_empty(len(flat[0]), 3)
    given, found = [x.numpy() for x in flat], (R.numpy(), t.numpy())
    in_parts(lambda a, b: _fit(given[0], given[1], given[2], *found, a, b), len(R), ROWS)
    return R.view(*shape, 3, 3), t.view(*shape, 3)


@kernel
def _fit(source: Array, target: Array, weight: Array, R: Array, t: Array, start: int, stop: int) -> None:
    S, K, V = np.empty((3, 3)), np.empty((4, 4)), np.empty((4, 4))
    a, b = np.empty(3), np.empty(3)
    for row in range(start, stop):
        total = 0.0
        a[:], b[:], S[:] = 0.0, 0.0, 0.0
        for i in range(source.shape[1]):
            w = weight[row, i]
            total += w
            for k in range(3):
                a[k] += w * source[row, i, k]
                b[k] += w * target[row, i, k]
        for k in range(3):
            a[k] /= max(total, 1e-300)  # nothing counts: any rotation fits
            b[k] /= max(total, 1e-300)
        for i in range(source.shape[1]):
            for j in range(3):
                for k in range(3):
                    off = weight[row, i] * (source[row, i, j] - a[j])
                    S[j, k] += off * (target[row, i, k] - b[k])
        K[0, 0] = S[0, 0] + S[1, 1] + S[2, 2]
        K[1, 1] = S[0, 0] - S[1, 1] - S[2, 2]
        K[2, 2] = S[1, 1] - S[0, 0] - S[2, 2]
        K[3, 3] = S[2, 2] - S[0, 0] - S[1, 1]
        K[0, 1] = K[1, 0] = S[1, 2] - S[2, 1]
        K[0, 2] = K[2, 0] = S[2, 0] - S[0, 2]
        K[0, 3] = K[3, 0] = S[0, 1] - S[1, 0]
        K[1, 2] = K[2, 1] = S[0, 1] + S[1, 0]
        K[1, 3] = K[3, 1] = S[2, 0] + S[0, 2]
        K[2, 3] = K[3, 2] = S[1, 2] + S[2, 1]
        _diagonalise(K, V)
        top = 0
        for k in range(1, 4):
            if K[k, k] > K[top, top]:
                top = k
        w, x, y, z = V[0, top], V[1, top], V[2, top], V[3, top]
        out = R[row]
        out[0, 0], out[0, 1], out[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
        out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
        out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
        for k in range(3):
            t[row, k] = b[k] - (out[k, 0] * a[0] + out[k, 1] * a[1] + out[k, 2] * a[2])


@kernel
def _diagonalise(K: Array, V: Array) -> None:
    """Jacobi's method: K (4, 4) becomes diagonal, the columns of V its eigenvectors."""
    for i in range(4):
        for j in range(4):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(SWEEPS):
        outside, inside = 0.0, 0.0
        for i in range(4):
            inside += K[i, i] * K[i, i]
            for j in range(i):
                outside += K[i, j] * K[i, j]
        if outside <= 1e-29 * inside:  # rounding leaves some 1e-31
            return
        for p in range(3):
            for q in range(p + 1, 4):
                if K[p, q] == 0.0:
                    continue
                slope = (K[q, q] - K[p, p]) / (2 * K[p, q])
                tangent = 1 / (abs(slope) + np.sqrt(1 + slope * slope))
                if slope < 0:
                    tangent = -tangent
                c = 1 / np.sqrt(1 + tangent * tangent)
                s = tangent * c
                for i in range(4):
                    K[i, p], K[i, q] = c * K[i, p] - s * K[i, q], s * K[i, p] + c * K[i, q]
                for i in range(4):
                    K[p, i], K[q, i] = c * K[p, i] - s * K[q, i], s * K[p, i] + c * K[q, i]
                for i in range(4):
                    V[i, p], V[i, q] = c * V[i, p] - s * V[i, q], s * V[i, p] + c * V[i, q]
