"""Boeing 747 pitch control with a delayed human pilot (paper section III).

Units: x1 = u, x2 = w in ft/s, x3 = q in crad/s, x4 = theta in crad (1 crad = 0.01 rad), time in s. A, B: Bryson, 747 at
40 kft and 774 ft/s. The paper's 'Neal-Schmidt' pilot is the Neal-Smith pilot, 0.5 (s+1)/(5s+1) exp(-tau s).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from flax import struct

from jaxouter.plants import delay
from jaxouter.plants.base import Plant, array

CONTROL_STEP = 0.1  # s
START_SPREAD = (1.0, 1.0, 0.5, 5.0)  # training starts are uniform within +- this

A_747 = (
    (-0.003, 0.039, 0.0, -0.322),
    (-0.065, -0.319, 7.740, 0.0),
    (0.020, -0.101, -0.429, 0.0),
    (0.0, 0.0, 1.0, 0.0),
)
B_747 = (0.010, -0.180, -1.160, 0.0)
W_PRINTED = (0.1, 0.3, -0.3)


@struct.dataclass
class PitchParams:
    """Parameters of the pitch plant; every array is traced. Symbols are the paper's."""

    tau: jax.Array  # delay of the pilot, s
    d1: jax.Array  # delay of x in the controller, s
    d2: jax.Array  # delay of xc in the controller, s
    W: jax.Array  # (3,), uncertainty delta(x) = W' [1, x1, x2]
    A: jax.Array  # (4, 4)
    B: jax.Array  # (4,)
    A_h: jax.Array  # pilot, 1/s
    B_h: jax.Array
    C_h: jax.Array
    D_h: jax.Array
    K1: jax.Array  # (4,), gain on x
    K2: jax.Array  # gain on xc
    gain: jax.Array  # multiplies u
    disturbance: jax.Array  # added to u, crad
    max_delay: float = struct.field(pytree_node=False)  # s; static: sets the length of the delay lines
    substeps: int = struct.field(pytree_node=False)  # inner steps per control step
    late: tuple[bool, bool, bool] | None = struct.field(pytree_node=False)
    """Which of theta, K1 x and K2 xc are delayed by more than a control step; the others must have no delay. A control
    step is then one matrix product. None: any delays, simulated in inner steps."""


class PitchState(NamedTuple):
    """State of the pitch plant; all zero at rest.

    All but `k` may have trailing axes, for several plants that started together.
    """

    x: jax.Array  # (4,), [u ft/s, w ft/s, q crad/s, theta crad]
    xc: jax.Array  # integral of theta - c, crad s
    xi: jax.Array  # pilot
    lines: (
        jax.Array
    )  # (3, L), delay lines of theta, K1 x, K2 xc (only the late ones, if set), one sample per inner step
    r_tilde_line: jax.Array  # (M,), delay line of r~, one sample per control step
    k: jax.Array  # int32, control steps since the start


def lqr(A: Any, B: Any, Q: Any, R: float) -> tuple[np.ndarray, float]:
    """Gains of the paper's controller: LQR on [x; xc] with xc' = x4 (without the pilot).

    Returns:
        K1 (4,) and K2, of u = -K1 x - K2 xc.

    Source: paper section III-A and its table.
    """
    A, B = np.asarray(A, float), np.asarray(B, float)
    augmented = np.zeros((5, 5))
    augmented[:4, :4] = A
    augmented[4, 3] = 1.0
    column = np.append(B, 0.0)[:, None]
    P = scipy.linalg.solve_continuous_are(augmented, column, np.diag(Q), [[R]])
    K = (column.T @ P)[0] / R
    return K[:4], float(K[4])


