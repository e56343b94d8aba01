import json
from contextlib import nullcontext

import numpy as np
import pytest
from isolated_runs import MEGABYTE, count_run, misbehave, use_memory
from scenes import random_rotation

import benchmarks.__main__ as command
from benchmarks import (
    _agreement,
    _cost,
    _data,
    _fits,
    _recovered,
    _sets,
    _unseen,
    accuracy,
    frame_search,
    questions,
    sensitivity,
)
from benchmarks._agreement import compare
from benchmarks._figures import draw_bars, draw_reprojections
from benchmarks._isolated import run_isolated
from benchmarks._jobs import Job, Limits, run_jobs
from benchmarks._markdown import cell, grid, number, select, table, value
from benchmarks._methods import METHODS, Found, TruncatedTable
from benchmarks._results import Record, Results
from benchmarks._sections import SECTIONS
from benchmarks._sets import SETS, Set
from isa_nrsfm import AffineNRSfM
from isa_nrsfm._fit_options import Limits as FitLimits
from isa_nrsfm._joint.options import JointOptions
from isa_nrsfm.analysis import AlignedFrames
from isa_nrsfm.datasets import make_nonrigid_tracks
from isa_nrsfm.metrics import inverse_snr

# Tables of few points: that FastICA does not converge makes no difference here.
pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


def record(**changes):
    """Return a record of a run that took two seconds."""
    plain = Record(
        section="truth",
        set="drink",
        method="joint",
        seed=0,
        status="ok",
        values={"inverse_snr": 0.01},
        parameters={},
        seconds=2.0,
        memory=10.0,
        environment="now",
    )
    return plain._replace(**changes)


# Processes


@pytest.mark.subprocess
def test_seconds_and_memory_are_those_of_what_is_measured():
    outcome = run_isolated(
        use_memory, {"n_before": 400, "n_inside": 150}, time_limit=600
    )
    assert outcome.status == "ok"
    assert outcome.values["total"] == 150 * MEGABYTE / 8
    assert outcome.values["inside"] <= outcome.seconds <= outcome.values["outside"]
    assert 145 < outcome.memory < 250


@pytest.mark.subprocess
@pytest.mark.parametrize(
    ("how", "status", "message"),
    [
        ("raise", "error", "ValueError: expected this; got that"),
        ("die", "error", "the process ended with exit code 3"),
        ("hang", "over time", "over 0.5 s"),
    ],
)
def test_what_a_method_does_wrong_is_reported(how, status, message):
    outcome = run_isolated(misbehave, {"how": how}, time_limit=0.5)
    assert (outcome.status, outcome.message) == (status, message)
    assert outcome.values is None
    assert outcome.seconds is None


@pytest.mark.subprocess
def test_memory_is_limited():
    outcome = run_isolated(
        use_memory, {"n_before": 0, "n_inside": 8000}, time_limit=600, memory_limit=4
    )
    assert outcome.status == "error"
    assert "MemoryError" in outcome.message


@pytest.mark.subprocess
def test_what_was_too_slow_is_not_run_again(tmp_path):
    # What is measured of the slow method does not end, of the fast one nothing is.
    jobs = [
        Job("truth", "drink", method, seed, count_run, arguments, {})
        for seed in (0, 1)
        for method, arguments in (
            ("slow", {"path": tmp_path / "slow", "ends": False}),
            ("fast", {"path": tmp_path / "fast", "ends": True}),
        )
    ]
    limits = Limits(time=0.5, memory=None, threads=1)
    done = list(run_jobs(jobs, limits, 1, "now"))
    assert (tmp_path / "slow").read_text() == "run\n"
    assert (tmp_path / "fast").read_text() == "run\nrun\n"
    assert {(r.method, r.seed, r.status) for r, _ in done} == {
        ("slow", 0, "over time"),
        ("slow", 1, "over time"),
        ("fast", 0, "ok"),
        ("fast", 1, "ok"),
    }
    for kept, arrays in done:
        if kept.status == "ok":
            assert kept.values == {"ends": True}
            np.testing.assert_array_equal(arrays["array"], [0, 1, 2])
        else:
            assert kept.message == "over 0.5 s"
            assert kept.values == {}
            assert arrays == {}


