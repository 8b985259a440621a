"""Many small least-squares fits at once on CUDA, one a lane: Horn's quaternions (1987) by Jacobi's method.

The matrix and its eigenvectors are scalars of a lane, the six rotations of a sweep are written out. All is
computed in the order of the CPU's kernel, so fits are the same to the last bit. That matters where a fit is
not unique: points on a line leave the turn about it to rounding.
"""

import triton
import triton.language as tl
from torch import Tensor

from pnet.ops.cuda.launch import EXACT, block, on_device_of

FITS = 128  # of a program, one for each thread
SWEEPS = tl.constexpr(20)  # of Jacobi's method, which needs some five


def fit_rigid_many(source: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """See `pnet.postprocess.fit`."""
    shape, n = target.shape[:-2], target.shape[-2]
    whole = source.expand_as(target), target, weight.expand(target.shape[:-1])
    flat = [x.reshape(-1, *x.shape[len(shape) :]).contiguous() for x in whole]
    R, t = target.new_empty(*shape, 3, 3), target.new_empty(*shape, 3)
    fits = shape.numel()
    if fits:
        size = block(fits, FITS)
        with on_device_of(target):
            _fit[triton.cdiv(fits, size),](*flat, R, t, fits, POINTS=n, FITS=size, **EXACT)
    return R, t


@triton.jit
def _fit(source, target, weight, R, t, fits, POINTS: tl.constexpr, FITS: tl.constexpr):
    row = tl.program_id(0).to(tl.int64) * FITS + tl.arange(0, FITS)
    own = row < fits
    source, target, weight = source + row * POINTS * 3, target + row * POINTS * 3, weight + row * POINTS
    ax, ay, az = _middle(source, weight, own, POINTS, FITS)
    bx, by, bz = _middle(target, weight, own, POINTS, FITS)
    xx, xy, xz = _products(source, target, weight, own, ax, bx, by, bz, POINTS, FITS)
    yx, yy, yz = _products(source + 1, target, weight, own, ay, bx, by, bz, POINTS, FITS)
    zx, zy, zz = _products(source + 2, target, weight, own, az, bx, by, bz, POINTS, FITS)
    w, x, y, z = _top(
        xx + yy + zz, yz - zy, zx - xz, xy - yx, xx - yy - zz, xy + yx, zx + xz, yy - xx - zz, yz + zy,
        zz - xx - yy, own,
    )  # fmt: skip
    out, shift = R + row * 9, t + row * 3
    _store(out, shift, 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), ax, ay, az, bx, own)
    out, shift = out + 3, shift + 1
    _store(out, shift, 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), ax, ay, az, by, own)
    out, shift = out + 3, shift + 1
    _store(out, shift, 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), ax, ay, az, bz, own)


@triton.jit
def _store(out, shift, r0, r1, r2, ax, ay, az, b, own):
    """One row of the rotation, and its translation."""
    tl.store(out, r0, own)
    tl.store(out + 1, r1, own)
    tl.store(out + 2, r2, own)
    tl.store(shift, b - (r0 * ax + r1 * ay + r2 * az), own)


@triton.jit
def _middle(points, weight, own, POINTS: tl.constexpr, FITS: tl.constexpr):
    """Weighted mean; the origin where nothing counts: any rotation fits."""
    zero = tl.zeros((FITS,), tl.float64)
    total, x, y, z = zero, zero, zero, zero
    for i in tl.static_range(POINTS):
        w = tl.load(weight + i, own, 0.0)
        total += w
        x += w * tl.load(points + i * 3, own, 0.0)
        y += w * tl.load(points + i * 3 + 1, own, 0.0)
        z += w * tl.load(points + i * 3 + 2, own, 0.0)
    total = tl.where(total == 0, 1.0, total)
    return x / total, y / total, z / total


@triton.jit
def _products(source, target, weight, own, a, bx, by, bz, POINTS: tl.constexpr, FITS: tl.constexpr):
    """Σ w (source − a) (target − b) of one axis of the source with each of the target's."""
    zero = tl.zeros((FITS,), tl.float64)
    x, y, z = zero, zero, zero
    for i in tl.static_range(POINTS):
        off = tl.load(weight + i, own, 0.0) * (tl.load(source + i * 3, own, 0.0) - a)
        x += off * (tl.load(target + i * 3, own, 0.0) - bx)
        y += off * (tl.load(target + i * 3 + 1, own, 0.0) - by)
        z += off * (tl.load(target + i * 3 + 2, own, 0.0) - bz)
    return x, y, z