def make(
    *,
    tau: float = 0.5,
    d1: float = 0.0,
    d2: float = 0.0,
    W: Sequence[float] = (0.1, 0.003, -0.003),
    A: Any = A_747,
    B: Any = B_747,
    A_h: float = -0.2,
    B_h: float = 1.0,
    C_h: float = 0.08,
    D_h: float = 0.1,
    Q: Any = (0.0, 0.0, 0.0, 1.0, 2.5),
    R: float = 10.0,
    K1: Any = None,
    K2: float | None = None,
    gain: float = 1.0,
    disturbance: float = 0.0,
    max_delay: float | None = None,
    substeps: int = 10,
) -> tuple[Plant, PitchParams]:
    """The pitch plant and its parameters.

    Args:
        tau, d1, d2: delays of pilot, state feedback and integral feedback, s; any real number in [0, max_delay].
        W: uncertainty. The printed (0.1, 0.3, -0.3) makes the loop unstable; the default has x1, x2 in hundreds.
        A, B, A_h, B_h, C_h, D_h: aircraft and pilot.
        Q, R: weights of the LQR design, (5,) diagonal and a number; unused if K1 and K2 are given.
        K1, K2: gains; None: the LQR gains of A, B, Q, R.
        gain, disturbance: multiplies u; added to u, crad.
        max_delay: longest delay the lines can hold, s. If given, the plant takes every delay in [0, max_delay] (for a
            sweep) and is simulated in inner steps. None: the largest of the three delays. The plant is then simulated
            in whole control steps, many times faster, if tau exceeds a control step and d1 and d2 are longer than one
            or zero.
        substeps: inner steps per control step of 0.1 s; at least 10, so that none is longer than 0.01 s.

    Raises:
        ValueError: a delay is negative or above max_delay, a shape is wrong, or there are too few substeps.
    """
    scalars = dict(tau=tau, d1=d1, d2=d2, A_h=A_h, B_h=B_h, C_h=C_h, D_h=D_h, gain=gain, disturbance=disturbance)
    numbers = {name: array(name, value, ()) for name, value in scalars.items()}
    A, B, Q = array("A", A, (4, 4)), array("B", B, (4,)), array("Q", Q, (5,))
    delays = {name: float(numbers[name]) for name in ("tau", "d1", "d2")}
    longest = max_delay
    if max_delay is None and all(map(math.isfinite, delays.values())):
        longest = _enough(*delays.values())
    if longest is not None and not 0.0 <= longest < math.inf:
        raise ValueError(f"max_delay is {longest:g} s; it must be a number of at least 0")
    for name, value in delays.items():
        if longest is None or not 0.0 <= value <= longest + 1e-6:
            bound = "max_delay" if longest is None else f"{longest:g}"
            raise ValueError(f"{name} is {value:g} s; a delay must lie in [0, max_delay] = [0, {bound}] s")
    if substeps < 10:
        raise ValueError(f"substeps is {substeps}; it must be at least 10 (an inner step of at most 0.01 s)")
    if K1 is None or K2 is None:
        if not R > 0:
            raise ValueError(f"R is {R}; it must be positive")
        designed = lqr(A, B, Q, R)
        K1 = designed[0] if K1 is None else K1
        K2 = designed[1] if K2 is None else K2
    params = PitchParams(
        **numbers,
        W=array("W", W, (3,)),
        A=A,
        B=B,
        K1=array("K1", K1, (4,)),
        K2=array("K2", K2, ()),
        max_delay=longest or 0.0,
        substeps=substeps,
        late=None if max_delay is not None else _late(substeps, **delays),
    )
    return PITCH, params


def _late(substeps: int, tau: float, d1: float, d2: float) -> tuple[bool, bool, bool] | None:
    """`PitchParams.late` for these delays, s."""
    fits = tau > 0.0 and all(delay == 0.0 or delay >= _least_late(substeps) for delay in (tau, d1, d2))
    return (True, d1 > 0.0, d2 > 0.0) if fits else None


def _least_late(substeps: int) -> float:
    """The least delay, s, with which no sample of a control step acts within that step: half an inner step more."""
    return CONTROL_STEP + CONTROL_STEP / substeps / 2 - 1e-6


