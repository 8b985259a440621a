"""pnet: 6DoF pose estimation of parametric parts in bins."""

__version__ = "0.1.0"
