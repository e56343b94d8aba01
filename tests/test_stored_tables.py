"""Tables that are read block by block, from files or on dask, fitted as in memory."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from frame_parts import OF_FRAMES, OF_SHAPES, assert_same_model
from layers import slow_after, with_limits
from made_once import made_once
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals_of, refused, warned
from scenes import table_of, with_gaps, with_outliers
from sklearn import config_context
from sklearn.base import clone

from isa_nrsfm import AffineNRSfM, AffineNRSfMCV, FastISA
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.io import open_table

array = pytest.importorskip("dask.array")
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

K = 2
NEEDED = r"needs the cameras .* keep_frames=True"
# A row that shows three of 20 points.
FEW_POINTS = np.repeat([1.0, 2.0, 4.0, np.nan], [2, 2, 2, 34])
CHUNKS = (35, 75, 0, 40)
# Small tables are worked on as large ones are.
# Their starts and ends are none of their own: one start and few steps are quick.
ALL = {"few_frames": 0, "widths": (), "restarts": False}
SAMPLED = ALL | {"small_table": 1000, "sample": 50, "model_frames": 100}
KRYLOV = ALL | {"dense": 300}


@made_once
def table(missing=0.0, n_points=20, n_frames=150, outliers=False, planar=False):
    scene = make_nonrigid_tracks(n_frames, n_points, K, noise=0.01, random_state=0)
    tracks = with_gaps(scene.tracks, missing)
    if outliers:
        tracks = with_outliers(tracks, 1.0, seed=1)
        tracks[40, 0] = 1e6  # a point that is no part of its frame
    return table_of(tracks, "planar" if planar else "interleaved")


def estimator(limits=ALL, tol=1e3, **params):
    params = {"isa": FastISA(n_init=1), "random_state": 0, "tol": tol} | params
    return with_limits(**limits)(K, **params)


def in_blocks(method, X, megabytes=0.15):
    """Call a method with a table, read in blocks of this memory."""
    with config_context(working_memory=megabytes):
        return method(X)


@made_once
def in_memory():
    """Return the fit of the table in memory, to be left as it is."""
    return estimator().fit(table())


def stored(X, path, kind="memmap", n_files=3):
    """Return a table as a memory map, a folder of files, or on dask."""
    if kind == "dask":
        return array.from_array(X, chunks=(CHUNKS, 16))
    path = path / kind
    path.mkdir(exist_ok=True)
    if kind == "memmap":
        np.save(path / "table.npy", X)
        return np.load(path / "table.npy", mmap_mode="r")
    for number, part in enumerate(np.array_split(X, n_files)):
        file = path / f"part{number}.{kind}"
        if kind == "npy":
            np.save(file, part)
        else:
            names = [f"{axis}{j}" for j in range(X.shape[1] // 2) for axis in "xy"]
            columns = pa.table(dict(zip(names, part.T, strict=True)))
            pq.write_table(columns, file, row_group_size=17)
    return open_table(path)


HOLES = {"missing": 0.1}
WRONG = HOLES | {"outliers": True}
# Kind, megabytes of a block (few frames, more, all), limits, parameters, table.
FITS = [
    ("memmap", 0.1, SAMPLED, {}, HOLES),
    # Shapes along directions, and with the more points a Krylov method, too.
    ("memmap", 1, KRYLOV, {}, {"n_points": 100}),
    ("parquet", 0.2, ALL, {}, HOLES),
    ("dask", None, ALL, {"layout": "planar", "scale_frames": False}, {"planar": True}),
]
SLOW_FITS = [
    ("memmap", 0.4, SAMPLED, {"loss": "huber"}, WRONG),
    ("npy", 0.02, SAMPLED, {"loss": "cauchy"}, WRONG),
    ("memmap", 1, KRYLOV, {}, {"n_points": 400, "n_frames": 160}),
    ("dask", None, ALL, {"loss": "huber"}, WRONG),
]


@pytest.mark.parametrize(
    ("kind", "memory", "limits", "params", "given"),
    slow_after(len(FITS), FITS + SLOW_FITS),
)
def test_fit_is_that_in_memory(tmp_path, kind, memory, limits, params, given):
    expected = estimator(limits, **params).fit(table(**given))
    X = stored(table(**given), tmp_path, kind)
    got = in_blocks(estimator(limits, **params).fit, X, memory)
    assert_same_model(got, expected)
    score = in_blocks(got.score, X, memory)
    assert score == pytest.approx(expected.score(table(**given)), rel=1e-8)
    assert_allclose(in_blocks(got.transform, X, memory), got.alpha_, atol=1e-12)
    if kind == "parquet":
        assert_array_equal(got.feature_names_in_[:2], ["x0", "y0"])


@pytest.mark.parametrize("kind", ["memmap", "dask"])
def test_rows_that_show_nothing_are_left_out(tmp_path, kind):
    X, empty = table(0.1).copy(), np.arange(150) % 7 == 3
    empty[30:112] = True  # a whole chunk
    expected = estimator(SAMPLED).fit(X[~empty])
    X[empty] = np.nan
    model, blocks = clone(expected), stored(X, tmp_path, kind)
    warned(f"{empty.sum()} of 150 rows", in_blocks, model.fit, blocks)
    for name in OF_SHAPES:
        assert_allclose(getattr(model, name), getattr(expected, name), atol=1e-8)
    for name in OF_FRAMES:
        found = np.asarray(getattr(model, name))
        assert np.isnan(found[empty]).all()
        assert_allclose(found[~empty], getattr(expected, name), atol=1e-8)


@pytest.mark.parametrize("kind", slow_after(1, ["memmap", None]))
def test_threads_make_no_difference(tmp_path, kind):
    X = stored(table(), tmp_path) if kind else np.tile(table(), (15, 1))  # two blocks
    params = {"limits": SAMPLED, "max_iter": 2}
    one, two = (in_blocks(estimator(n_jobs=n, **params).fit, X, 0.1) for n in (1, 2))
    for name in OF_SHAPES + OF_FRAMES:
        assert_array_equal(getattr(one, name), getattr(two, name))
    for method in ("transform", "score"):
        found = [in_blocks(getattr(each, method), X, 0.1) for each in (one, two)]
        assert_array_equal(*found)


@pytest.mark.parametrize("kind", ["memmap", "dask"])
def test_all_methods_read_blocks(tmp_path, kind):
    X = table(0.1).copy()
    X[7] = np.nan
    model, blocks = in_memory(), stored(X, tmp_path, kind)
    methods = [model.transform, model.reproject, model.reconstruct]
    for camera in ("orthographic", "weak_perspective"):
        methods.append(partial(model.reconstruct, camera=camera))
    for method in methods:
        got, expected = in_blocks(method, blocks), method(X)
        assert type(got) is (np.ndarray if kind == "memmap" else array.Array)
        assert_allclose(np.asarray(got), expected, rtol=1e-8, atol=1e-10)
    assert np.isnan(np.asarray(in_blocks(model.transform, blocks))[7]).all()
    found = in_blocks(model.decompose, blocks)
    for got, expected in zip(found, model.decompose(X), strict=True):
        assert_allclose(np.asarray(got), expected, rtol=1e-10, atol=1e-12)


def test_frames_are_kept_in_files(tmp_path):
    plain, folder = in_memory(), tmp_path / "found"
    model = estimator(keep_frames=folder).fit(table())
    for name in OF_FRAMES:
        kept = getattr(model, name)
        assert isinstance(kept, np.memmap)
        assert_array_equal(kept, getattr(plain, name))
        file = Path(kept.filename)
        assert (file.name, file.parents[1]) == (f"{name[:-1]}.npy", folder)
        assert_array_equal(np.load(file), kept)
    assert len(list(folder.iterdir())) == 1
    assert_same_diagnostics(model, plain)


def assert_same_diagnostics(model, plain):
    found, expected = (each.diagnostics() for each in (model, plain))
    assert_allclose(found.weak_deviations, expected.weak_deviations, rtol=1e-6)


def test_frames_of_a_search_are_those_of_the_chosen_fit(tmp_path):
    model = AffineNRSfM(1, keep_frames=tmp_path, refinement=None, isa=FastISA(n_init=1))
    search = AffineNRSfMCV((1,), estimator=model, cv=2).fit(table())
    folder = Path(search.best_estimator_.alpha_.filename).parent
    assert list(tmp_path.iterdir()) == [folder]


def test_frames_are_kept_on_dask():
    X = table()
    model = estimator().fit(array.from_array(X, chunks=(CHUNKS, 40)))
    for name in OF_FRAMES:
        assert isinstance(getattr(model, name), array.Array)
        assert getattr(model, name).chunks[0] == (35, 75, 40)
    assert_same_diagnostics(model, in_memory())


def test_frames_are_not_kept():
    X, plain = table(), in_memory()
    model = estimator(keep_frames=False)
    assert_array_equal(model.fit_transform(X), plain.alpha_)
    assert not any(hasattr(model, name) for name in OF_FRAMES)
    assert_array_equal(model.basis_, plain.basis_)
    assert_array_equal(model.reproject(X), plain.reproject(X))
    refused(NEEDED, model.diagnostics)
    refused(NEEDED, model.reconstruct, X, "orthographic")


def test_chunks_of_unknown_length():
    X = table(0.1)
    blocks = array.from_array(np.column_stack([X, np.arange(150)]), chunks=(CHUNKS, 41))
    model = estimator().fit(blocks[blocks[:, 40] % 7 != 0][:, :40])
    assert_same_model(model, estimator().fit(X[np.arange(150) % 7 != 0]))


def test_half_points_are_warned_of_once(tmp_path):
    X = table().copy()
    X[[40, 120], 3] = np.nan
    model = estimator()
    with pytest.warns(UserWarning, match="in 2 of 150 rows .*row 40") as w:
        in_blocks(model.fit, stored(X, tmp_path))
    assert len(w) == 1
    warned("have only one of their two", model.transform, stored(X, tmp_path))


def slices_of(folder, kind, *slices):
    """Return rows of a table in four files."""
    blocks = stored(table(0.1), folder, kind, n_files=4)
    assert len(blocks) == blocks.shape[0] == 150
    return [blocks[rows] for rows in slices]


SLICES = slice(0, 10), slice(30, 130), slice(140, 400), slice(5, 5)
SINGLE = table().astype(np.float32)


def spoilt(place, value):
    """Return a table with a value at a place."""
    X = table().copy()
    X[place] = value
    return X


def arrays(folder, **tables):
    """Write arrays into a folder, and return it."""
    for name, values in tables.items():
        np.save(folder / f"{name}.npy", values)
    return folder


class Watched(np.memmap):
    """A memory map that notes the numbers of rows that are read."""

    def __getitem__(self, rows):
        found = super().__getitem__(rows)
        self.lengths.append(len(found))
        return found


def test_blocks_need_eight_times_their_own_memory(tmp_path):
    X = stored(table(), tmp_path).view(Watched)
    X.lengths = []
    in_blocks(in_memory().transform, X, 0.05)
    assert max(X.lengths) == 0.05 * 2**20 // (8 * 40 * 8)


test_refusals = refusals_of("stored_tables", globals())