@triton.jit
def _top(k00, k01, k02, k03, k11, k12, k13, k22, k23, k33, own):
    """The eigenvector of the largest eigenvalue of a symmetric matrix, given by its upper half; four numbers.

    Column c of the eigenvectors is v0c, v1c, v2c, v3c. Rounding makes the halves differ by a little.
    """
    k10, k20, k30, k21, k31, k32 = k01, k02, k03, k12, k13, k23
    zero = tl.zeros_like(k00)
    one = zero + 1
    v00, v01, v02, v03 = one, zero, zero, zero
    v10, v11, v12, v13 = zero, one, zero, zero
    v20, v21, v22, v23 = zero, zero, one, zero
    v30, v31, v32, v33 = zero, zero, zero, one
    busy = own & _is_open(k00, k11, k22, k33, k10, k20, k21, k30, k31, k32)
    left = tl.max(busy.to(tl.int32)) * SWEEPS
    while left > 0:
        c, s = _turn(k00, k01, k11, busy)
        k00, k01, k10, k11 = _block(k00, k01, k10, k11, c, s)
        k20, k21, k30, k31 = _pairs(k20, k21, k30, k31, c, s)
        k02, k12, k03, k13 = _pairs(k02, k12, k03, k13, c, s)
        v00, v01, v10, v11 = _pairs(v00, v01, v10, v11, c, s)
        v20, v21, v30, v31 = _pairs(v20, v21, v30, v31, c, s)
        c, s = _turn(k00, k02, k22, busy)
        k00, k02, k20, k22 = _block(k00, k02, k20, k22, c, s)
        k10, k12, k30, k32 = _pairs(k10, k12, k30, k32, c, s)
        k01, k21, k03, k23 = _pairs(k01, k21, k03, k23, c, s)
        v00, v02, v10, v12 = _pairs(v00, v02, v10, v12, c, s)
        v20, v22, v30, v32 = _pairs(v20, v22, v30, v32, c, s)
        c, s = _turn(k00, k03, k33, busy)
        k00, k03, k30, k33 = _block(k00, k03, k30, k33, c, s)
        k10, k13, k20, k23 = _pairs(k10, k13, k20, k23, c, s)
        k01, k31, k02, k32 = _pairs(k01, k31, k02, k32, c, s)
        v00, v03, v10, v13 = _pairs(v00, v03, v10, v13, c, s)
        v20, v23, v30, v33 = _pairs(v20, v23, v30, v33, c, s)
        c, s = _turn(k11, k12, k22, busy)
        k11, k12, k21, k22 = _block(k11, k12, k21, k22, c, s)
        k01, k02, k31, k32 = _pairs(k01, k02, k31, k32, c, s)
        k10, k20, k13, k23 = _pairs(k10, k20, k13, k23, c, s)
        v01, v02, v11, v12 = _pairs(v01, v02, v11, v12, c, s)
        v21, v22, v31, v32 = _pairs(v21, v22, v31, v32, c, s)
        c, s = _turn(k11, k13, k33, busy)
        k11, k13, k31, k33 = _block(k11, k13, k31, k33, c, s)
        k01, k03, k21, k23 = _pairs(k01, k03, k21, k23, c, s)
        k10, k30, k12, k32 = _pairs(k10, k30, k12, k32, c, s)
        v01, v03, v11, v13 = _pairs(v01, v03, v11, v13, c, s)
        v21, v23, v31, v33 = _pairs(v21, v23, v31, v33, c, s)
        c, s = _turn(k22, k23, k33, busy)
        k22, k23, k32, k33 = _block(k22, k23, k32, k33, c, s)
        k02, k03, k12, k13 = _pairs(k02, k03, k12, k13, c, s)
        k20, k30, k21, k31 = _pairs(k20, k30, k21, k31, c, s)
        v02, v03, v12, v13 = _pairs(v02, v03, v12, v13, c, s)
        v22, v23, v32, v33 = _pairs(v22, v23, v32, v33, c, s)
        busy = busy & _is_open(k00, k11, k22, k33, k10, k20, k21, k30, k31, k32)
        left = tl.where(tl.max(busy.to(tl.int32)) > 0, left - 1, 0)
    top, w, x, y, z = _larger(k00, v00, v10, v20, v30, k11, v01, v11, v21, v31)
    top, w, x, y, z = _larger(top, w, x, y, z, k22, v02, v12, v22, v32)
    top, w, x, y, z = _larger(top, w, x, y, z, k33, v03, v13, v23, v33)
    return w, x, y, z


@triton.jit
def _is_open(k00, k11, k22, k33, k10, k20, k21, k30, k31, k32):
    """Whether a matrix is not yet diagonal."""
    outside = k10 * k10 + k20 * k20 + k21 * k21 + k30 * k30 + k31 * k31 + k32 * k32
    inside = k00 * k00 + k11 * k11 + k22 * k22 + k33 * k33
    return ~(outside <= 1e-29 * inside)  # rounding leaves some 1e-31; what is no number stays open


@triton.jit
def _turn(kpp, kpq, kqq, busy):
    """Cosine and sine of the rotation that makes the entry of p and q zero.

    1 and 0 for lanes that have arrived: a fit does not depend on its neighbours.
    """
    turns = busy & (kpq != 0)
    slope = (kqq - kpp) / (2 * tl.where(turns, kpq, 1.0))
    tangent = 1 / (tl.abs(slope) + tl.sqrt(1 + slope * slope))
    tangent = tl.where(turns, tl.where(slope < 0, -tangent, tangent), 0.0)
    c = 1 / tl.sqrt(1 + tangent * tangent)
    return c, tangent * c


@triton.jit
def _block(pp, pq, qp, qq, c, s):
    """The four entries of p and q: first the columns, then the rows."""
    pp, pq, qp, qq = _pairs(pp, pq, qp, qq, c, s)
    pp, qp, pq, qq = _pairs(pp, qp, pq, qq, c, s)
    return pp, pq, qp, qq


@triton.jit
def _pairs(p, q, other_p, other_q, c, s):
    return c * p - s * q, s * p + c * q, c * other_p - s * other_q, s * other_p + c * other_q


@triton.jit
def _larger(a, a0, a1, a2, a3, b, b0, b1, b2, b3):
    """Of two eigenvalues and their vectors the larger; the first of equal ones."""
    later = b > a
    return (
        tl.where(later, b, a), tl.where(later, b0, a0), tl.where(later, b1, a1), tl.where(later, b2, a2),
        tl.where(later, b3, a3),
    )  # fmt: skip
