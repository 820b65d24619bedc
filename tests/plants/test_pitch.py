"""The pitch plant against the figures of the specification and an independent simulation in double precision."""

from __future__ import annotations

from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.plants import make, simulate
from jaxouter.plants.pitch import PITCH, W_PRINTED, PitchParams, PitchState
from tests.precision import FLOAT

KEY = jax.random.key(0)
STEPS = 200
SETPOINT = 14.66  # crad


def nominal(**overrides: Any) -> PitchParams:
    """Parameters with lines of one length, so that all tests share a compilation."""
    return make("pitch", max_delay=8.0, **overrides)[1]


def run(r_tilde: float | np.ndarray, state: PitchState | None = None, **overrides: Any) -> np.ndarray:
    y = simulate(PITCH, nominal(**overrides), np.broadcast_to(r_tilde, STEPS), KEY, state)
    return np.asarray(y, float)


def run_whole(r_tilde: float | np.ndarray, x0: list[float] | None = None, **overrides: Any) -> np.ndarray:
    """The same in whole control steps."""
    params = make("pitch", **overrides)[1]
    assert params.late is not None
    state = PITCH.init(KEY, params)._replace(x=jnp.asarray(x0 or [0.0] * 4, float))
    return np.asarray(simulate(PITCH, params, np.broadcast_to(r_tilde, STEPS), KEY, state), float)


REST = PITCH.init(KEY, nominal())


def scalar(value: float) -> jax.Array:
    return jnp.asarray(value, float)


def test_gains_are_the_lqr_gains() -> None:
    params = nominal()
    np.testing.assert_allclose(params.K1, [-0.02014, 0.07274, -0.79113, -1.26382], rtol=1e-3)
    np.testing.assert_allclose(params.K2, -0.5, rtol=1e-3)


def test_given_gains_replace_the_designed_ones() -> None:
    params = nominal(K1=[1.0, 2.0, 3.0, 4.0])
    chex.assert_trees_all_equal(params.K1, jnp.array([1.0, 2.0, 3.0, 4.0]))
    np.testing.assert_allclose(params.K2, -0.5, rtol=1e-3)


def closed_loop_eigenvalues(params: PitchParams) -> np.ndarray:
    """Of [x; xc] with xc' = x4: the pilot left out."""
    p = jax.tree.map(lambda leaf: np.asarray(leaf, float), params)
    closed = np.zeros((5, 5))
    closed[:4, :4] = p.A + np.outer(p.B, [p.W[1], p.W[2], 0.0, 0.0] - p.K1)
    closed[:4, 4] = -p.B * p.K2
    closed[4, 3] = 1.0
    return np.linalg.eigvals(closed)


def test_printed_uncertainty_makes_the_loop_unstable() -> None:
    eigenvalues = closed_loop_eigenvalues(nominal(W=W_PRINTED))
    unstable = sorted(eigenvalues[np.real(eigenvalues) > 0], key=np.imag)
    np.testing.assert_allclose(unstable, [0.333 - 0.646j, 0.333 + 0.646j], rtol=1e-3)


def test_default_uncertainty_leaves_the_loop_stable() -> None:
    assert np.real(closed_loop_eigenvalues(nominal())).max() < -0.01


def test_inner_loop_alone_on_a_step_of_16_crad() -> None:
    y = run(16.0)
    assert np.abs(16.0 - y).mean() == pytest.approx(11.9038, rel=1e-3)
    at = [round(seconds / 0.1) - 1 for seconds in (1, 2, 3, 5, 10, 20)]
    np.testing.assert_allclose(y[at], [-0.0163, 0.3118, 1.2234, 3.4528, 5.1263, 5.3417], rtol=1e-3, atol=5e-5)


@pytest.mark.parametrize(
    ("overrides", "mae"),
    [
        ({}, 10.907),
        ({"d1": 0.57, "d2": 0.57}, 10.909),
        ({"d1": 5.7, "d2": 0.57}, 27.199),
        ({"d1": 0.57, "d2": 5.7}, 8.837),
        ({"W": W_PRINTED}, 136.2),
    ],
    ids=["paper", "delay-0.57", "delay-5.7", "delay-swapped", "uncertainty"],
)
def test_inner_loop_alone_has_the_specified_error(overrides: dict[str, Any], mae: float) -> None:
    assert np.abs(SETPOINT - run(SETPOINT, **overrides)).mean() == pytest.approx(mae, rel=1e-3)


