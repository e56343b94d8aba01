"""Small problems with a known solution, for the tests of all parts."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from isa_nrsfm._frames.models import FrameMap
from isa_nrsfm._frames.search import frame_tracks
from isa_nrsfm._joint.likelihood import JointFrames, MarginalLikelihood
from isa_nrsfm._joint.prior import ShapePrior
from isa_nrsfm._tables import FrameBlocks
from isa_nrsfm.datasets import make_nonrigid_tracks


class Scene(NamedTuple):
    """Tracks of a model, with its parameters; without weights all are one."""

    tracks: NDArray  # (I, J, 2), NaN where missing
    shapes: NDArray  # (K + 1, 3, J), centred, the mean shape first
    motion: NDArray  # (I, 2, 3)
    translation: NDArray  # (I, 2)
    alpha: NDArray  # (I, K)
    weights: NDArray | None = None  # (I, J), zero where missing

    @property
    def centred(self):
        """The tracks, each frame centred over the points that are there."""
        return self.tracks - np.nanmean(self.tracks, axis=1, keepdims=True)


def images(shapes, motion, translation, alpha):
    """Return the tracks (I, J, 2) of a model."""
    frames = shapes[0] + np.tensordot(alpha, shapes[1:], 1)
    return (motion @ frames).swapaxes(1, 2) + translation[:, None]


def random_scene(
    seed=0,
    n_frames=30,
    n_points=20,
    n_components=3,
    *,
    noise=0.0,
    camera="affine",
    kind="complete",
    deformation=0.3,
    extent=(1.0, 1.0, 1.0),
    turns=None,
):
    """
    Return a scene of random shapes and cameras of a model.

    The points are "complete", "weighted", or "missing": weighted, and NaN at some.
    Calibrated cameras have rotation vectors of a deviation `turns`, or all rotations.
    """
    rng = np.random.default_rng(seed)
    shapes = rng.normal(size=(n_components + 1, 3, n_points))
    shapes *= np.reshape(extent, (3, 1))
    shapes[1:] *= deformation
    shapes -= shapes.mean(axis=2, keepdims=True)
    motion = rng.normal(size=(n_frames, 2, 3))
    if camera != "affine":
        motion = random_cameras(rng, n_frames, turns)
    if camera == "weak_perspective":
        motion = rng.uniform(0.5, 2.0, n_frames)[:, None, None] * motion
    translation = rng.normal(size=(n_frames, 2))
    alpha = rng.normal(size=(n_frames, n_components))
    tracks = images(shapes, motion, translation, alpha)
    tracks = tracks + noise * rng.normal(size=tracks.shape)
    weights = None
    if kind != "complete":
        weights = rng.uniform(0.2, 2.0, tracks.shape[:2])
    if kind == "missing":
        weights[rng.random(weights.shape) < 0.2] = 0.0
        tracks[weights == 0] = np.nan
    return Scene(tracks, shapes, motion, translation, alpha, weights)


def waving_scene(n_frames, n_points, rates, seed=0):
    """Return a table of two basis shapes whose coefficients wave, and these."""
    rates = np.outer(np.arange(n_frames), rates)
    alpha = np.stack([np.sin(rates[:, 0]), np.cos(rates[:, 1])], axis=1)
    scene = make_nonrigid_tracks(n_frames, n_points, 2, random_state=seed)
    scene.shapes = scene.mean_shape + np.tensordot(alpha, scene.basis, 1)
    scene.tracks = scene.shapes @ scene.motion.swapaxes(1, 2)
    return scene, alpha


def with_gaps(tracks, share=0.3, seed=0):
    """Return a copy of tracks (I, J, 2) or a table (I, 2J), NaN at random points."""
    pairs = np.array(tracks).reshape(len(tracks), -1, 2)
    pairs[np.random.default_rng(seed).random(pairs.shape[:2]) < share] = np.nan
    return pairs.reshape(tracks.shape)


def with_outliers(tracks, size, share=0.05, seed=0):
    """Return a copy of tracks or a table with errors of this size at random points."""
    pairs, rng = tracks.reshape(len(tracks), -1, 2).copy(), np.random.default_rng(seed)
    wrong = rng.random(pairs.shape[:2]) < share
    pairs[wrong] += size * rng.normal(size=(wrong.sum(), 2))
    return pairs.reshape(tracks.shape)


def tracks_of(table, layout="interleaved"):
    """Return the points (I, J, 2) of a table."""
    pairs = table.reshape(len(table), *((2, -1) if layout == "planar" else (-1, 2)))
    return pairs.swapaxes(1, 2) if layout == "planar" else pairs


def table_of(tracks, layout="interleaved"):
    """Return tracks (I, J, 2) as a table."""
    tracks = tracks.swapaxes(1, 2) if layout == "planar" else tracks
    return tracks.reshape(len(tracks), -1)


def random_cameras(rng, n_frames, turns=None):
    """Return cameras with orthonormal rows, (I, 2, 3), by default all rotations."""
    rotations = Rotation.random(n_frames, rng)
    if turns is not None:
        rotations = Rotation.from_rotvec(turns * rng.normal(size=(n_frames, 3)))
    return rotations.as_matrix()[:, :2]


class StructuredMotion(NamedTuple):
    """Motion with block structure: ``M_ik = alpha_ik M_0^i E_k`` plus noise."""

    rigid: NDArray  # (2 I, 3)
    motion: NDArray  # (2 I, 3 K)
    alpha: NDArray  # (I, K)
    E: NDArray  # (K, 3, 3)


def structured_motion(seed, n_frames=25, n_blocks=3, noise=0.0):
    """Return random motion with block structure."""
    rng = np.random.default_rng(seed)
    M_0 = rng.normal(size=(n_frames, 2, 3))
    alpha = rng.normal(size=(n_frames, n_blocks))
    E = rng.normal(size=(n_blocks, 3, 3))
    blocks = np.einsum("ik,irc,kcd->irkd", alpha, M_0, E)
    motion = blocks.reshape(2 * n_frames, -1)
    motion = motion + noise * rng.normal(size=motion.shape)
    return StructuredMotion(M_0.reshape(-1, 3), motion, alpha, E)


def random_rotation(seed, n=3):
    """Return a uniformly distributed orthogonal matrix of determinant one."""
    Q, R = np.linalg.qr(np.random.default_rng(seed).normal(size=(n, n)))
    Q *= np.sign(np.diag(R))
    Q[:, 0] *= np.sign(np.linalg.det(Q))
    return Q


def measurements(tracks, scale_frames=True):
    """Return the measurement matrix of tracks (I, J, 2), by plain loops over frames."""
    rows = []
    for frame in tracks:
        centred = frame - frame.mean(axis=0)
        rows.append(centred.T / (np.sqrt(np.mean(centred**2)) if scale_frames else 1.0))
    return np.vstack(rows)


def spherical_sources(seed, n_samples, n_subspaces, size=3):
    """Return white sources (n_samples, n_subspaces * size), each subspace spherical."""
    rng = np.random.default_rng(seed)
    radius = rng.exponential(size=(n_samples, n_subspaces, 1))
    sources = rng.normal(size=(n_samples, n_subspaces, size)) * radius
    return sources.reshape(n_samples, -1) / np.sqrt(2.0)


def likelihood_of(tracks, weights, penalty, block_frames=2048):
    """Return the objective of the joint fit for tracks (n_frames, n_points, 2)."""
    given = [] if weights is None else [weights]
    blocks = FrameBlocks.of_array(tracks.mT, block_frames).derive(frame_tracks, *given)
    return MarginalLikelihood(JointFrames(blocks), penalty)


def shape_prior(scene):
    """Return a prior whose shapes are near those of a scene, in other axes."""
    rng, n = np.random.default_rng(2), len(scene.shapes)
    gauge = FrameMap(np.eye(n) + 0.2 * rng.normal(size=(n, n)), np.eye(3))
    shapes = scene.shapes + 0.1 * rng.normal(size=scene.shapes.shape)
    return ShapePrior(shapes, gauge, True, 0.0, 0.3)
