"""Read and open landmark tables, and save and load fitted models."""

from isa_nrsfm.io._models import TRUSTED_TYPES, load_model, save_model
from isa_nrsfm.io._stored_tables import open_table
from isa_nrsfm.io._tables import (
    LandmarkTable,
    landmark_table,
    read_table,
    write_table,
)

__all__ = [
    "TRUSTED_TYPES",
    "LandmarkTable",
    "landmark_table",
    "load_model",
    "open_table",
    "read_table",
    "save_model",
    "write_table",
]