# Results and tables


def test_results_are_kept_rounded_and_replaced_as_a_group(tmp_path):
    path = tmp_path / "folder" / "results.json"
    first = Results(path)
    key = first.begin(threads=1)
    values = {"a": np.float64(1 / 3), "b": np.nan, "c": np.arange(2), "d": None}
    for seed in range(3):
        first.add(record(seed=seed, values=values, environment=key))
    first.add(record(section="held_out", environment=key))
    first.save()

    second = Results(path)
    assert [r.seed for r in second.of("truth")] == [0, 1, 2]
    assert second.records[0].values == {
        "a": 0.333333,
        "b": None,
        "c": [0, 1],
        "d": None,
    }
    assert second.environments[key]["threads"] == 1
    assert second.environments[key]["numpy"] == np.__version__
    # Two seeds take the place of three, other groups stay.
    second.environments["later"] = {"threads": 2}
    for seed in range(2):
        second.add(record(seed=seed, environment="later"))
    second.save()
    stored = json.loads(path.read_text(encoding="utf-8"))
    assert [(r["section"], r["seed"]) for r in stored["records"]] == [
        ("held_out", 0),
        ("truth", 0),
        ("truth", 1),
    ]
    assert set(stored["environments"]) == {key, "later"}


@pytest.mark.parametrize(
    ("figure", "text"),
    [
        (None, ""),
        (0.0, "0"),
        (1e-29, "0"),
        (0.0012345, "0.00123"),
        (12.3456, "12.3"),
        (1234.6, "1235"),
        (1.5e-7, "1.50e-07"),
        (3.1e7, "3.10e+07"),
    ],
)
def test_numbers(figure, text):
    assert number(figure) == text


def test_cells_say_median_range_and_failures():
    ok = [record(seed=i, values={"error": e}) for i, e in enumerate((0.1, 0.3, 0.2))]
    slow = record(seed=3, status="over time", message="over 60 s", values={})
    wrong = record(seed=4, status="error", message="ValueError: no", values={})
    error = value("error")
    assert cell(ok, error) == "0.200 (0.100 to 0.300)"
    assert cell(ok[:1], error) == "0.100"
    assert cell([*ok[:1], wrong], error) == "0.100, 1 failed"
    assert cell([slow, wrong], error) == "over 60 s"
    assert cell([wrong], error) == "error"
    assert cell([], error) == ""
    assert cell(ok, value("another")) == ""


def test_tables_have_a_row_a_method_and_a_column_a_set():
    records = [
        record(values={"error": 0.5}),
        record(method="pi", set="yoga", values={"error": 0.25}),
    ]
    titles = {"floor": "floor", "pi": "PI", "joint": "joint"}
    sets = {"yoga": "yoga, K=4", "shark": "shark", "drink": "drink, K=3"}
    assert grid(records, titles, sets, value("error"), corner="method") == table(
        ["method", "yoga, K=4", "drink, K=3"],
        [["PI", "0.250", ""], ["joint", "", "0.500"]],
    )
    assert table(["a", "b"], [["c", "d"]]) == "| a | b |\n| --- | --: |\n| c | d |\n"


def test_records_are_selected_by_attributes_and_parameters():
    records = [record(parameters={"noise": n}, seed=n) for n in (1, 2)]
    assert select(records, section="truth", noise=2) == records[1:]
    assert select(records, points=3) == []


def test_the_page_says_where_the_joint_refinement_is_not_the_lowest():
    records = [
        record(values={"inverse_snr": 0.01, "frame_error": 0.3}),
        record(method="rigid", values={"inverse_snr": 0.02, "frame_error": 0.2}),
        record(method="floor", values={"inverse_snr": 0.001}),
        record(method="bmm", status="over time", message="over 9 s", values={}),
    ]
    # That of other cameras does not count.
    records.append(
        records[0]._replace(method="orthographic", values={"frame_error": 0.1})
    )
    page = _fits.truth_page(records)
    line = "- drink, K=3, frame_error: 0.300; lower are rigid mean shape 0.200\n"
    assert page.partition("not the lowest in\n\n")[2].startswith(line + "\n")
    assert "| BMM | over 9 s |" in page
    records[1] = records[1]._replace(values={"inverse_snr": 0.02, "frame_error": 0.4})
    page = _fits.truth_page(records)
    assert "ISA, joint refinement is the lowest" in page
    assert "ISA, orthographic is the lowest" in page


