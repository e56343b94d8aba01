"""Measurements on real tables: ``python -m benchmarks.speed``, ``.accuracy``."""
