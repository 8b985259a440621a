"""Sampling, grouping and interpolation on point clouds."""
