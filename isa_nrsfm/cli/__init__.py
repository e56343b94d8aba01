"""The command line ``isa-nrsfm`` with its commands fit, transform, export and demo."""

from isa_nrsfm.cli._entry import main

__all__ = ["main"]