def test_the_page_of_recovery_varies_one_setting_at_a_time():
    listed = _recovered.jobs("recovery", ["synthetic"], ["isa2", "joint"], 2)
    assert len(listed) == 2 * 2 * (5 + 5 + 5 - 2)
    records = [
        record(
            section=job.section,
            set=job.set,
            method=job.method,
            seed=job.seed,
            parameters=job.parameters,
            values={"similarity_modulo": job.parameters["n_points"] / 1000 + job.seed},
        )
        for job in listed
    ]
    page = _recovered.page(records)
    titles = "ISA2, paper's refinement | ISA, joint refinement |"
    assert f"| points | {titles}" in page
    assert f"| basis shapes K | {titles}" in page
    both = "0.6500 (0.1500 to 1.150)"
    assert f"| 150 | {both} | {both} |" in page
    both = "0.5680 (0.06800 to 1.068)"
    assert f"| 0.05 | {both} | {both} |" in page


def test_the_page_of_cost_has_exponents(tmp_path):
    listed = _cost.jobs("cost", ["synthetic"], ["joint", "svd"], 2)
    settings = _cost.SWEEP.settings()
    assert len(settings) == 6 + 6 + 5 - 2
    assert [job.method for job in listed].count("joint") == 2 * len(settings)
    assert [job.method for job in listed].count("svd") == len(settings)
    records = [
        record(
            section=job.section,
            set=job.set,
            method=job.method,
            seed=job.seed,
            parameters=job.parameters,
            values={
                "cpu_seconds": job.parameters["n_frames"] ** 1.5
                * job.parameters["n_points"]
            },
            memory=float(job.parameters["n_components"]),
        )
        for job in listed
    ]
    page = _cost.page(records)
    assert "| frames I | 1.50 | 1.50 |" in page
    assert "| points J | 1.00 | 1.00 |" in page
    assert "| basis shapes K | 1.00 |\n" in page
    assert _cost.draw(records, tmp_path) == ["cost.png"]
    assert (tmp_path / "cost.png").is_file()


@pytest.mark.parametrize("method", _cost.TITLES)
def test_cost_is_measured_of_each_method(method):
    setting = {"n_frames": 40, "n_points": 20, "n_components": 2}
    values, _ = _cost.measure_cost(nullcontext, method, 0, **setting)
    assert 0 < values["cpu_seconds"] < 60


def test_the_page_of_held_out_points_tells_what_was_chosen():
    half, found = {"part": "halves"}, {"part": "choice", "n_components": 2}
    records = [
        record(set="ict_68", parameters=half, values={"held_out": 0.25}),
        record(set="synthetic", parameters=found, values={"found": 2}),
        record(set="synthetic", parameters=found, values={"found": 3}, seed=1),
    ]
    for K, error in ((1, 0.3), (2, 0.1), (3, 0.2)):
        parameters = {"part": "curve", "n_components": K}
        records.append(record(parameters=parameters, values={"held_out": error}))
    page = _unseen.page(records)
    assert "| ISA, joint refinement | 0.250 |" in page
    assert "| 2 | 1 of 2 | 2, 3 |" in page
    assert "| K | 1 | 2 | 3 |" in page
    assert "| held-out error, % | 0.300 | **0.100** | 0.200 |" in page


def test_the_page_of_agreement_has_the_spread_of_the_pairs():
    values = {"basis": [0.9, 0.7, 0.8], "shapes": [0.1, 0.1, 0.1]}
    page = _agreement.page([record(values=values), record(method="isa1", values={})])
    assert "| joint, independent shapes | 0.8000 (0.7000 to 0.9000) |" in page
    assert "| joint, independent shapes | 0.100 |" in page
    assert "subspace_distance" not in page


# Sets and methods


