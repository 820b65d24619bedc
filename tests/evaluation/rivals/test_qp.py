"""The programme of mpc and deepc, against general solvers."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize

from jaxouter.evaluation.rivals.qp import SOFT, Condensed, Solver, blocks, differences, limit_rows
from tests import lag

MOVES, KNOWN, ROWS = 5, 3, 4


def programme(seed, bound, row_bound=None):
    """A random programme, with limits on rows if asked."""
    rng = np.random.default_rng(seed)
    root, F = rng.normal(size=(MOVES + 2, MOVES)), rng.normal(size=(MOVES, KNOWN))
    rows = 0 if row_bound is None else ROWS
    free, forced = rng.normal(size=(rows, KNOWN)), rng.normal(size=(rows, MOVES))
    return Condensed(root.T @ root, F, -bound, bound, free, forced, np.full(rows, row_bound or 0.0))


def optimum(qp, z):
    """With the excess over the rows eliminated the cost is smooth and convex."""
    price = SOFT * np.max(np.diag(qp.H))

    def cost(u):
        rows = qp.rows_free @ z + qp.rows_forced @ u
        over = rows - np.clip(rows, -qp.rows_bound, qp.rows_bound)
        gradient = qp.H @ u + qp.F @ z + price * qp.rows_forced.T @ over
        return 0.5 * u @ qp.H @ u + (qp.F @ z) @ u + 0.5 * price * over @ over, gradient

    options = {"maxiter": 10_000, "maxfun": 100_000, "ftol": 1e-15, "gtol": 1e-9, "maxcor": 30}
    bounds = [(qp.low, qp.high)] * MOVES
    return scipy.optimize.minimize(cost, np.zeros(MOVES), jac=True, method="L-BFGS-B", bounds=bounds, options=options).x


def test_without_active_constraints_it_is_the_linear_law():
    qp = programme(0, bound=100.0, row_bound=100.0)
    solve = Solver(qp)
    for z in np.random.default_rng(1).normal(size=(5, KNOWN)):
        np.testing.assert_array_equal(solve(z), solve.law @ z)
        np.testing.assert_allclose(qp.H @ solve(z), -qp.F @ z, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_with_active_bounds_it_is_bounded_least_squares(seed):
    qp = programme(seed, bound=0.3)
    solve, active = Solver(qp), 0
    R = np.linalg.cholesky(qp.H).T
    for z in np.random.default_rng(seed).normal(size=(5, KNOWN)):
        expected = scipy.optimize.lsq_linear(R, -np.linalg.solve(R.T, qp.F @ z), (qp.low, qp.high), tol=1e-12).x
        found = solve(z)
        np.testing.assert_allclose(found, expected, atol=1e-3)
        assert np.abs(found).max() <= 0.3
        active += np.count_nonzero(np.abs(expected) > 0.3 - 1e-6)
    assert active > 0


@pytest.mark.parametrize("seed", range(5))
def test_with_active_rows_it_is_the_penalised_optimum(seed):
    qp = programme(seed, bound=1.0, row_bound=0.2)
    solve, left = Solver(qp), 0
    for z in np.random.default_rng(seed).normal(size=(5, KNOWN)):
        found = solve(z)
        np.testing.assert_allclose(found, optimum(qp, z), atol=2e-3)
        assert np.abs(found).max() <= 1.0
        left += not np.all(np.abs(qp.rows_free @ z + qp.rows_forced @ (solve.law @ z)) <= 0.2)
    assert left > 0


def test_what_is_not_a_number_gives_none():
    for qp in (programme(0, bound=1.0), programme(0, bound=1.0, row_bound=0.2)):
        solve = Solver(qp)
        assert np.isnan(solve(np.array([0.0, np.nan, 0.0]))).all()
        assert np.isfinite(solve(np.ones(KNOWN))).all()


@pytest.mark.parametrize("horizon", [1, 2, 5, 10, 40, 60])
def test_blocks_hold_ever_longer_and_fill_the_horizon(horizon):
    held = blocks(horizon)
    assert held.shape[0] == horizon
    np.testing.assert_array_equal(held.sum(1), 1.0)
    which, lengths = held.argmax(1), held.sum(0)
    np.testing.assert_array_equal(np.unique(np.diff(which, prepend=0)), [0, 1] if horizon > 1 else [0])
    assert lengths[0] == 1
    assert (np.diff(lengths[:-1]) >= 0).all()
    assert lengths.min() >= 1


def test_ten_steps_are_seven_moves():
    np.testing.assert_array_equal(blocks(10).sum(0), [1, 1, 1, 1, 2, 2, 2])


def test_differences_begin_with_the_first_move_itself():
    np.testing.assert_array_equal(differences(3) @ [5.0, 7.0, 4.0], [5.0, 2.0, -3.0])


def test_rows_of_limits_by_hand():
    """Outputs of four steps from z = [a, y] and one move; the first two are watched."""
    free = np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0], [4.0, 0.0]])
    forced, now = np.array([[0.5], [0.7], [0.8], [0.9]]), np.array([0.0, 1.0])

    def rows(margin, **limits):
        return limit_rows(replace(lag.LAG, **limits), free, forced, now, margin)

    def check(found, *expected):
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other)

    check(rows(0.0), np.zeros((0, 2)), np.zeros((0, 1)), np.zeros(0))
    check(rows(0.1, output_limit=5.0), free[:2], forced[:2], [4.9, 4.9])
    check(rows(0.1, rate_limit=0.5), [[1.0, -1.0], [1.0, 0.0]], [[0.5], [0.2]], [0.4, 0.4])
    both = rows(9.0, output_limit=5.0, rate_limit=0.5)
    check(both, [*free[:2], [1.0, -1.0], [1.0, 0.0]], [[0.5], [0.7], [0.5], [0.2]], [1.0, 1.0, 0.1, 0.1])
