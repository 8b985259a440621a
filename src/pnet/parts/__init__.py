"""Parametric parts: keypoint rules, solids, symmetry; one file a template."""