def _enough(*delays: float) -> float:
    """The smallest `max_delay` for these delays, s."""
    return max(0.0, math.ceil(round(max(delays) / CONTROL_STEP, 5)) * CONTROL_STEP)


def smallest(params: PitchParams) -> PitchParams:
    """The same plant with the shortest delay lines it needs, in whole control steps if possible."""
    delays = dict(tau=float(params.tau), d1=float(params.d1), d2=float(params.d2))
    return dataclasses.replace(params, max_delay=_enough(*delays.values()), late=_late(params.substeps, **delays))


def widened(params: PitchParams, ranges: Mapping[str, tuple[float, float]]) -> PitchParams:
    """The same plant with delay lines for delays in these ranges, then simulated in inner steps.

    Raises:
        ValueError: a delay may be negative.
    """
    delays = {name: ranges[name] for name in ("tau", "d1", "d2") if name in ranges}
    for name, (low, high) in delays.items():
        if not low >= 0.0:
            raise ValueError(f"the range of {name} is {low:g} to {high:g} s; a delay must not be negative")
    if not delays:
        return params
    longest = _enough(params.max_delay, *(high for _, high in delays.values()))
    return dataclasses.replace(params, max_delay=longest, late=None)


def init(key: chex.PRNGKey, params: PitchParams) -> PitchState:
    """Rest: everything zero."""
    del key
    zero = jnp.zeros(())
    if params.late is None:
        lines = (3, delay.length(params.max_delay, CONTROL_STEP / params.substeps))
    else:
        lines = (sum(params.late), delay.block_length(params.max_delay, CONTROL_STEP, params.substeps))
    return PitchState(
        x=jnp.zeros(4),
        xc=zero,
        xi=zero,
        lines=jnp.zeros(lines),
        r_tilde_line=jnp.zeros(delay.length(params.max_delay, CONTROL_STEP)),
        k=jnp.zeros((), jnp.int32),
    )


def start(key: chex.PRNGKey, params: PitchParams) -> PitchState:
    """A training start: x uniform within +- `START_SPREAD`, the rest zero."""
    spread = jnp.asarray(START_SPREAD)
    return init(key, params)._replace(x=jax.random.uniform(key, (4,), spread.dtype, -spread, spread))


def reuse(old: PitchState, fresh: PitchState) -> PitchState:
    """The fresh state with the old lines: reads before the start of an episode give zero, whatever they hold."""
    return fresh._replace(lines=old.lines, r_tilde_line=old.r_tilde_line)


def output(params: PitchParams, state: PitchState) -> jax.Array:
    """Y = theta = x4, crad."""
    del params
    return state.x[3]


def step(params: PitchParams, state: PitchState, r_tilde: jax.Array, key: chex.PRNGKey) -> PitchState:
    """One control step of 0.1 s with r~ (scalar, crad) held.

    The delay-free part is linear and propagated exactly. Delayed inputs are held over an inner step at their midpoint
    value (r~: at its mean), which makes the scheme second order. A delay outside what the parameters were made for
    gives NaN. With whole control steps, many plants that started together can be stepped without vmap (see
    `PitchState`): r~ and the delays may have trailing axes.

    Source: paper section III; what the paper leaves out is in docs/reproduction.md.
    """
    del key
    p, h = params, CONTROL_STEP / params.substeps
    tau = jnp.where(_served(p), p.tau, jnp.nan)
    lags = [value / h for value in (tau, p.d1, p.d2)]
    z = jnp.concatenate([state.x, state.xc[None], state.xi[None]])
    r_tilde_line = delay.write(state.r_tilde_line, state.k, r_tilde)
    advance = _inner_steps if p.late is None else _whole_step
    z, lines = advance(p, z, state.lines, r_tilde_line, state.k, lags)
    return PitchState(z[:4], z[4], z[5], lines, r_tilde_line, state.k + 1)


