"""Tables of landmarks: artificial ones with all truths known, and public ones."""

from typing import TYPE_CHECKING

from isa_nrsfm._compat.lazy import lazy_names

if TYPE_CHECKING:
    from isa_nrsfm.datasets._body import make_body_tracks as make_body_tracks
    from isa_nrsfm.datasets._face import make_face_tracks as make_face_tracks
    from isa_nrsfm.datasets._hand import make_hand_tracks as make_hand_tracks
    from isa_nrsfm.datasets._muct import fetch_muct as fetch_muct
    from isa_nrsfm.datasets._nonrigid import (
        make_nonrigid_tracks as make_nonrigid_tracks,
    )
    from isa_nrsfm.datasets._shark import fetch_shark as fetch_shark
else:
    __getattr__, __dir__, __all__ = lazy_names(
        __name__,
        {
            "isa_nrsfm.datasets._body": ["make_body_tracks"],
            "isa_nrsfm.datasets._face": ["make_face_tracks"],
            "isa_nrsfm.datasets._hand": ["make_hand_tracks"],
            "isa_nrsfm.datasets._muct": ["fetch_muct"],
            "isa_nrsfm.datasets._nonrigid": ["make_nonrigid_tracks"],
            "isa_nrsfm.datasets._shark": ["fetch_shark"],
        },
    )
