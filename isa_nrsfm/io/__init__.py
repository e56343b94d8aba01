"""Read and open landmark tables, and save and load fitted models."""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

if TYPE_CHECKING:
    from isa_nrsfm.io._formats import (
        FORMATS as FORMATS,
        LandmarkFormat as LandmarkFormat,
        find_format as find_format,
        read_landmarks as read_landmarks,
    )
    from isa_nrsfm.io._landmarks import (
        Landmarks as Landmarks,
        from_mediapipe as from_mediapipe,
        from_movement as from_movement,
        from_sleap_io as from_sleap_io,
    )
    from isa_nrsfm.io._models import load_model as load_model, save_model as save_model
    from isa_nrsfm.io._stored_tables import open_table as open_table
    from isa_nrsfm.io._tables import (
        LandmarkTable as LandmarkTable,
        landmark_table as landmark_table,
        read_table as read_table,
        write_table as write_table,
    )
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
