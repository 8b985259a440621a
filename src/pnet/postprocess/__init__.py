"""From point-wise predictions to instances: the right half of the paper's Fig. 5."""