def test_static_prefilter_has_the_specified_error() -> None:
    assert np.abs(SETPOINT - run(3.0 * SETPOINT)).mean() == pytest.approx(3.404, rel=1e-3)


@pytest.mark.parametrize("r_tilde", [0.0, 12.0, -30.0])
def test_dc_gain_is_a_third_without_offset(r_tilde: float) -> None:
    y = simulate(PITCH, nominal(), jnp.full(4000, r_tilde), KEY)
    assert float(y[-1]) == pytest.approx(r_tilde / 3, abs=1e-3)


class Cases(NamedTuple):
    """Runs of the independent simulation; each array has the cases first."""

    tau: np.ndarray
    d1: np.ndarray
    d2: np.ndarray
    x0: np.ndarray  # (cases, 4)
    r_tilde: np.ndarray  # (cases, STEPS)


def cases() -> dict[str, tuple[float, float, float, list[float], np.ndarray]]:
    rest, held = [0.0] * 4, np.full(STEPS, 16.0)
    jumping = np.random.default_rng(0).uniform(0.0, 32.0, STEPS)
    return {
        "nominal": (0.5, 0.0, 0.0, rest, held),
        "no-delay": (0.0, 0.0, 0.0, rest, held),
        "late-controller": (0.5, 0.57, 0.57, rest, held),
        "off-grid": (0.537, 0.123, 0.0049, rest, held),
        "off-grid-jumping": (0.537, 0.123, 0.0049, rest, jumping),
        "moving-start": (0.5, 0.57, 0.57, [1.0, -1.0, 0.5, 5.0], held),
    }


