"""The condensed quadratic programme that `mpc` and `deepc` solve at each step, by OSQP.

Both reduce to the same law: from what they know, a vector z, find the future moves u that minimise a quadratic cost,
with r~ within its bounds and the predicted y softly within the limits of the plant.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import osqp
import scipy

from jaxouter.plants import Plant

SOFT = 1e3  # price of a squared excess over the limits, relative to a squared error
TOLERANCE = 1e-5


class Condensed(NamedTuple):
    """Minimise 1/2 u'Hu + (F z)'u over low <= u <= high, |rows_free z + rows_forced u| <= rows_bound, softly."""

    H: np.ndarray  # (M, M)
    F: np.ndarray  # (M, n)
    low: float
    high: float
    rows_free: np.ndarray  # (R, n), limited quantities without moves
    rows_forced: np.ndarray  # (R, M)
    rows_bound: np.ndarray  # (R,), they lie within plus or minus this


def blocks(horizon: int) -> np.ndarray:
    """(horizon, M): moves of r~ at first each step, then ever less often; the last one is held to the end."""
    lengths: list[int] = []
    while sum(lengths) < horizon:
        lengths.append(1 + len(lengths) // 4)
    lengths[-1] -= sum(lengths) - horizon
    return np.repeat(np.eye(len(lengths)), lengths, axis=0)


def differences(moves: int) -> np.ndarray:
    """(M, M): each move minus the one before; the first as it is."""
    return np.eye(moves) - np.eye(moves, k=-1)


def limit_rows(
    plant: Plant, free: np.ndarray, forced: np.ndarray, now: np.ndarray, margin: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The plant's limits on predicted outputs free z + forced u, as the last three fields of `Condensed`.

    Watched over the first half of the horizon. `now` (n,) picks the present y out of z; `margin` is kept from each
    limit, up to 80 % of it.
    """
    watched = max(1, len(free) // 2)
    free, forced = free[:watched], forced[:watched]
    kinds = []
    if plant.output_limit is not None:
        kinds.append((free, forced, plant.output_limit))
    if plant.rate_limit is not None:
        before = np.vstack([now, free[:-1]]), np.vstack([np.zeros_like(forced[:1]), forced[:-1]])
        kinds.append((free - before[0], forced - before[1], plant.rate_limit))
    if not kinds:
        return free[:0], forced[:0], np.zeros(0)
    bound = np.concatenate([np.full(watched, max(0.2 * limit, limit - margin)) for *_, limit in kinds])
    return np.vstack([rows for rows, _, _ in kinds]), np.vstack([rows for _, rows, _ in kinds]), bound


class Solver:
    """One programme, for any z. The law where nothing limits is linear and needs no iterations."""

    def __init__(self, qp: Condensed) -> None:
        self.qp = qp
        self.law = -np.linalg.solve(qp.H, qp.F)
        moves, rows = len(qp.H), len(qp.rows_bound)
        # The variables are u and, where there are limits, an excess for each row.
        H = scipy.sparse.block_diag([scipy.sparse.csc_matrix(qp.H), SOFT * scipy.sparse.eye(rows)], format="csc")
        bounds = scipy.sparse.hstack([scipy.sparse.eye(moves), scipy.sparse.csc_matrix((moves, rows))])
        limits = scipy.sparse.hstack([scipy.sparse.csc_matrix(qp.rows_forced), scipy.sparse.eye(rows)])
        self._low, self._high = np.full(moves, qp.low), np.full(moves, qp.high)
        self._osqp = osqp.OSQP()
        self._osqp.setup(
            P=scipy.sparse.triu(H, format="csc"),
            q=np.zeros(moves + rows),
            A=scipy.sparse.vstack([bounds, limits], format="csc"),
            l=np.concatenate([self._low, -qp.rows_bound]),
            u=np.concatenate([self._high, qp.rows_bound]),
            verbose=False,
            eps_abs=TOLERANCE * max(abs(qp.low), abs(qp.high)),
            eps_rel=TOLERANCE,
            max_iter=2000,
            adaptive_rho=True,
        )

    def __call__(self, z: np.ndarray) -> np.ndarray:
        """The moves (M,)."""
        qp = self.qp
        u = self.law @ z
        free = qp.rows_free @ z
        if u.min() >= qp.low and u.max() <= qp.high and np.all(np.abs(free + qp.rows_forced @ u) <= qp.rows_bound):
            return u
        if not np.all(np.isfinite(z)):
            return np.full(len(qp.H), np.nan)
        q = np.concatenate([qp.F @ z, np.zeros(len(free))])
        self._osqp.update(
            q=q,
            l=np.concatenate([self._low, -qp.rows_bound - free]),
            u=np.concatenate([self._high, qp.rows_bound - free]),
        )
        found = self._osqp.solve(raise_error=False).x[: len(u)]
        return np.clip(found, qp.low, qp.high)