def test_dense_shapes_and_tracks_follow_their_model():
    rng = np.random.default_rng(0)
    arrays = {
        "mean": rng.normal(size=(6, 3)),
        "identity": rng.normal(size=(2, 6, 3)),
        "expression": rng.normal(size=(3, 6, 3)),
        "identity_coeffs": rng.normal(size=(250, 2)),
        "expression_coeffs": rng.normal(size=(250, 3)),
        "R": np.array([random_rotation(i) for i in range(250)]),
    }
    i = 249
    shape = arrays["mean"].copy()
    for k in range(2):
        shape += arrays["identity_coeffs"][i, k] * arrays["identity"][k]
    for k in range(3):
        shape += arrays["expression_coeffs"][i, k] * arrays["expression"][k]
    tracks = _data.dense_tracks(arrays)
    assert tracks.shape == (250, 6, 2)
    np.testing.assert_allclose(tracks[i], shape @ arrays["R"][i, :2].T)
    np.testing.assert_allclose(_data.dense_shapes(arrays, [i])[0], shape)


@pytest.fixture(scope="module")
def tracks():
    return make_nonrigid_tracks(
        60, 30, 2, camera="orthographic", noise=0.01, random_state=0
    )


@pytest.mark.parametrize("camera", ["orthographic", "weak_perspective"])
def test_true_shapes_and_cameras_have_no_error(tracks, camera):
    rotations = np.concatenate(
        [tracks.motion, np.cross(tracks.motion[:, 0], tracks.motion[:, 1])[:, None]],
        axis=1,
    )
    # In another orientation of space, mirrored, and of another size.
    turn = 0.5 * random_rotation(1) @ np.diag([1.0, 1.0, -1.0])
    shapes = tracks.shapes @ turn
    mirror = np.diag([1.0, 1.0, -1.0])
    found = Found(
        tracks.data,
        affine=tracks.shapes @ np.random.default_rng(0).normal(size=(3, 3)),
        euclidean=shapes,
        rotations=mirror @ rotations @ turn / 0.5,
        scales=np.full(len(shapes), 2.0),
    )
    truth = tracks.shapes @ rotations.transpose(0, 2, 1)
    errors = _fits.errors_3d(Set("", None, "object", camera), truth, found)
    assert set(errors) == {"sequence_error", "frame_error"}
    np.testing.assert_allclose(list(errors.values()), 0.0, atol=1e-10)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_a_common_rotation_and_the_mirror_image_are_no_error(mirror):
    truth = np.array([random_rotation(i) for i in range(5)])
    depth = np.diag([1.0, 1.0, mirror])
    turned = depth @ truth @ random_rotation(9) @ depth
    np.testing.assert_allclose(accuracy.turn_errors(truth, turned), 0.0, atol=1e-5)
    # A turn of one frame by 60 degrees.
    half, root = 0.5, np.sqrt(0.75)
    turned[2] = [[half, -root, 0], [root, half, 0], [0, 0, 1]] @ turned[2]
    angles = accuracy.turn_errors(truth, turned)
    assert angles.argmax() == 2
    assert 45 < angles.max() < 61


def test_far_perspective_cameras_are_orthographic(tracks):
    X, shapes = accuracy.perspective(tracks, 1e6, 0.0, np.random.default_rng(0))
    centred = tracks.clean - tracks.clean.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(X.reshape(centred.shape), centred, atol=1e-4)
    np.testing.assert_allclose(shapes[..., :2], centred, atol=1e-10)


def test_the_prior_can_be_varied():
    X = make_nonrigid_tracks(60, 20, 2, noise=0.05, random_state=0).data
    usual = accuracy.fit_set(X, "affine", 2).noise_variance_
    other = accuracy.JOINT_OPTIONS._replace(basis_std=0.5, least_noise=0.25)
    assert accuracy.fit_set(X, "affine", 2, other).noise_variance_ != usual
    assert accuracy.fit_set(X, "affine", 2).noise_variance_ == usual


def test_all_limits_of_a_fit_can_be_varied():
    known = {name.split(".")[0] for name in sensitivity.STAGES} - {"fit"}
    stages = {
        name
        for name, value in FitLimits()._asdict().items()
        if hasattr(value, "_fields")
    }
    assert known == stages
    joint = {
        f"joint.{name}"
        for name, value in JointOptions()._asdict().items()
        if hasattr(value, "_fields")
    }
    assert joint <= set(sensitivity.STAGES)


