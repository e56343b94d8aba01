"""
Measurements: ``python -m benchmarks.accuracy``, ``.recovery`` and ``.speed``.

Each prints figures and asserts nothing. Sections are named on the command line, all by
default; ``--seeds`` says how many random seeds each of them takes.
"""
