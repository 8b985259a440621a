"""Rigid transforms, the least-squares fit, symmetry groups, pose representatives, the pinhole camera."""
