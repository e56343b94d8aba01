"""
Measurements: ``python -m benchmarks`` and single ones.

``python -m benchmarks`` measures all methods side by side and writes tables and
pictures; docs/benchmarks/README.md says how. Its sections are in `_fits`, `_sweeps`,
`_unseen`, `_classification`, `_agreement` and `_paper`.

``python -m benchmarks.accuracy``, ``.recovery``, ``.consensus``, ``.depth``,
``.questions``, ``.choice``, ``.speed`` and ``.sensitivity`` print figures of
`AffineNRSfM` alone and assert nothing. Sections are named on the command line, all by
default; ``--seeds`` says how many random seeds each of them takes.
"""
