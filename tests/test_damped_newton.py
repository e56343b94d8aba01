"""Newton's method for many frames, on functions of which all is known."""

from typing import NamedTuple

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from isa_nrsfm._frames.camera_models import CAMERAS
from isa_nrsfm._frames.search import FrameSearch, Minimum, State
from isa_nrsfm._linalg.small_matrices import LANES


class Frames(NamedTuple):
    a: np.ndarray
    energy: np.ndarray


class Wells(FrameSearch):
    """The functions ``x^4 / 4 - a x^2 / 2`` of frames, with minima ``+- sqrt(a)``."""

    def __init__(self, a, energy=1.0):
        a = np.array(a, dtype=float)
        self.problem = Frames(a, np.full_like(a, energy))
        self.tried = []  # numbers of frames
        self.model = CAMERAS["affine"]  # steps are added

    def value(self, x, a):
        return x[0] ** 4 / 4 - a * x[0] ** 2 / 2

    def evaluate(self, problem, x):
        self.tried.append(x.shape[1])
        slope, hessian = problem.a * x - x**3, 3 * x**2 - problem.a
        value = self.value(x, problem.a)
        return State(x, value, slope / 2, np.ones_like(x), hessian / 2)


def ended(wells, start, max_steps=60, known=None):
    start = wells.evaluate(wells.problem, np.array([start], dtype=float))
    found, converged = wells.descend(wells.problem, start, max_steps, known)
    return found[0], converged


class TestMinima:
    def test_are_those_of_the_side_that_frames_start_from(self):
        a = np.array([1.0, 4.0, 0.25, 9.0, 1.0])
        start = np.array([0.1, -0.1, 3.0, -20.0, 1.0])
        found, converged = ended(Wells(a), start)
        assert_allclose(found, np.sign(start) * np.sqrt(a), rtol=1e-7)
        assert converged.all()

    def test_frames_are_separate(self):
        a, start = [1.0, 4.0, 0.25], [0.1, -7.0, 3.0]
        together, _ = ended(Wells(a), start)
        alone = [ended(Wells([x]), [y])[0][0] for x, y in zip(a, start, strict=True)]
        assert_array_equal(together, alone)

    @pytest.mark.parametrize("max_steps", range(8))
    def test_value_never_rises(self, max_steps):
        problem = Wells([1.0, 4.0, 2.0])
        start = np.array([0.01, 1.2, -0.6])
        ends = (ended(problem, start, n)[0] for n in range(max_steps + 1))
        values = [problem.value(end[None], problem.problem.a) for end in ends]
        assert (np.diff(values, axis=0) <= 1e-13).all()

    def test_steps_that_raise_the_value_are_refused(self):
        # The Newton step from here, x = 0.6, is beyond the other minimum and higher.
        problem = Wells([1.0])
        state = problem.evaluate(problem.problem, np.array([[0.6]]))
        step, _ = problem.step(state, np.zeros(1))
        assert problem.value(state.position + step, 1.0) > state.value
        found, converged = ended(problem, [0.6])
        assert_allclose(np.abs(found), 1.0, rtol=1e-7)
        assert converged.all()
        assert_array_equal(ended(problem, [0.6], 1)[0], [0.6])


class TestEnds:
    def test_start_is_the_end_without_steps(self):
        start = np.array([0.5, 2.0])
        found, converged = ended(Wells([1.0, 1.0]), start, 0)
        assert_array_equal(found, start)
        assert not converged.any()

    def test_converged_start_is_told_without_a_step(self):
        problem = Wells([1.0, 4.0])
        found, converged = ended(problem, [1.0, 2.0 + 1e-9], 0)
        assert converged.all()
        assert_allclose(found, [1.0, 2.0], rtol=1e-15)

    def test_frames_that_have_ended_are_not_evaluated(self):
        # Those that are left are filled up to a multiple of LANES.
        problem = Wells([1.0] * 3 * LANES)
        starts = np.repeat([1.0, 1.0 + 1e-3, 20.0], LANES)
        ended(problem, starts)
        assert problem.tried[:2] == [3 * LANES, 2 * LANES]
        assert problem.tried == sorted(problem.tried, reverse=True)
        assert problem.tried[-1] == LANES

    def test_tolerance_is_a_share_of_the_energy(self):
        exact, _ = ended(Wells([1.0]), [3.0])
        rough, _ = ended(Wells([1.0], energy=1e10), [3.0])
        assert 1e-9 < abs(rough[0] - 1.0) < 0.1
        assert abs(exact[0] - 1.0) < 1e-12

    def test_search_is_given_up_where_the_known_minimum_is_out_of_reach(self):
        # The minimum of both is -1/4.
        known = Minimum(np.zeros((1, 2)), np.array([-10.0, -0.2]), np.zeros(2))
        problem = Wells([1.0, 1.0])
        found, converged = ended(problem, [1.1, 1.1], known=known)
        assert_array_equal(converged, [False, True])
        assert found[0] == 1.1
        assert_allclose(found[1], 1.0, rtol=1e-7)

    def test_search_is_given_up_in_the_well_of_the_known_minimum(self):
        known = Minimum(np.ones((1, 2)), np.full(2, -0.3), np.array([0.2, 0.01]))
        found, converged = ended(Wells([1.0, 1.0]), [1.5, 1.5], 3, known)
        steps = [ended(Wells([1.0]), [1.5], n)[0][0] for n in range(4)]
        first = next(x for x in steps if abs(x - 1.0) < 0.2)
        assert found[0] == first
        assert abs(found[1] - 1.0) < abs(found[0] - 1.0)
        assert not converged[0]

    def test_largest_damping_ends_the_search(self):
        # A value that is always higher than at the start: no step is taken.
        class Walls(Wells):
            def value(self, x, a):
                return np.where(x[0] == 0.5, 0.0, 1.0)

        problem = Walls([1.0])
        found, converged = ended(problem, [0.5], 1000)
        assert_array_equal(found, [0.5])
        assert not converged.any()
        assert len(problem.tried) < 30