def method_of_steps(case: Cases, h: float = 1e-3) -> np.ndarray:
    """y (cases, STEPS): Runge-Kutta of order 4 over the past interpolated linearly, from the equations as printed."""
    A = [[-0.003, 0.039, 0.0, -0.322], [-0.065, -0.319, 7.740, 0.0], [0.020, -0.101, -0.429, 0.0], [0.0, 0.0, 1.0, 0.0]]
    B = np.array([0.010, -0.180, -1.160, 0.0])
    K1, K2 = (np.asarray(gain, float) for gain in (nominal().K1, nominal().K2))
    F = np.zeros((6, 6))  # [x; xc; xi]
    F[:4, :4] = A + np.outer(B, [0.003, -0.003, 0.0, 0.0])
    F[4, 3], F[4, 5], F[5, 5] = 1.0, -0.08, -0.2
    G = np.zeros((6, 2))  # theta_e, u + W1
    G[4, 0], G[5, 0], G[:4, 1] = -0.1, 1.0, B
    shown = np.zeros((3, 6))  # what is delayed: theta, K1 x, K2 xc
    shown[0, 3], shown[1, :4], shown[2, 4] = 1.0, K1, K2

    per_step, n = round(0.1 / h), round(STEPS * 0.1 / h)
    lags = np.round(np.stack([case.tau, case.d1, case.d2]) / h, 9)  # (3, cases)
    lanes = np.arange(len(case.tau))
    signal = np.arange(3)[:, None]
    z = np.concatenate([case.x0, np.zeros((len(lanes), 2))], 1).T  # (6, cases)
    past, y = np.zeros((n + 1, 3, len(lanes))), np.zeros((len(lanes), STEPS))

    for m in range(n):
        past[m] = shown @ z
        began = m + 0.5 - lags > 0
        held = np.floor((m + 0.5 - lags[0]) / per_step).astype(int)
        r_tilde = np.where(held < 0, 0.0, case.r_tilde[lanes, np.maximum(held, 0)])

        def delayed(stage: float, m: int = m, began: np.ndarray = began) -> np.ndarray:
            at = np.maximum(m + stage - lags, 0.0)
            left = np.clip(np.floor(at).astype(int), 0, max(m - 1, 0))
            a, b = past[left, signal, lanes], past[left + 1, signal, lanes]
            return np.where(began, a + (b - a) * (at - left), 0.0)

        def slope(z: np.ndarray, old: np.ndarray, r_tilde: np.ndarray = r_tilde) -> np.ndarray:
            theta, k1x, k2xc = np.where(lags == 0, shown @ z, old)
            return F @ z + G @ np.stack([r_tilde - theta, 0.1 - k1x - k2xc])

        start, middle, end = (delayed(stage) for stage in (0.0, 0.5, 1.0))
        k1 = slope(z, start)
        k2 = slope(z + h / 2 * k1, middle)
        k3 = slope(z + h / 2 * k2, middle)
        k4 = slope(z + h * k3, end)
        z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        if (m + 1) % per_step == 0:
            y[:, (m + 1) // per_step - 1] = z[3]
    return y


@pytest.fixture(scope="module")
def independent() -> dict[str, np.ndarray]:
    columns = zip(*cases().values(), strict=True)
    return dict(zip(cases(), method_of_steps(Cases(*(np.array(column) for column in columns))), strict=True))


@pytest.mark.parametrize("name", cases())
def test_agrees_with_an_independent_simulation(name: str, independent: dict[str, np.ndarray]) -> None:
    tau, d1, d2, x0, r_tilde = cases()[name]
    state = REST._replace(x=jnp.asarray(x0, float))
    y = run(r_tilde, state, tau=tau, d1=d1, d2=d2)
    assert np.abs(independent[name]).max() > 4.0
    np.testing.assert_allclose(y, independent[name], rtol=0, atol=1e-3)


@pytest.mark.parametrize("name", ["nominal", "late-controller", "moving-start"])
def test_whole_control_steps_agree_with_an_independent_simulation(
    name: str, independent: dict[str, np.ndarray]
) -> None:
    tau, d1, d2, x0, r_tilde = cases()[name]
    np.testing.assert_allclose(run_whole(r_tilde, x0, tau=tau, d1=d1, d2=d2), independent[name], rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    "overrides",
    [
        {"tau": 0.105},
        {"tau": 0.537, "d1": 0.123},
        {"d2": 0.333, "gain": 1.3, "disturbance": 2.0},
        {"d1": 5.7, "d2": 0.57},
    ],
    ids=str,
)
def test_whole_control_steps_agree_with_inner_steps(overrides: dict[str, float]) -> None:
    r_tilde = np.random.default_rng(0).uniform(0.0, 32.0, STEPS)
    whole, inner = run_whole(r_tilde, **overrides), run(r_tilde, **overrides)
    np.testing.assert_allclose(whole, inner, rtol=0, atol=2e-5 * np.abs(inner).max())


@pytest.mark.parametrize("taus", [[0.105, 0.27, 0.5], 0.37], ids=["own-delays", "one-delay"])
@pytest.mark.parametrize("d2", [0.0, 0.57])
def test_plants_side_by_side_equal_lanes_under_vmap(taus: Any, d2: float) -> None:
    params, taus = make("pitch", d2=d2)[1], jnp.asarray(taus)
    r_tilde = jax.random.uniform(KEY, (STEPS, 3), float, -30.0, 30.0)
    states = jax.vmap(PITCH.training_start, (0, None))(jax.random.split(KEY, 3), params)
    several = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), states)._replace(k=states.k[0])

    @jax.jit
    def together(state: PitchState, r_tilde: jax.Array) -> jax.Array:
        def step(state: PitchState, r_tilde: jax.Array) -> tuple[PitchState, jax.Array]:
            state = PITCH.step(params.replace(tau=taus), state, r_tilde, KEY)
            return state, state.x[3]

        return jax.lax.scan(step, state, r_tilde)[1]

    lanes = jax.vmap(lambda tau, state, r: simulate(PITCH, params.replace(tau=tau), r, KEY, state), (0, 0, 1), 1)
    expected = lanes(jnp.broadcast_to(taus, (3,)), states, r_tilde)
    chex.assert_trees_all_close(together(several, r_tilde), expected, atol=1e-4)


@pytest.mark.parametrize("delays", [{"tau": 0.09}, {"tau": 0.61}, {"d1": 0.2}, {"d2": 0.0}], ids=str)
def test_delay_that_whole_control_steps_do_not_serve_gives_nan(delays: dict[str, float]) -> None:
    params = make("pitch", d2=0.57)[1].replace(**{name: jnp.asarray(value) for name, value in delays.items()})
    assert bool(jnp.isnan(simulate(PITCH, params, jnp.full(STEPS, 16.0), KEY)).all())


def refined(tau: float, d1: float, d2: float) -> tuple[np.ndarray, ...]:
    """A step with 10, 20 and 40 inner steps a control step, in double precision, on lines that just serve."""

    def y(substeps: int) -> np.ndarray:
        params = make("pitch", tau=tau, d1=d1, d2=d2, max_delay=0.6, substeps=substeps)[1]
        return np.asarray(simulate(PITCH, params, np.full(100, 16.0), KEY))

    with jax.enable_x64(True):
        return tuple(y(substeps) for substeps in (10, 20, 40))


