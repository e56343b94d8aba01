"""Optional dependencies, and private names of scikit-learn."""