def test_limits_are_halved_and_doubled(capsys):
    seen = []

    def case(estimator):
        seen.append(estimator._limits)
        return 1.0

    sensitivity.stage("fit", {"case": case}, None)
    usual = FitLimits()
    assert seen[:2] == [usual, usual]
    for name, factor in (("sample", 0.5), ("sample", 2.0), ("small_table", 0.5)):
        value = round(factor * getattr(usual, name))
        assert usual._replace(**{name: value}) in seen[2:]
    lines = [line.split()[:2] for line in capsys.readouterr().out.splitlines()]
    assert ["sample", "300"] in lines


def test_limits_of_inner_stages_are_replaced():
    limits = sensitivity.replaced(FitLimits(), ["joint", "starts"], "held_steps", 1)
    assert limits.joint.starts.held_steps == 1
    starts = JointOptions().starts
    assert limits.joint._replace(starts=starts) == JointOptions()


@pytest.mark.parametrize(
    ("value", "half", "twice"),
    [(0.3, 0.15, 0.6), (1, 1, 2), (5, 2, 10), ((6, 9), (3, 4), (12, 18))],
)
def test_half_and_twice_of_whole_numbers_are_whole(value, half, twice):
    assert sensitivity.changed(value, 0.5) == half
    assert sensitivity.changed(value, 2.0) == twice


@pytest.mark.slow
def test_cases_of_artificial_tables_have_errors():
    usual = sensitivity.limited(FitLimits())
    assert 0 < sensitivity.of_instances(usual, 40, 20, K=1, missing=0.05) < 20
    assert 50 < sensitivity.similarity(usual, 60, 30, K=1) <= 100


def test_as_many_points_are_hidden_as_is_said():
    tracks = np.zeros((200, 41, 2))
    for what, share in (("30 % missing", 0.3), (f"runs of {accuracy.RUN} missing", 0)):
        hidden = np.isnan(accuracy.SPOILS[what](tracks, np.random.default_rng(0)))
        assert (hidden[..., 0] == hidden[..., 1]).all()
        if share:
            assert hidden.mean() == pytest.approx(share, abs=0.02)
        else:
            np.testing.assert_array_equal(hidden[..., 0].sum(axis=1), accuracy.RUN)


@pytest.mark.parametrize("scale_frames", [True, False])
def test_rank_floor_is_that_of_a_fit(scale_frames):
    tracks = make_nonrigid_tracks(60, 40, 2, noise=0.01, random_state=0)
    model = AffineNRSfM(2, scale_frames=scale_frames, random_state=0).fit(tracks.data)
    floor = TruncatedTable(9, scale_frames).fit(tracks.data)
    error = inverse_snr(tracks.data, floor.X_, scale_frames=scale_frames)
    np.testing.assert_allclose(error, model.rank_floor_, rtol=1e-8)


@pytest.mark.parametrize("method", METHODS)
def test_what_methods_find_explains_the_table(tracks, method):
    kind = METHODS[method]
    model = kind.make(2, True, False, 0).fit(tracks.data)
    found = kind.found(model, tracks.data)
    # Frames that orthographic cameras see are not scaled.
    scaled = getattr(model, "camera", "affine") != "orthographic"
    error = inverse_snr(tracks.data, found.X, scale_frames=scaled)
    known = getattr(model, "inverse_snr_", error)
    np.testing.assert_allclose(error, known, rtol=1e-6)
    assert error < 0.2
    if found.euclidean is None:
        return
    # Euclidean shapes in their cameras are the same images.
    cameras = found.scales[:, None, None] * found.rotations[:, :2]
    images = found.euclidean @ cameras.transpose(0, 2, 1)
    if method != "rigid":  # whose cameras are affine
        table = images.reshape(len(images), -1)
        assert inverse_snr(found.X, table, scale_frames=True) < 1e-10
    eye = found.rotations @ found.rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(eye, np.broadcast_to(np.eye(3), eye.shape), atol=1e-8)


def test_every_set_and_method_of_a_section_is_known():
    for section in SECTIONS.values():
        assert set(section.sets) | set(section.other_sets) <= set(SETS)