def _served(p: PitchParams) -> jax.Array:
    """Whether the parameters were made for these delays."""
    delays, late = (p.tau, p.d1, p.d2), p.late or (False, False, False)
    least = _least_late(p.substeps)
    bounds = [(least, p.max_delay) if is_late else (0.0, 0.0 if p.late else p.max_delay) for is_late in late]
    fits = [(value >= low) & (value <= high + 1e-6) for value, (low, high) in zip(delays, bounds, strict=True)]
    return fits[0] & fits[1] & fits[2]


def _whole_step(
    p: PitchParams, z: jax.Array, lines: jax.Array, r_tilde_line: jax.Array, k: jax.Array, lags: list[jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """[x; xc; xi] and the lines after a control step, when all delayed signals are known at its start."""
    assert p.late is not None
    n, first = p.substeps, k * p.substeps
    late = [i for i in range(3) if p.late[i]]
    of_z, of_theta_e, of_u = jnp.split(_propagator(p, late), [6, 6 + n], 1)
    asked = delay.held_window(r_tilde_line, k, lags[0], n)
    theta, *fed_back = (delay.window(lines[row], first, lags[i] - 0.5, n) for row, i in enumerate(late))
    constant = (p.disturbance + p.W[0]) * jnp.sum(of_u, 1, keepdims=True)
    parts = [(of_z, z), (constant, jnp.ones_like(z[:1]))]
    delayed = [(of_theta_e, asked), (-of_theta_e, theta), *((-p.gain * of_u, signal) for signal in fed_back)]
    if z.ndim > 1 and all(lag.ndim == 0 for lag in lags):  # linear in the stored rows: one matrix product
        parts += [(_dot(matrix, weights), rows) for matrix, (weights, rows) in delayed]
        out = _stacked(parts)
    else:
        out = _stacked(parts) + _dot(of_theta_e, asked[1] - theta[1])
        for weights, rows in fed_back:
            out = out - _dot(p.gain * _dot(of_u, weights), rows)
    samples = out[6:].reshape(len(late), n, *z.shape[1:])
    return out[:6], delay.write_block(lines, k, samples)


def _stacked(parts: list[tuple[jax.Array, jax.Array]]) -> jax.Array:
    """Sum of the products of matrices (m, n_i) and rows (n_i, ...), computed as one product."""
    matrices, rows = zip(*parts, strict=True)
    return _dot(jnp.concatenate(matrices, 1), jnp.concatenate(rows))


def _propagator(p: PitchParams, late: list[int]) -> jax.Array:
    """(6 + S n, 6 + 2 n): map to [x; xc; xi] after a control step and the n samples of the S late signals within it.

    It maps from [x; xc; xi] at the start, and theta_e and the delayed part of u in the n inner steps.
    """
    n = p.substeps
    one = _discretise(p, CONTROL_STEP / n, [i for i in (1, 2) if i not in late])
    shown = jnp.zeros((3, 6)).at[0, 3].set(1.0).at[1, :4].set(p.K1).at[2, 4].set(p.K2)[jnp.array(late)]
    z, samples = jnp.eye(6, 6 + 2 * n), []
    for i in range(n):
        samples.append(_dot(shown, z))
        z = _dot(one[:, :6], z).at[:, 6 + i].add(one[:, 6]).at[:, 6 + n + i].add(one[:, 7])
    return jnp.concatenate([z, jnp.stack(samples, 1).reshape(-1, 6 + 2 * n)])


def _inner_steps(
    p: PitchParams, z: jax.Array, lines: jax.Array, r_tilde_line: jax.Array, k: jax.Array, lags: list[jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """[x; xc; xi] and the lines after a control step, for any delays."""
    transition = _discretise(p, CONTROL_STEP / p.substeps, [])

    def inner(carry: tuple[jax.Array, jax.Array], i: jax.Array) -> tuple[tuple[jax.Array, jax.Array], None]:
        z, lines = carry
        n = k * p.substeps + i
        samples = jnp.stack([z[3], _dot(p.K1, z[:4]), p.K2 * z[4]])
        lines = jax.vmap(delay.write, (0, None, 0))(lines, n, samples)
        theta, k1x, k2xc = jax.vmap(delay.read, (0, None, 0))(lines, n, jnp.stack(lags) - 0.5)
        theta_e = delay.read_held(r_tilde_line, n, lags[0], p.substeps) - theta
        u = p.gain * -(k1x + k2xc) + p.disturbance + p.W[0]
        return (_dot(transition, jnp.concatenate([z, jnp.stack([theta_e, u])])), lines), None

    return jax.lax.scan(inner, (z, lines), jnp.arange(p.substeps, dtype=k.dtype), unroll=5)[0]


def variables(params: PitchParams, state: PitchState) -> PitchState:
    """The state without the clock, and with the lines from the oldest to the newest sample."""
    lines = state.lines if params.late is None else state.lines[:, : -params.substeps]  # without the mirror
    return state._replace(
        lines=jnp.roll(lines, -state.k * params.substeps, axis=1),
        r_tilde_line=jnp.roll(state.r_tilde_line, -state.k),
        k=None,
    )


def settled(params: PitchParams, state: PitchState, variables: PitchState) -> PitchState:
    """The state with these variables, at a late clock at which the next sample of every line goes into row 0."""
    lines = variables.lines
    k = lines.shape[1] * state.r_tilde_line.shape[0]
    if params.late is not None:
        lines = jnp.concatenate([lines, lines[:, : params.substeps]], 1)
    return variables._replace(lines=lines, k=jnp.full_like(state.k, k))


def _discretise(p: PitchParams, h: float, undelayed: list[int]) -> jax.Array:
    """(6, 8): map from [x; xc; xi; theta_e; u + W1] at the start of an inner step of h to [x; xc; xi] at its end.

    `undelayed` parts of u (1: K1 x, 2: K2 xc) act through the state, not through u. The exponential is summed to order
    6, which is exact in double precision for ||F h|| < 0.1.
    """
    F = jnp.zeros((8, 8))
    F = F.at[:4, :4].set(p.A + p.B[:, None] * jnp.stack([p.W[1], p.W[2], *jnp.zeros(2)])[None, :])
    F = F.at[:4, 7].set(p.B)
    if 1 in undelayed:
        F = F.at[:4, :4].add(-p.gain * p.B[:, None] * p.K1[None, :])
    if 2 in undelayed:
        F = F.at[:4, 4].set(-p.gain * p.B * p.K2)
    F = F.at[4, 3].set(1.0).at[4, 5].set(-p.C_h).at[4, 6].set(-p.D_h)
    F = F.at[5, 5].set(p.A_h).at[5, 6].set(p.B_h)
    exponential = jnp.eye(8)
    for order in range(6, 0, -1):
        exponential = jnp.eye(8) + _dot(F, exponential) * (h / order)
    return exponential[:6]


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.dot(a, b, precision=jax.lax.Precision.HIGHEST)  # accelerators would round the inputs


PITCH = Plant(
    name="pitch",
    init=init,
    step=step,
    output=output,
    start=start,
    reuse=reuse,
    variables=variables,
    settled=settled,
    smallest=smallest,
    widened=widened,
    affine=True,
    y_unit="crad",
    time_unit="s",
    control_step=CONTROL_STEP,
    episode_steps=200,
    r_tilde_bounds=(-60.0, 60.0),  # 3 * 18 = 54 would just hold y at the bound
    setpoint_range=(-17.0, 17.0),
    evaluation_range=(-16.0, 16.0),
    divergence_bounds=(-60.0, 60.0),
    output_limit=18.0,
    move_threshold=3.5,
    error_scale=1.0,
    history=15,
    families=("steps", "staircase", "ramps", "sines", "doublets"),
    family_steps=600,
)
