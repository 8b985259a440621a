"""Synthetic scenes: physics, clutter, ray casting, sampling, the store and generation."""
