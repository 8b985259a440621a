"""Heads, losses and the networks that put them on a backbone."""