@pytest.mark.parametrize(("tau", "d1", "d2"), [(0.5, 0.0, 0.0), (0.5, 0.57, 0.57), (0.55, 0.1, 0.02)])
def test_converges_with_the_square_of_the_inner_step(tau: float, d1: float, d2: float) -> None:
    coarse, middle, fine = refined(tau, d1, d2)
    first, second = np.abs(coarse - middle).max(), np.abs(middle - fine).max()
    assert first > 1e-7
    assert 3.5 < first / second < 4.5


def test_inner_step_precision_and_length_of_the_lines_matter_little_with_delays_off_the_grid() -> None:
    tau, d1, d2 = 0.537, 0.123, 0.0049
    coarse, middle, fine = refined(tau, d1, d2)
    assert 0.0 < np.abs(coarse - fine).max() < 1e-5
    assert 0.0 < np.abs(middle - fine).max() < 1e-5
    chex.assert_trees_all_close(run(16.0, tau=tau, d1=d1, d2=d2)[:100], coarse, atol=1e-4)


def test_disturbance_adds_to_the_control() -> None:
    chex.assert_trees_all_close(run(16.0, disturbance=2.0), run(16.0, W=(2.1, 0.003, -0.003)), atol=1e-4)
    assert np.abs(run(16.0, disturbance=2.0) - run(16.0)).max() > 0.1


def test_gain_multiplies_the_feedback() -> None:
    params = nominal()
    doubled = run(16.0, K1=2.0 * np.asarray(params.K1), K2=2.0 * float(params.K2))
    chex.assert_trees_all_close(run(16.0, gain=2.0), doubled, atol=1e-4)
    assert np.abs(doubled - run(16.0)).max() > 0.1


def test_rest_is_zero() -> None:
    chex.assert_trees_all_equal(REST, jax.tree.map(jnp.zeros_like, REST))


def test_training_starts_spread_over_the_specified_box() -> None:
    states = jax.jit(jax.vmap(PITCH.training_start, (0, None)))(jax.random.split(KEY, 2000), nominal())
    box = np.array([1.0, 1.0, 0.5, 5.0])
    reached = np.abs(states.x).max(0)
    assert (reached <= box).all()
    assert (reached > 0.99 * box).all()
    np.testing.assert_allclose(np.mean(states.x, 0), 0.0, atol=0.06 * box.max())
    hidden = states._replace(x=jnp.zeros_like(states.x))
    chex.assert_trees_all_equal(hidden, jax.tree.map(jnp.zeros_like, hidden))


def test_output_is_the_pitch_angle() -> None:
    assert float(PITCH.output(nominal(), REST._replace(x=jnp.array([1.0, 2.0, 3.0, 4.0])))) == 4.0


@pytest.mark.slow
def test_one_step_is_the_same_without_jit() -> None:
    params = make("pitch", tau=0.037, d1=0.013, d2=0.0)[1]
    state = PITCH.training_start(KEY, params)
    compiled = jax.jit(PITCH.step)(params, state, scalar(16.0), KEY)
    with jax.disable_jit():
        plain = PITCH.step(params, state, scalar(16.0), KEY)
    chex.assert_trees_all_close(compiled, plain, atol=1e-5)


def test_step_keeps_shapes_and_precision() -> None:
    params = nominal()
    before = PITCH.training_start(KEY, params)
    after = jax.eval_shape(PITCH.step, params, before, scalar(16.0), KEY)
    chex.assert_trees_all_equal_shapes_and_dtypes(before, after)
    chex.assert_type([*before[:-1], PITCH.output(params, before)], FLOAT)


@pytest.mark.slow
def test_output_is_differentiable_in_the_modified_reference() -> None:
    params = nominal()

    def last(level: jax.Array) -> jax.Array:
        return simulate(PITCH, params, jnp.broadcast_to(level, (STEPS,)), KEY)[-1]

    slope = jax.grad(last)(scalar(16.0))
    difference = (run(17.0)[-1] - run(15.0)[-1]) / 2  # exact: the plant is affine in r~
    assert float(slope) == pytest.approx(difference, rel=1e-3)


def test_smallest_is_the_same_plant_with_shorter_lines():
    plant, params = make("pitch", d1=0.57, max_delay=5.7)
    small = plant.smallest(params)
    assert small.max_delay == pytest.approx(0.6)
    r_tilde, key = jnp.full(60, 16.0), jax.random.key(0)
    expected = simulate(plant, params, r_tilde, key)
    np.testing.assert_allclose(simulate(plant, small, r_tilde, key), expected, atol=1e-4)
