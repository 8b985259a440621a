"""Backbones: a point cloud (B, N, 3) to features (B, N, F)."""