def test_deterministic_methods_run_once_unless_tables_are_drawn_anew():
    listed = _fits.jobs("truth", ["drink", "synthetic"], ["pi", "joint"], 3)
    runs = {
        (name, method): [j.seed for j in listed if (j.set, j.method) == (name, method)]
        for name in ("drink", "synthetic")
        for method in ("pi", "joint")
    }
    assert runs.pop(("drink", "pi")) == [0]
    assert all(seeds == [0, 1, 2] for seeds in runs.values())
    assert [job.seed for job in listed] == sorted(job.seed for job in listed)


def test_synthetic_tables_are_drawn_by_seed():
    one, other = _sets.load("synthetic", 1), _sets.load("synthetic", 2)
    assert one.X.shape[1] == other.X.shape[1] == 2 * one.shapes.shape[1]
    assert not np.array_equal(one.X[:5], other.X[:5])
    np.testing.assert_array_equal(one.X, _sets.load("synthetic", 1).X)
    np.testing.assert_array_equal(one.shapes, _sets.true_shapes("synthetic", 1))


# Features and agreement


def test_aligned_frames_do_not_depend_on_place_size_and_turn(tracks):
    rng = np.random.default_rng(0)
    angle, size = rng.uniform(0, 6, len(tracks.tracks)), rng.uniform(0.5, 2, 60)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = tracks.tracks @ (size * turn).transpose(2, 0, 1) + rng.normal(
        size=(60, 1, 2)
    )
    aligned = AlignedFrames().fit(tracks.data)
    expected = aligned.transform(tracks.data)
    np.testing.assert_allclose(
        aligned.transform(moved.reshape(60, -1)), expected, atol=1e-10
    )
    # The mean is that of the aligned frames, up to its size.
    mean = expected.mean(axis=0)
    own = aligned.mean_.view(float)
    cosine = mean @ own / np.linalg.norm(mean) / np.linalg.norm(own)
    assert cosine == pytest.approx(1.0, abs=1e-9)
    plain = AlignedFrames(turn=False).fit_transform(tracks.data).reshape(60, -1, 2)
    np.testing.assert_allclose(plain.mean(axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.sum(plain**2, axis=(1, 2)), 30.0)


def test_errors_of_shapes_leave_out_their_rotations_and_a_mirror_image():
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(5, 20, 3))
    turned = np.stack([S @ random_rotation(i, 3) for i, S in enumerate(truth)])
    mirrored = turned * [1.0, 1.0, -1.0] + 3.0
    assert questions.turned_error(mirrored, truth) == pytest.approx(0.0, abs=1e-12)
    # Not of single frames, and not a scale.
    mirrored[0] *= [1.0, 1.0, -1.0]
    assert questions.turned_error(mirrored, truth) > 0.02
    centred = truth - truth.mean(axis=1, keepdims=True)
    assert questions.turned_error(1.1 * centred, truth) == pytest.approx(0.1)


def test_a_common_rotation_is_found():
    truth = np.stack([random_rotation(i, 3) for i in range(6)])
    common = random_rotation(9, 3)
    np.testing.assert_allclose(
        accuracy.common_rotation(truth, truth @ common), common, atol=1e-12
    )


def test_equal_fits_agree(tracks):
    model = AffineNRSfM(2, random_state=0).fit(tracks.data)
    same = compare(model, model, tracks.data)
    assert same["subspaces"] == pytest.approx(0.0, abs=1e-7)
    assert same["shapes"] == pytest.approx(0.0, abs=1e-7)
    assert same["basis"] == pytest.approx(1.0)
    assert same["mean_basis"] == pytest.approx(1.0)


# Pictures


def test_reprojections_are_drawn_on_the_same_axes_for_all_methods(
    tracks, tmp_path, monkeypatch
):
    figures = []
    monkeypatch.setattr(
        "benchmarks._figures.save", lambda figure, path: figures.append(figure)
    )
    frames = np.array([3, 8, 20])
    observed = tracks.tracks[frames]
    shown = {
        method: {"frames": frames, "observed": observed, "reprojected": k * observed}
        for k, method in ((3, "pi"), (1, "joint"))
    }
    titles = {"joint": "ISA, joint", "pi": "PI", "bmm": "BMM"}
    draw_reprojections(shown, titles, "synthetic", tmp_path / "a.png")
    axes = np.array(figures[0].axes).reshape(2, 3)
    assert [row[0].get_ylabel() for row in axes] == ["ISA,\njoint", "PI"]
    for panels in axes.T:
        assert panels[0].get_xlim() == panels[1].get_xlim()
        assert panels[0].get_ylim() == panels[1].get_ylim()
    assert axes[0, 1].get_title() == "frame 8\ninverse SNR 0 %"
    assert axes[1, 1].get_title() == "inverse SNR 400 %"


