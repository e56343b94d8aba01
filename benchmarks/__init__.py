"""
Measurements: ``python -m benchmarks`` and single ones.

``python -m benchmarks`` measures all methods side by side and writes tables and
pictures; docs/benchmarks/README.md says how. Its sections are in `_fits`, `_recovered`,
`_unseen`, `_classification`, `_agreement`, `_cost` and `_paper`.

`asv_suite`, with asv.conf.json, is a suite for airspeed velocity.

``python -m benchmarks.accuracy``, ``.recovery``, ``.questions``, ``.speed`` and
``.sensitivity`` print figures of `AffineNRSfM` alone and assert nothing. Sections are
named on the command line, all by default; ``--seeds`` says how many random seeds each
of them takes.
"""
