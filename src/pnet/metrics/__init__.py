"""Pose distance to numbers: matching, average precision, pose errors, and the benchmark's files."""
