"""Tables of landmarks: artificial ones with all truths known, and public ones."""

from isa_nrsfm.datasets._face_prior import load_face_prior
from isa_nrsfm.datasets._muct import fetch_muct
from isa_nrsfm.datasets._samples_generator import (
    make_body_tracks,
    make_face_tracks,
    make_hand_tracks,
    make_nonrigid_tracks,
)
from isa_nrsfm.datasets._shark import fetch_shark

__all__ = [
    "fetch_muct",
    "fetch_shark",
    "load_face_prior",
    "make_body_tracks",
    "make_face_tracks",
    "make_hand_tracks",
    "make_nonrigid_tracks",
]
