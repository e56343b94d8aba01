"""Joint fit of cameras, shapes and noise by maximum marginal likelihood."""
