"""Tables of landmarks with all truths known."""

from isa_nrsfm.datasets._face import make_face_tracks
from isa_nrsfm.datasets._nonrigid import make_nonrigid_tracks

__all__ = ["make_face_tracks", "make_nonrigid_tracks"]
