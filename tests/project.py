"""Files of the project."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def text(name):
    """Return the text of a file of the project."""
    return (ROOT / name).read_text(encoding="utf-8")
