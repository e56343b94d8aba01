"""
The suite of airspeed velocity: time, memory and quality from commit to commit.

`stages` has a class for each stage of a fit, `fits` whole fits by number of frames,
points and basis shapes. docs/benchmarks/README.md says how to run them.
"""
