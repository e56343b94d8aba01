"""Tables that are read block by block: files, the fit, and what is said of bad ones."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from frame_parts import ATTRIBUTES_OF_FRAMES
from layers import slow_after
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refused, warned

from isa_nrsfm._estimator import limited
from isa_nrsfm._fit import Limits
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.io import open_table

# What is known of each frame.

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

K = 2
OF_SHAPES = ("mean_shape_", "basis_", "singular_values_", "mode_covariance_")
# Megabytes: blocks of few, of more and of all frames.
NEEDED = r"needs the cameras .* keep_frames=False"
MEMORIES = (0.02, 0.1, 1000)
# A row that shows three of 20 points.
FEW_POINTS = np.repeat([1.0, 2.0, 4.0, np.nan], [2, 2, 2, 34])


def table(missing=0.0, n_points=20, n_frames=150):
    tracks = make_nonrigid_tracks(n_frames, n_points, K, noise=0.01, random_state=0)
    X = tracks.data
    if missing:
        hidden = np.random.default_rng(0).random((n_frames, n_points)) < missing
        X = np.where(np.repeat(hidden, 2, axis=1), np.nan, X)
    return X


# Small tables are worked on as large ones are.
SAMPLED = Limits()._replace(small_table=1000, sample=50, model_frames=100)
KRYLOV = Limits(dense=300)


def estimator(limits=None, **params):
    limits = Limits() if limits is None else limits
    return limited(limits)(K, random_state=0, **params)


def memmap(X, path):
    np.save(path / "table.npy", X)
    return np.load(path / "table.npy", mmap_mode="r")


def folder(X, path, kind, n_files=3):
    """Write a table to several files of a folder and open that."""
    path = path / kind
    path.mkdir()
    for number, part in enumerate(np.array_split(X, n_files)):
        file = path / f"part{number}.{kind}"
        if kind == "npy":
            np.save(file, part)
        else:
            names = [f"{axis}{j}" for j in range(X.shape[1] // 2) for axis in "xy"]
            columns = pa.table(dict(zip(names, part.T, strict=True)))
            pq.write_table(columns, file, row_group_size=17)
    return open_table(path)


def assert_same_model(got, expected):
    for name in OF_SHAPES + ATTRIBUTES_OF_FRAMES:
        value = getattr(expected, name)
        atol = 1e-8 * np.abs(value).max()
        assert_allclose(getattr(got, name), value, rtol=0, atol=atol, err_msg=name)
    assert got.inverse_snr_ == pytest.approx(expected.inverse_snr_, rel=1e-8)
    assert got.noise_variance_ == pytest.approx(expected.noise_variance_, rel=1e-8)
    assert got.rank_floor_ == pytest.approx(expected.rank_floor_, rel=1e-6)


class TestFit:
    def test_rows_that_show_nothing_are_left_out(self, tmp_path):
        X = table(0.1)
        empty = np.arange(len(X)) % 7 == 3
        empty[40:100] = True
        params = {"limits": SAMPLED, "working_memory": 0.02}
        expected = estimator(**params, frames_folder=tmp_path / "expected")
        expected.fit(memmap(X[~empty], tmp_path))
        X[empty] = np.nan
        model = estimator(**params, frames_folder=tmp_path / "found")
        warned(f"{empty.sum()} of 150 rows", model.fit, memmap(X, tmp_path))
        for name in OF_SHAPES:
            assert_array_equal(getattr(model, name), getattr(expected, name))
        for name in ATTRIBUTES_OF_FRAMES:
            found = getattr(model, name)
            assert isinstance(found, np.memmap)
            assert np.isnan(found[empty]).all()
            assert_array_equal(found[~empty], getattr(expected, name))

    @pytest.mark.parametrize("missing", slow_after(1, [0.1, 0.0]))
    def test_block_size_makes_no_difference(self, tmp_path, missing):
        X = table(missing)
        expected = estimator(SAMPLED).fit(X)
        for megabytes in MEMORIES:
            got = estimator(SAMPLED, working_memory=megabytes).fit(memmap(X, tmp_path))
            assert_same_model(got, expected)
            score = got.score(memmap(X, tmp_path))
            assert score == pytest.approx(expected.score(X), rel=1e-8)

    @pytest.mark.parametrize(
        ("loss", "limits", "megabytes"),
        slow_after(
            1,
            [
                ("huber", SAMPLED, 0.1),
                ("cauchy", SAMPLED, 0.02),
                ("huber", SAMPLED, 1000),
                ("cauchy", Limits(), 0.1),
                ("huber", Limits(), 1000),
            ],
            together=True,
        ),
    )
    def test_robust_losses(self, tmp_path, loss, limits, megabytes):
        X = table(0.1)
        rng = np.random.default_rng(1)
        wrong = np.repeat(rng.random((150, 20)) < 0.05, 2, axis=1)
        X = np.where(wrong, X + X[np.isfinite(X)].std() * rng.normal(size=X.shape), X)
        X[40, :2] = 1e6  # a point that is no part of its frame
        expected = estimator(limits, loss=loss).fit(X)
        got = estimator(limits, loss=loss, working_memory=megabytes)
        assert_same_model(got.fit(memmap(X, tmp_path)), expected)
        # The outliers do not spoil it.
        clean = estimator(limits).fit(table(0.1))
        seen = np.isfinite(X) & ~wrong
        seen[40, :2] = False
        models, clean = (expected, clean), table(0.1)
        errors = [np.abs(model.reproject(X) - clean)[seen] for model in models]
        assert np.median(errors[0]) < 1.2 * np.median(errors[1])

    @pytest.mark.parametrize("n_points", slow_after(1, [100, 400]))
    def test_of_many_points(self, tmp_path, n_points):
        # Shapes along directions, and with the more points a Krylov method, too.
        X = table(n_points=n_points, n_frames=160)
        expected = estimator(KRYLOV).fit(X)
        got = estimator(KRYLOV, working_memory=1).fit(memmap(X, tmp_path))
        assert_same_model(got, expected)

    @pytest.mark.slow
    @pytest.mark.parametrize("loss", ["linear", "huber"])
    def test_of_many_points_of_which_some_are_missing(self, tmp_path, loss):
        # Completed frames along directions first: the end is that of the seen points.
        X, joint = table(0.1, n_points=210, n_frames=80), Limits().joint
        few = joint._replace(many_points=999)
        at_once = estimator(Limits()._replace(joint=few), loss=loss, tol=1e-4).fit(X)
        model = estimator(loss=loss, tol=1e-4).fit(X)
        assert_allclose(model.basis_, at_once.basis_, rtol=0, atol=1e-4)
        assert_allclose(model.alpha_, at_once.alpha_, rtol=0, atol=1e-3)
        got = estimator(loss=loss, tol=1e-4, working_memory=1)
        assert_same_model(got.fit(memmap(X, tmp_path)), model)

    @pytest.mark.parametrize("kind", slow_after(1, ["npy", "parquet"]))
    def test_of_folders(self, tmp_path, kind):
        X = table(0.1)
        stored = folder(X, tmp_path, kind)
        assert stored.shape == X.shape
        got = estimator(working_memory=0.1).fit(stored)
        assert_same_model(got, estimator().fit(X))
        if kind == "parquet":
            assert_array_equal(got.feature_names_in_[:2], ["x0", "y0"])
        assert_allclose(got.transform(stored), got.alpha_, atol=1e-12)

    @pytest.mark.parametrize("stored", [False, True])
    def test_threads_make_no_difference(self, tmp_path, stored):
        X = np.tile(table(), (15, 1))  # two blocks in memory
        if stored:
            X = memmap(X, tmp_path)
        params = {"limits": SAMPLED, "working_memory": 0.1}
        one, two = (estimator(n_jobs=n, **params).fit(X) for n in (1, 2))
        for name in OF_SHAPES + ATTRIBUTES_OF_FRAMES:
            assert_array_equal(getattr(one, name), getattr(two, name))
        assert_array_equal(one.transform(X), two.transform(X))

    @pytest.mark.parametrize(
        ("layout", "scale_frames"),
        slow_after(1, product(["planar", "interleaved"], [False, True]), together=True),
    )
    def test_of_other_layouts_and_weights(self, tmp_path, layout, scale_frames):
        X = table()
        if layout == "planar":
            X = X.reshape(len(X), -1, 2).transpose(0, 2, 1).reshape(X.shape)
        params = {"layout": layout, "scale_frames": scale_frames}
        got = estimator(working_memory=0.1, **params).fit(memmap(X, tmp_path))
        assert_same_model(got, estimator(**params).fit(X))


class TestNewTables:
    def test_all_methods_read_blocks(self, tmp_path):
        X = table(0.1)
        X[7] = np.nan
        model = estimator(working_memory=0.05).fit(table())
        stored = memmap(X, tmp_path)
        for name in ("transform", "reconstruct", "reproject"):
            got, expected = (getattr(model, name)(each) for each in (stored, X))
            assert type(got) is np.ndarray
            assert_allclose(got, expected, rtol=1e-10, atol=1e-12)
        assert np.isnan(model.transform(stored)[7]).all()
        parts = zip(model.decompose(stored), model.decompose(X), strict=True)
        for got, expected in parts:
            assert_allclose(got, expected, rtol=1e-10, atol=1e-12)
        for camera in ("orthographic", "weak_perspective"):
            got, expected = (model.reconstruct(each, camera) for each in (stored, X))
            assert_allclose(got, expected, rtol=1e-8, atol=1e-10)


class TestKeepFrames:
    def test_in_files(self, tmp_path):
        X = table()
        plain = estimator().fit(X)
        found = tmp_path / "found"
        model = estimator(frames_folder=found).fit(X)
        for name in ATTRIBUTES_OF_FRAMES:
            array = getattr(model, name)
            assert isinstance(array, np.memmap)
            assert_array_equal(array, getattr(plain, name))
            file = Path(array.filename)
            assert (file.name, file.parents[1]) == (f"{name[:-1]}.npy", found)
            assert_array_equal(np.load(file), array)
        assert len(list(found.iterdir())) == 1
        found, expected = (each.diagnostics() for each in (model, plain))
        assert_allclose(found.weak_deviations, expected.weak_deviations)

    def test_not_at_all(self):
        X = table()
        model, plain = estimator(keep_frames=False), estimator().fit(X)
        assert_array_equal(model.fit_transform(X), plain.alpha_)
        for name in ATTRIBUTES_OF_FRAMES:
            assert not hasattr(model, name)
        assert_array_equal(model.basis_, plain.basis_)
        assert_array_equal(model.reproject(X), plain.reproject(X))
        refused(NEEDED, model.diagnostics)
        refused(NEEDED, model.reconstruct, X, "orthographic")


class TestErrors:
    @pytest.mark.parametrize(
        ("place", "value", "message"),
        [
            ((120, 3), np.inf, "Input X contains infinity"),
            (120, FEW_POINTS, r"fewer than 4 .* in 1 of 150 frames \(first: row 120"),
            (120, 1.0, r"equal in 1 of 150 frames \(first: row 120\)"),
        ],
        ids=["infinite value", "few points", "equal points"],
    )
    def test_rows_are_checked(self, tmp_path, place, value, message):
        X = table()
        X[place] = value
        refused(message, estimator(working_memory=0.05).fit, memmap(X, tmp_path))

    def test_half_points_are_warned_of_once(self, tmp_path):
        X = table()
        X[[40, 120], 3] = np.nan
        with pytest.warns(UserWarning, match="in 2 of 150 rows .*row 40") as w:
            model = estimator(working_memory=0.05).fit(memmap(X, tmp_path))
        assert len(w) == 1
        with pytest.warns(UserWarning, match="some points have only one of their two"):
            model.transform(memmap(X, tmp_path))

    def test_other_shapes(self, tmp_path):
        X = table()
        for other, message in (
            (X[:, 0], "Expected 2D array, got 1D"),
            (X[:, :-1], "an even number; got n_features=39"),
        ):
            refused(message, estimator().fit, memmap(other, tmp_path))
        model = estimator().fit(X)
        refused("expecting 40 features", model.transform, memmap(X[:, :-2], tmp_path))

    def test_what_needs_memory(self, tmp_path):
        stored = folder(table(), tmp_path, "npy")
        message = r"not in memory needs refinement='joint'"
        refused(message, estimator(refinement="alternating").fit, stored)

    def test_memory_maps_are_taken_as_arrays_where_that_is_needed(self, tmp_path):
        X, params = table(), {"refinement": "alternating"}
        got = estimator(**params).fit(memmap(X, tmp_path))
        assert_array_equal(got.basis_, estimator(**params).fit(X).basis_)


class TestOpenTable:
    @pytest.mark.parametrize("kind", ["npy", "parquet"])
    def test_slices_are_rows(self, tmp_path, kind):
        X = table(0.1)
        stored = folder(X, tmp_path, kind, n_files=4)
        assert len(stored) == len(X)
        for rows in (slice(0, 10), slice(30, 130), slice(140, 400), slice(5, 5)):
            assert_array_equal(stored[rows], X[rows])
        with pytest.raises(TypeError, match="slice without steps"):
            stored[3]

    def test_one_array_is_mapped(self, tmp_path):
        np.save(tmp_path / "table.npy", table())
        assert isinstance(open_table(tmp_path / "table.npy"), np.memmap)

    def test_single_precision_parquet(self, tmp_path):
        stored = folder(table().astype(np.float32), tmp_path, "parquet")
        assert stored.dtype == stored[:3].dtype == np.float32

    def test_empty_folder(self, tmp_path):
        (tmp_path / ".hidden").write_text("")
        with pytest.raises(FileNotFoundError, match=r"has no .npy or .parquet files"):
            open_table(tmp_path)

    def test_files_that_are_no_table(self, tmp_path):
        np.save(tmp_path / "a.npy", np.zeros((3, 4, 2)))
        refused(r"table of real numbers.*\(3, 4, 2\)", open_table, tmp_path)
        np.save(tmp_path / "a.npy", table())
        np.save(tmp_path / "b.npy", table()[:, :30])
        refused(r"same columns: a.npy has 40, b.npy 30", open_table, tmp_path)
        (tmp_path / "b.npy").rename(tmp_path / "b.csv")
        refused(r"one kind.*got a.npy, b.csv", open_table, tmp_path)

    def test_columns_of_text(self, tmp_path):
        file = tmp_path / "a.parquet"
        pq.write_table(pa.table({"x0": [1.0], "name": ["b"]}), file)
        refused("column 'name' is of type string", open_table, file)
