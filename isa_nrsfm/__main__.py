"""Run the command line: ``python -m isa_nrsfm``."""

from isa_nrsfm.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
