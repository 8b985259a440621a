"""Training, the estimator that every method satisfies, callbacks, provenance."""
