"""The protocol that every backbone satisfies."""

from abc import ABC, abstractmethod

from torch import Tensor, nn

from pnet.ops.pyramid import Pyramid, Tables


class Backbone(nn.Module, ABC):
    """Per-point features of a cloud.

    Attributes:
        features: F, channels of the output. pyramid: the neighbour tables that it needs; None: no such.
        batches_agree: whether a cloud's features are the same in any batch (in evaluation, up to rounding).
    """

    features: int
    pyramid: Pyramid | None = None
    batches_agree: bool = True

    def tables(self, points: Tensor) -> Tables:
        """What depends on the clouds' geometry alone; found once, outside autograd, here or by a data loader.

        A loader's process calls it without the device, so it uses no weights or buffers.

        Args:
            points: (B, N, 3) metres, camera frame, in farthest-point-sampling order.
        """
        return {} if self.pyramid is None else self.pyramid(points)

    @abstractmethod
    def forward(self, points: Tensor, tables: Tables) -> Tensor:
        """Features of every point.

        Args:
            points: (B, N, 3) metres. tables: of the same points.
        Returns:
            (B, N, F).
        """
