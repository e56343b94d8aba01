"""Optional dependencies, private names of scikit-learn, and files."""
