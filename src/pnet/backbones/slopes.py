"""Which way the surface of a range image faces, by a plane through each cell's neighbourhood.

A part's faces differ by a few degrees of tilt, which in depths of several centimetres is the last digit of
a bfloat16. A plane fit in float32 brings it to the front.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

SLOPE_FEATURES = 3  # the normal's two components in the image plane, the depth off the plane
RIDGE = 0.1  # square cells, added to the spread of places: a window of few cells is no plane
RELIEF = 1e-3  # metres off the plane that count as much as a slope of 45°


class SurfaceSlopes(nn.Module):
    """Plane fits in square windows of a range image, by moments; it has no weights.

    Args:
        radius: of the windows, in cells; 2 means 5 x 5.
        depth_scale: metres per unit of the image's depths. cell: nominal width of a cell, metres.
    """

    def __init__(self, radius: int, depth_scale: float, cell: float) -> None:
        super().__init__()
        if radius < 1:
            raise ValueError(f"backbone.slopes is {radius}, expected a radius of 1 cell or more, or null")
        self._radius, self._depth_scale, self._cell = radius, depth_scale, cell
        self.kernel: Tensor
        self.register_buffer("kernel", _moment_kernel(radius), persistent=False)

    def forward(self, image: Tensor) -> Tensor:
        """Normals and relief of every cell.

        Args:
            image: (B, 4, rows, columns): where in its cell the surface was seen (x, y, in cells), its depth
                (in units of depth_scale), and 1 where it was, else all are 0.
        Returns:
            (B, 3, rows, columns): the x and y of the unit normal, tanh of the depth off the plane in
            millimetres. Cells without a point have the plane of their neighbours and no relief.
        """
        x, y, z, seen = image.float().unbind(1)
        terms = torch.stack([seen, x, y, z, x * x, x * y, y * y, x * z, y * z], 1)
        with torch.autocast(image.device.type, enabled=False):
            sums = F.conv2d(terms, self.kernel.float(), padding=self._radius)
        count = sums[:, 0].clamp(min=1)
        mx, my, mz, xx, xy, yy, xz, yz = (sums[:, 1:] / count[:, None]).unbind(1)
        xx, xy, yy = xx - mx * mx + RIDGE, xy - mx * my, yy - my * my + RIDGE
        xz, yz = xz - mx * mz, yz - my * mz
        determinant = xx * yy - xy * xy
        across, down = (yy * xz - xy * yz) / determinant, (xx * yz - xy * xz) / determinant
        off = seen * (z - mz - across * (x - mx) - down * (y - my)) * self._depth_scale / RELIEF
        slope = torch.stack([across, down], 1) * self._depth_scale / self._cell
        normal = slope / (1 + slope.square().sum(1, keepdim=True)).sqrt()
        return torch.cat([normal, off.tanh()[:, None]], 1).to(image)


def _moment_kernel(radius: int) -> Tensor:
    """(9, 9, side, side): from the terms of single cells to a window's sums of 1, X, Y, Z, XX, XY, YY, XZ and
    YZ, where X and Y are a cell's own x and y plus its place in the window."""
    side = torch.arange(-radius, radius + 1, dtype=torch.float32)
    j, i = torch.meshgrid(side, side, indexing="ij")
    one = torch.ones_like(i)
    kernel = torch.zeros(9, 9, len(side), len(side))
    parts: list[dict[int, Tensor]] = [
        {0: one},
        {0: i, 1: one},
        {0: j, 2: one},
        {3: one},
        {0: i * i, 1: 2 * i, 4: one},
        {0: i * j, 1: j, 2: i, 5: one},
        {0: j * j, 2: 2 * j, 6: one},
        {3: i, 7: one},
        {3: j, 8: one},
    ]
    for moment, terms in enumerate(parts):
        for term, weight in terms.items():
            kernel[moment, term] = weight
    return kernel
