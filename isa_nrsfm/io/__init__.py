"""Read and open landmark tables, and save and load fitted models."""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

__all__ = [
    "FORMATS",
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

if TYPE_CHECKING:
    from isa_nrsfm.io._formats import (
        FORMATS,
        LandmarkFormat,
        find_format,
        read_landmarks,
    )
    from isa_nrsfm.io._landmarks import Landmarks
    from isa_nrsfm.io._models import load_model, save_model
    from isa_nrsfm.io._results import from_mediapipe, from_movement
    from isa_nrsfm.io._stored_tables import open_table
    from isa_nrsfm.io._tables import (
        LandmarkTable,
        landmark_table,
        read_table,
        write_table,
    )
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "isa_nrsfm.io._formats": [
                "FORMATS",
                "LandmarkFormat",
                "find_format",
                "read_landmarks",
            ],
            "isa_nrsfm.io._landmarks": ["Landmarks"],
            "isa_nrsfm.io._models": ["load_model", "save_model"],
            "isa_nrsfm.io._results": ["from_mediapipe", "from_movement"],
            "isa_nrsfm.io._stored_tables": ["open_table"],
            "isa_nrsfm.io._tables": [
                "LandmarkTable",
                "landmark_table",
                "read_table",
                "write_table",
            ],
        },
    )
