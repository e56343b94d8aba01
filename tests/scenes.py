"""Small problems with a known solution, for the tests of the numerical stages."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


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


def rotate_frames(W, seed):
    """Rotate each image: the two rows of each frame of any matrix."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, len(W) // 2)
    c, s = np.cos(angle), np.sin(angle)
    R = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], 1)
    return (R @ W.reshape(len(R), 2, -1)).reshape(W.shape)


def permute_frames(W, seed):
    """Return W with its frames, pairs of rows, in another order, and the order."""
    order = np.random.default_rng(seed).permutation(len(W) // 2)
    return W.reshape(len(order), 2, -1)[order].reshape(W.shape), order


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
