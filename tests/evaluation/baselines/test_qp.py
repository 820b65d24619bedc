"""The programme of mpc and deepc, against general solvers."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.optimize

from jaxouter.evaluation.baselines.qp import SOFT, Condensed, Solver, blocks, differences, limit_rows
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
    """As bounded least squares: with the rows' values within their bound as further variables, the excess is linear."""
    R = np.linalg.cholesky(qp.H).T
    rows, price = len(qp.rows_bound), np.sqrt(SOFT)
    A = np.block([[R, np.zeros((MOVES, rows))], [price * qp.rows_forced, -price * np.eye(rows)]])
    b = np.concatenate([-np.linalg.solve(R.T, qp.F @ z), -price * qp.rows_free @ z])
    bound = np.concatenate([np.full(MOVES, qp.high), qp.rows_bound])
    return scipy.optimize.lsq_linear(A, b, (-bound, bound), method="bvls", tol=1e-12).x[:MOVES]


def test_without_active_constraints_it_is_the_linear_law():
    qp = programme(0, bound=100.0, row_bound=100.0)
    solve = Solver(qp)
    for z in np.random.default_rng(1).normal(size=(5, KNOWN)):
        np.testing.assert_array_equal(solve(z), solve.law @ z)
        np.testing.assert_allclose(qp.H @ solve(z), -qp.F @ z, atol=1e-12)


@pytest.mark.parametrize(("bound", "row_bound"), [(0.2, None), (0.5, 0.2)])
@pytest.mark.parametrize("seed", range(5))
def test_with_active_constraints_it_is_the_optimum(seed, bound, row_bound):
    qp = programme(seed, bound, row_bound)
    solve, active = Solver(qp), 0
    for z in np.random.default_rng(seed).normal(size=(5, KNOWN)):
        found = solve(z)
        np.testing.assert_allclose(found, optimum(qp, z), atol=1e-3)
        assert np.abs(found).max() <= bound
        active += not np.array_equal(found, solve.law @ z)
    assert active > 0


def test_excess_over_rows_is_small_where_they_can_be_kept_and_paid_where_not():
    """One move u towards 2, twice of which should stay below 1; bounds leave it room, or keep it from helping."""
    one = np.eye(1)
    free = Condensed(one, -one, -9.0, 9.0, 0.0 * one, 2.0 * one, np.ones(1))
    np.testing.assert_allclose(Solver(free)([2.0]), 0.5, atol=1e-3)
    stuck = free._replace(rows_free=-3.0 * one, high=0.4, low=-0.4)
    np.testing.assert_allclose(Solver(stuck)([2.0]), 0.4, atol=1e-3)


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