def test_bars_are_drawn_for_what_there_is(tmp_path):
    records = [
        record(values={"error": 0.01}),
        record(values={"error": 0.02}, seed=1),
        record(method="pi", status="over time", message="over 5 s", values={}),
        record(method="pi", set="yoga", values={"error": 0.1}),
    ]
    titles = {"pi": "PI", "joint": "joint", "bmm": "BMM"}
    sets = {"drink": "drink", "yoga": "yoga", "shark": "shark"}
    path = tmp_path / "bars.png"
    draw_bars(records, titles, sets, value("error"), path, label="error, %")
    assert path.read_bytes().startswith(b"\x89PNG")
    nothing = tmp_path / "nothing.png"
    draw_bars([], titles, sets, value("error"), nothing, label="error, %")
    assert not nothing.exists()


# The command


@pytest.mark.subprocess
def test_command_measures_writes_and_rewrites(tmp_path, capsys):
    chosen = ["truth", "--sets", "synthetic", "--methods", "rigid", "floor"]
    output = ["--output", str(tmp_path)]
    command.main([*chosen, "--repeats", "1", "--jobs", "2", *output])
    printed = capsys.readouterr().out
    assert "[2/2] truth synthetic" in printed
    page = (tmp_path / "truth.md").read_text(encoding="utf-8")
    assert "| rigid mean shape | " in page
    assert "time_limit 600" in page
    stored = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert {r["method"] for r in stored["records"]} == {"rigid", "floor"}
    pictures = sorted(path.name for path in tmp_path.glob("*.png"))
    assert pictures == [
        "truth_affine_shape_error.png",
        "truth_frame_error.png",
        "truth_sequence_error.png",
    ]

    (tmp_path / "truth.md").unlink()
    command.main(["--tables-only", *output])
    assert (tmp_path / "truth.md").read_text(encoding="utf-8") == page
    assert sorted(path.name for path in tmp_path.glob("*.md")) == ["truth.md"]


def test_absent_sets_are_skipped_by_name(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("ISA_NRSFM_DATA", str(tmp_path / "nowhere"))
    command.main(["reprojection", "--output", str(tmp_path)])
    printed = capsys.readouterr().out
    for name, file in (
        ("shark", "shark_torresani"),
        ("flag", "flag_mocap_30x250"),
        ("faces_wild", "faces_wild_68_combined"),
        ("ict_dense", "ict_bu3dfe_like_basis"),
    ):
        line = (
            f"reprojection {name}: skipped, no {file}.npz in the folder ISA_NRSFM_DATA"
        )
        assert line in printed
    assert not list(tmp_path.glob("*.md"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["speed"], "no section speed here; there are reprojection, truth"),
        (["truth", "--sets", "muct_68"], "no set muct_68 here; there are shark"),
        (["recovery", "--methods", "pca"], "no method pca here; there are isa1"),
        (["--repeats", "0"], "--repeats, --jobs and --threads must be 1 or more"),
    ],
)
def test_command_refuses_what_it_does_not_know(arguments, message, capsys):
    with pytest.raises(SystemExit):
        command.main(arguments)
    assert message in capsys.readouterr().err


def test_options_of_frames_are_varied_one_by_one():
    (_, usual), *others = frame_search.variants()

    def flat(options):
        return np.concatenate([np.ravel(value) for value in options])

    for title, changed in others:
        ratio = flat(changed) / flat(usual)
        assert np.sum(ratio != 1) == 1, title
        # Whole numbers are rounded down.
        factor = ratio[ratio != 1][0]
        assert 1 / 3 <= factor <= 0.5 or factor == 2, title
    n_values = len(flat(usual))
    assert len(others) == 2 * n_values
    assert len(list(frame_search.variants(only=["settled", "affine"]))) == 1 + 2 + 10
