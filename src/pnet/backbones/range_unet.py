"""A range-image U-Net: the cloud as the depth camera saw it, on a grid of viewing directions.

A depth camera's cloud is a surface over the image plane, so ordinary convolutions reach its neighbourhoods
without any neighbour search. Features are gathered back to the points.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from pnet.backbones.base import Backbone
from pnet.backbones.layers import conv_block, shared_mlp
from pnet.backbones.slopes import SLOPE_FEATURES, SurfaceSlopes
from pnet.ops.gathering import gather_rows, scatter_sum
from pnet.ops.pyramid import Tables

MAX_CELLS = 1024  # a side; points farther out share the cells of the border
CELL_FEATURES = 4  # where in the cell the points lie (2), their depth, whether there are any


class RangeUNet(Backbone):
    """U-Net (Ronneberger et al. 2015) on cells of equal viewing angle.

    Args:
        channels: of the levels, finest first; each level halves the resolution.
        cell: width of a cell at `depth`, metres. depth: nominal distance of the surface, metres.
        depth_scale: depth differences are divided by it, metres.
        features: F. slopes: the network also sees the normals of planes through windows of this radius in
            cells, see `SurfaceSlopes`; None: it doesn't.
    """

    batches_agree = False

    def __init__(
        self,
        channels: Sequence[int],
        cell: float,
        depth: float,
        depth_scale: float,
        features: int,
        slopes: int | None = None,
    ) -> None:
        super().__init__()
        if len(channels) < 2 or cell <= 0 or depth <= 0 or depth_scale <= 0:
            raise ValueError("backbone: needs at least two levels and positive cell, depth, depth_scale")
        self.features = features
        self._angle, self._depth_scale = cell / depth, depth_scale
        self._multiple = 2 ** (len(channels) - 1)
        steps = list(pairwise(channels))
        self.slopes = None if slopes is None else SurfaceSlopes(slopes, depth_scale, cell)
        seen = CELL_FEATURES + (0 if slopes is None else SLOPE_FEATURES)
        self.enter = nn.Sequential(conv_block(seen, channels[0]), conv_block(channels[0], channels[0]))
        self.down = nn.ModuleList(
            nn.Sequential(conv_block(fine, coarse, 2), conv_block(coarse, coarse)) for fine, coarse in steps
        )
        self.up = nn.ModuleList(
            nn.ModuleDict(
                {
                    "widen": nn.ConvTranspose2d(coarse, fine, 2, 2),
                    "merge": conv_block(2 * fine, fine),
                }
            )
            for fine, coarse in reversed(steps)
        )
        self.leave = shared_mlp([channels[0] + CELL_FEATURES - 1, features])

    def tables(self, points: Tensor) -> Tables:
        """Cell of every point and its place within; the grid is as large as the widest cloud needs.

        So clouds of a batch share a grid, and a cloud's features may differ a little with its company.

        Returns:
            cell (B, N) int64, local (B, N, 3): offset from the cell's middle in cells and depth from the
            cloud's mean in units of depth_scale; grid (rows, columns, 0), whose shape alone counts: numbers
            in a tensor would have to be read back from the device.
        """
        with torch.no_grad():
            direction = points[..., :2] / points[..., 2:] / self._angle
            low = direction.amin(1, keepdim=True)
            extent = (direction.amax(1) - low[:, 0]).amax(0)
            cells = extent.clamp(max=MAX_CELLS - 1).floor().long() + 1
            size = (cells + self._multiple - 1) // self._multiple * self._multiple
            # the cloud in the middle of the grid
            own = direction.amax(1, keepdim=True) - low
            place = direction - low + (size - own) / 2
            whole = place.floor().clamp(min=0)
            whole = torch.minimum(whole, (size - 1).to(whole))
            depth = points[..., 2:] - points[..., 2:].mean(1, keepdim=True)
            local = torch.cat([place - whole - 0.5, depth / self._depth_scale], -1)
            cell = whole[..., 1].long() * size[0] + whole[..., 0].long()
            columns, rows = size.tolist()  # on a device the only wait: let a data loader find the tables
            return {"cell": cell, "local": local, "grid": local.new_empty(rows, columns, 0)}

    def forward(self, points: Tensor, tables: Tables) -> Tensor:
        """Cells → U-Net → back to the points."""
        cell, local = tables["cell"], tables["local"]
        rows, columns = tables["grid"].shape[:2]
        image = _rasterise(cell, local, rows, columns)
        if self.slopes is not None:
            image = torch.cat([image, self.slopes(image)], 1)
        image = self._unet(image.contiguous(memory_format=torch.channels_last))
        at_points = gather_rows(image.flatten(2).mT, cell)
        features: Tensor = self.leave(torch.cat([at_points.to(local), local], -1))
        return features

    def _unet(self, image: Tensor) -> Tensor:
        image = self.enter(image)
        skips = []
        for step in self.down:
            skips.append(image)
            image = step(image)
        for step in self.up:
            assert isinstance(step, nn.ModuleDict)
            image = step["merge"](torch.cat([step["widen"](image), skips.pop()], 1))
        return image


def _rasterise(cell: Tensor, local: Tensor, rows: int, columns: int) -> Tensor:
    """(B, 4, rows, columns): mean of the points in each cell and whether there are any."""
    content = F.pad(local, (0, 1), value=1.0)
    total = scatter_sum(content, cell[..., None], rows * columns)
    count = total[..., -1:]
    mean = total / count.clamp(min=1)
    return mean.mT.unflatten(2, (rows, columns))
