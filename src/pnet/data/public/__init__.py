"""Readers of public data sets as their authors laid them out."""
