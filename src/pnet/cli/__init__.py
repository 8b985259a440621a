"""The commands: one thin Hydra application a file."""
