"""Read and open landmark tables, and save and load fitted models."""

from isa_nrsfm.io._formats import (
    FORMATS,
    LandmarkFormat,
    find_format,
    read_landmarks,
)
from isa_nrsfm.io._landmarks import Landmarks
from isa_nrsfm.io._models import TRUSTED_TYPES, load_model, save_model
from isa_nrsfm.io._results import from_mediapipe, from_movement
from isa_nrsfm.io._stored_tables import open_table
from isa_nrsfm.io._tables import (
    LandmarkTable,
    landmark_table,
    read_table,
    write_table,
)

__all__ = [
    "FORMATS",
    "TRUSTED_TYPES",
    "LandmarkFormat",
    "LandmarkTable",
    "Landmarks",
    "find_format",
    "from_mediapipe",
    "from_movement",
    "landmark_table",
    "load_model",
    "open_table",
    "read_landmarks",
    "read_table",
    "save_model",
    "write_table",
]
