"""Tables of landmarks: artificial ones with all truths known, and public ones."""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

if TYPE_CHECKING:
    from isa_nrsfm.datasets._face_prior import load_face_prior as load_face_prior
    from isa_nrsfm.datasets._muct import fetch_muct as fetch_muct
    from isa_nrsfm.datasets._samples_generator import (
        make_body_tracks as make_body_tracks,
        make_face_tracks as make_face_tracks,
        make_hand_tracks as make_hand_tracks,
        make_nonrigid_tracks as make_nonrigid_tracks,
    )
    from isa_nrsfm.datasets._shark import fetch_shark as fetch_shark
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
