"""Cameras, shapes and noise of greatest marginal likelihood, all frames together."""
