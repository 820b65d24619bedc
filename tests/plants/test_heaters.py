"""The heaters against the figures of the specification, closed-form moments and the exact solution."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, get_args

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxouter
from jaxouter.plants import heaters, make, simulate
from jaxouter.plants.heaters import HEATERS, HeatersParams, HeatersState, Law
from tests.precision import FLOAT

KEY = jax.random.key(0)
SETPOINTS = np.repeat([15.0, 20.0, 17.0, 22.0], 50)  # degC
PRINTED = dict(Ca=10.0, Ua=0.2, x_out=-5.0, Pi=0.4, r_u=10.0, phi=0.001, gamma=0.6, beta2=0.038, lambda1=-0.028)
N, R_TILDE = 100_000, np.array([18.0, 18.0, 25.0])
LAWS = get_args(Law)
STIFF = dict(Ca=1.0, Ua=0.8, Pi=0.5, r_u=2.0, sigma=0.7)  # time constant of an hour, so that the step shows


def nominal(**overrides: Any) -> HeatersParams:
    return make("heaters", **overrides)[1]


def scalar(value: float) -> jax.Array:
    return jnp.asarray(value, float)


def given(params: HeatersParams, x0: Any) -> HeatersState:
    """The houses at these temperatures."""
    x = jnp.asarray(np.broadcast_to(x0, params.weights.shape), float)
    return HeatersState(x, x, jnp.asarray(0, jnp.int32))


def hours(params: HeatersParams, state: HeatersState, r_tilde: np.ndarray, key: jax.Array = KEY) -> HeatersState:
    """States after each hour."""

    def step(state: HeatersState, inputs: Any) -> tuple[HeatersState, HeatersState]:
        state = HEATERS.step(params, state, *inputs)
        return state, state

    return jax.lax.scan(step, state, (jnp.asarray(r_tilde, float), jax.random.split(key, len(r_tilde))))[1]


run_hours = jax.jit(hours)
runs_hours = jax.jit(jax.vmap(hours, (None, None, None, 0)))
inits = jax.jit(jax.vmap(HEATERS.init, (0, None)))


@pytest.mark.parametrize(
    ("overrides", "mae"),
    [
        ({"x0_mean": 19.25}, 15.625),
        ({"x0_mean": 17.8}, 15.061),
        ({"x0_mean": 19.25, "Pi": 17.186}, 6.27),
        ({"x0_mean": 19.25, "x_out": -15.0}, 8.90),
    ],
    ids=["paper-4", "paper-1000", "riccati", "cold"],
)
def test_inner_loop_alone_has_the_specified_error(overrides: dict[str, float], mae: float) -> None:
    y = np.asarray(simulate(*make("heaters", sigma=0.0, **overrides), SETPOINTS, KEY))
    assert np.abs(SETPOINTS - y).mean() == pytest.approx(mae, rel=1e-3)


def test_riccati_root_and_its_constants_are_those_of_the_specification() -> None:
    a, b, r_u, phi, gamma = -0.2 / 10.0, 1.0 / 10.0, 10.0, 0.001, 0.6
    Pi = max(np.roots([-(b**2) / r_u, 2 * a - phi, 1.0]))
    beta1 = -a + b**2 / r_u * Pi
    beta2 = beta1 + phi
    lambda1 = min(np.linalg.eigvals([[-beta1, -(b**2) / r_u], [gamma, beta2]]))  # of mean and offset, coupled by gamma
    assert Pi == pytest.approx(17.186, rel=1e-3)
    np.testing.assert_allclose([beta1, beta2, lambda1], [0.0372, 0.0382, -0.0281], atol=5e-5)
    params = nominal()
    np.testing.assert_allclose([params.house.beta2, params.house.lambda1], [beta2, lambda1], atol=2e-4)


def recursion(p: dict[str, float], x0: float, r_tilde: np.ndarray, substeps: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of a house after each hour: x_(n+1) = a x_n + b_n + s w, from the equations as printed."""
    h, p = 1.0 / substeps, {"gain": 1.0, "disturbance": 0.0} | p
    a = 1.0 - h / p["Ca"] * (p["Ua"] + p["gain"] * p["Pi"] / (p["Ca"] * p["r_u"]))
    u_free = -p["Ua"] / p["Ca"] * (p["x_out"] - x0)
    mean, variance, means, variances = x0, 0.0, [], []
    for n in range(len(r_tilde) * substeps):
        r = r_tilde[n // substeps]
        s_inf = r / (-p["Ua"] / p["Ca"] - p["Pi"] / (p["Ca"] ** 2 * p["r_u"]) - p["phi"])
        s = s_inf + p["gamma"] / (p["beta2"] - p["lambda1"]) * (r - x0) * math.exp(p["lambda1"] * n * h)
        u = -p["gain"] * s / (p["Ca"] * p["r_u"]) + p["disturbance"]  # without its part in x
        mean = a * mean + h / p["Ca"] * (p["Ua"] * p["x_out"] + u + u_free)
        variance = a**2 * variance + p["sigma"] ** 2 * h
        if (n + 1) % substeps == 0:
            means.append(mean)
            variances.append(variance)
    return np.array(means), np.array(variances)


@pytest.mark.parametrize("law", LAWS)
def test_noise_free_run_is_the_recursion(law: Law) -> None:
    changes = dict(sigma=0.0, gain=1.2, disturbance=0.3)
    expected, _ = recursion(PRINTED | changes, 19.25, SETPOINTS, 10)
    y = simulate(*make("heaters", law=law, **changes), SETPOINTS, KEY)
    np.testing.assert_allclose(y, expected, atol=1e-4)


@pytest.fixture(scope="module", params=LAWS)
def many(request: pytest.FixtureRequest) -> np.ndarray:
    """Temperatures of many stiff houses after each hour, (3, N); lumped, the mean of 16 with 4 times its noise."""
    if request.param != "lumped":
        params = nominal(n=N, law=request.param, **STIFF)
        return np.asarray(run_hours(params, given(params, 19.0), R_TILDE).x, float)
    params = nominal(n=16, law="lumped", **STIFF)
    x = runs_hours(params, given(params, 19.0), R_TILDE, jax.random.split(KEY, N)).x[..., 0].T
    noise_free = recursion(PRINTED | STIFF, 19.0, R_TILDE, 10)[0][:, None]
    return noise_free + 4.0 * (np.asarray(x, float) - noise_free)


def test_moments_of_the_houses_are_those_of_the_recursion(many: np.ndarray) -> None:
    mean, variance = recursion(PRINTED | STIFF, 19.0, R_TILDE, 10)
    assert (np.abs(many.mean(1) - mean) < 5 * np.sqrt(variance / N)).all()
    assert (np.abs(many.var(1) / variance - 1) < 5 * np.sqrt(2 / N)).all()
    continuous = 0.7**2 / (2 * 1.05)  # to which the recursion's variance has an error of 5 % here
    assert abs(variance[-1] / continuous - 1) > 10 * np.sqrt(2 / N)


@pytest.mark.parametrize("law", ["euler-maruyama", "hourly"])
def test_moments_of_houses_that_differ_are_their_own(law: Law) -> None:
    stock = dict(Ca=[1.0, 2.0], Ua=[0.8, 3.0], sigma=[0.7, 0.2], gain=[1.0, 2.0])
    params, seeds = nominal(n=2, law=law, **STIFF | stock), 20_000
    x = np.asarray(runs_hours(params, given(params, 19.0), R_TILDE, jax.random.split(KEY, seeds)).x, float)
    for house in range(2):
        p = PRINTED | STIFF | {name: values[house] for name, values in stock.items()}
        mean, variance = recursion(p, 19.0, R_TILDE, 10)
        assert (np.abs(x[..., house].mean(0) - mean) < 5 * np.sqrt(variance / seeds)).all()
        assert (np.abs(x[..., house].var(0) / variance - 1) < 5 * np.sqrt(2 / seeds)).all()


def test_noise_of_one_hour_is_independent_of_the_next(many: np.ndarray) -> None:
    a = (1.0 - 0.1 * (0.8 + 0.5 / 2.0)) ** 10  # of one hour
    innovation = many[1:] - a * many[:-1]
    for earlier, later in ((many[0], innovation[0]), (many[1], innovation[1]), (innovation[0], innovation[1])):
        assert abs(np.corrcoef(earlier, later)[0, 1]) < 5 / math.sqrt(N)


def test_each_house_has_a_wiener_process_of_its_own(many: np.ndarray) -> None:
    houses = many[-1].reshape(-1, 4)
    _, variance = recursion(PRINTED | STIFF, 19.0, R_TILDE, 10)
    assert np.abs(np.corrcoef(houses.T) - np.eye(4)).max() < 5 / math.sqrt(len(houses))
    assert abs(houses.mean(1).var() / (variance[-1] / 4) - 1) < 5 * math.sqrt(2 / len(houses))


def exact(x0: float, r_tilde: float, t: float, p: dict[str, float]) -> float:
    """Solution of the noise-free equation at constant r~, in closed form."""
    k = (p["Ua"] + p["Pi"] / (p["Ca"] * p["r_u"])) / p["Ca"]
    s_inf = r_tilde / (-p["Ua"] / p["Ca"] - p["Pi"] / (p["Ca"] ** 2 * p["r_u"]) - p["phi"])
    u_free = p["Ua"] / p["Ca"] * (x0 - p["x_out"])
    constant = (p["Ua"] * p["x_out"] + u_free - s_inf / (p["Ca"] * p["r_u"])) / p["Ca"]
    fading = -p["gamma"] / (p["beta2"] - p["lambda1"]) * (r_tilde - x0) / (p["Ca"] ** 2 * p["r_u"])
    decay, law = math.exp(-k * t), math.exp(p["lambda1"] * t)
    return decay * x0 + constant / k * (1 - decay) + fading * (law - decay) / (p["lambda1"] + k)


def test_mean_converges_to_the_exact_solution_with_the_first_power_of_the_step() -> None:
    """The mean of a linear equation is its noise-free solution, so this is the weak order too."""
    with jax.enable_x64(True):

        def error(substeps: int) -> float:
            params = nominal(n=1, sigma=0.0, substeps=substeps)
            y = run_hours(params, given(params, 19.25), np.full(50, 22.0)).x[-1, 0]
            return abs(float(y) - exact(19.25, 22.0, 50.0, PRINTED))

        coarse, middle, fine = (error(substeps) for substeps in (10, 20, 40))
    assert 1.9 < coarse / middle < 2.1
    assert 1.9 < middle / fine < 2.1
    assert fine < 1e-2


def test_paths_converge_with_the_first_power_of_the_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """Strong order 1 (the noise is additive): every run takes the increments of one and the same Wiener path."""
    n, finest, draw = 500, 40, jax.random.normal

    def increments(key: jax.Array, shape: tuple[int, int], dtype: Any) -> jax.Array:
        fine = draw(key, (finest, n), dtype)
        return fine.reshape(shape[0], finest // shape[0], n).sum(1) / math.sqrt(finest // shape[0])

    monkeypatch.setattr(heaters.jax.random, "normal", increments)

    def path(substeps: int) -> np.ndarray:
        params = nominal(n=n, substeps=substeps, **STIFF)
        step = jax.jit(lambda *at: HEATERS.step(params, *at))  # a new function, so that no other draw is in its cache
        return np.asarray(step(given(params, 19.0), scalar(18.0), KEY).x, float)

    coarse, middle, fine = (path(substeps) for substeps in (10, 20, 40))
    assert np.std(coarse - middle) > 1e-4
    assert 1.8 < np.std(coarse - middle) / np.std(middle - fine) < 2.2


MIXED = dict(
    Ca=[8.0, 10.0, 13.0, 9.0],
    Ua=[0.15, 0.2, 0.26, 0.3],
    Pi=[0.4, 17.186, 5.0, 0.4],
    x_out=[-5.0, -10.0, 0.0, -5.0],
    gain=[1.0, 0.9, 1.1, 1.0],
    lambda1=[-0.028, -0.02, -0.05, -0.028],
)
MIXED_X0 = np.array([18.0, 19.0, 21.0, 16.0])


def test_houses_of_mixed_parameters_equal_houses_alone() -> None:
    together = nominal(sigma=0.0, **MIXED)
    x = run_hours(together, given(together, MIXED_X0), SETPOINTS).x
    for house in range(4):
        alone = nominal(n=1, sigma=0.0, **{name: values[house] for name, values in MIXED.items()})
        expected = run_hours(alone, given(alone, MIXED_X0[house]), SETPOINTS).x[:, 0]
        chex.assert_trees_all_close(x[:, house], expected, atol=1e-4)
    assert float(jnp.ptp(x[-1])) > 1.0


@pytest.mark.parametrize("law", ["euler-maruyama", "hourly"])
def test_permuting_the_houses_permutes_their_temperatures(law: Law) -> None:
    order = np.array([2, 0, 3, 1])
    params = nominal(law=law, sigma=0.0, **MIXED)
    permuted = nominal(law=law, sigma=0.0, **{name: np.array(values)[order] for name, values in MIXED.items()})
    x = run_hours(params, given(params, MIXED_X0), SETPOINTS).x
    expected = run_hours(permuted, given(permuted, MIXED_X0[order]), SETPOINTS).x
    chex.assert_trees_all_close(x[:, order], expected, atol=1e-5)


def test_parameters_swept_under_vmap_equal_single_runs() -> None:
    params = nominal(sigma=0.0)
    outside = jnp.array([-15.0, -5.0, 0.0])

    def lane(x_out: jax.Array) -> jax.Array:
        swept = replace(params, house=replace(params.house, x_out=x_out))
        return simulate(HEATERS, swept, SETPOINTS, KEY)

    lanes = jax.vmap(lane)(outside)
    for y, x_out in zip(lanes, outside, strict=True):
        chex.assert_trees_all_close(y, simulate(*make("heaters", sigma=0.0, x_out=x_out), SETPOINTS, KEY), atol=1e-4)
    assert float(jnp.ptp(lanes[:, -1])) > 1.0


def test_output_is_the_mean_of_the_houses_by_default() -> None:
    params = nominal()
    assert float(HEATERS.output(params, given(params, [16.0, 18.0, 20.0, 24.0]))) == pytest.approx(19.5)


def test_output_is_the_weighted_mean() -> None:
    params = nominal(n=3, weights=[0.5, 0.3, 0.2])
    assert float(HEATERS.output(params, given(params, [10.0, 20.0, 30.0]))) == pytest.approx(17.0)


def test_members_are_the_houses() -> None:
    params = nominal()
    state = given(params, [16.0, 18.0, 20.0, 24.0])
    assert HEATERS.members is not None
    chex.assert_trees_all_equal(HEATERS.members(params, state), jnp.array([16.0, 18.0, 20.0, 24.0]))


@pytest.mark.parametrize("weights", [None, [0.4, 0.3, 0.2, 0.1]])
def test_start_has_the_given_mean_exactly_and_the_given_spread(weights: list[float] | None) -> None:
    params = nominal(x0_mean=17.8, x0_spread=1.0, weights=weights)
    states = inits(jax.random.split(KEY, 1000), params)
    np.testing.assert_allclose(jax.vmap(HEATERS.output, (None, 0))(params, states), 17.8, rtol=1e-6)
    chex.assert_trees_all_equal(states.x, states.x0)
    spread = np.ptp(states.x, axis=1)
    assert spread.max() <= 2.0 + 1e-5
    assert spread.max() > 1.7


def test_training_starts_have_a_drawn_mean_and_houses_within_1_degree_of_it() -> None:
    states = jax.jit(jax.vmap(HEATERS.training_start, (0, None)))(jax.random.split(KEY, 2000), nominal())
    x = np.asarray(states.x)
    assert np.ptp(x, axis=1).max() <= 2.0 + 1e-5
    assert 14.0 <= x.min() < 14.8
    assert 25.2 < x.max() <= 26.0
    assert x.mean() == pytest.approx(20.0, abs=5 * 10 / math.sqrt(12 * 2000))


@pytest.mark.parametrize(("u_free", "rate"), [("printed", -0.2 * 20.0 * (1 - 0.1) / 10.0), ("physical", 0.0)])
def test_free_power_without_control(u_free: str, rate: float) -> None:
    """Printed, it is a tenth of the loss at x0; physical, it holds x0."""
    params = nominal(u_free=u_free, Pi=17.186, gain=0.0)
    drift = heaters.drift(params.house, scalar(15.0), scalar(15.0), scalar(1.0), scalar(20.0), params.u_free)
    assert float(drift) == pytest.approx(rate, abs=1e-6)


def test_disturbance_is_power_added_to_the_control() -> None:
    off, on = nominal(gain=0.0), nominal(gain=0.0, disturbance=3.0)
    at = (scalar(15.0), scalar(15.0), scalar(1.0), scalar(20.0))
    added = heaters.drift(on.house, *at, "printed") - heaters.drift(off.house, *at, "printed")
    assert float(added) == pytest.approx(3.0 / 10.0, rel=1e-5)


def test_gain_multiplies_the_control() -> None:
    at = (scalar(15.0), scalar(16.0), scalar(math.exp(-0.028 * 3.0)), scalar(20.0))
    none, once, twice = (float(heaters.drift(nominal(gain=g).house, *at, "printed")) for g in (0.0, 1.0, 2.0))
    assert twice - none == pytest.approx(2 * (once - none), rel=1e-4)
    assert once - none == pytest.approx(-(0.4 * 15.0 + _offset(16.0, 20.0, 3.0)) / 100.0 / 10.0, rel=1e-4)


def _offset(x0: float, r_tilde: float, t: float) -> float:
    return r_tilde / (-0.02 - 0.0004 - 0.001) + 0.6 / 0.066 * (r_tilde - x0) * math.exp(-0.028 * t)


def test_clock_and_starts_of_the_law_do_not_restart_when_the_modified_reference_changes() -> None:
    params = nominal(sigma=0.0, **MIXED)
    states = run_hours(params, given(params, MIXED_X0), SETPOINTS)
    np.testing.assert_array_equal(states.k, np.arange(1, 201))
    np.testing.assert_array_equal(states.x0, np.tile(MIXED_X0, (200, 1)))


def test_one_hour_is_the_same_without_jit() -> None:
    params = nominal(n=2, substeps=1)
    state = given(params, [16.0, 24.0])
    compiled = jax.jit(HEATERS.step)(params, state, scalar(22.0), KEY)
    with jax.disable_jit():
        plain = HEATERS.step(params, state, scalar(22.0), KEY)
    chex.assert_trees_all_close(compiled, plain, atol=1e-5)


def test_step_keeps_shapes_and_precision() -> None:
    params = nominal(n=7)
    before = HEATERS.training_start(KEY, params)
    after = jax.eval_shape(HEATERS.step, params, before, scalar(22.0), KEY)
    chex.assert_trees_all_equal_shapes_and_dtypes(before, after)
    chex.assert_shape(before.x, (7,))
    chex.assert_type([before.x, before.x0, HEATERS.output(params, before)], FLOAT)


def test_output_is_differentiable_in_the_modified_reference() -> None:
    params = nominal(sigma=0.0)
    state = given(params, 19.25)

    @jax.jit
    @jax.value_and_grad
    def y(r_tilde: jax.Array) -> jax.Array:
        return HEATERS.output(params, HEATERS.step(params, state, r_tilde, KEY))

    (low, slope), (high, _) = y(scalar(10.0)), y(scalar(30.0))
    assert float(slope) == pytest.approx(float(high - low) / 20.0, rel=1e-3)  # exact: affine in r~
    assert float(slope) > 1e-3


def test_noise_of_the_substeps_is_summed_in_the_pass_that_makes_it() -> None:
    """No array of normal numbers, (substeps, n), is written."""
    params = nominal(n=1000)
    compiled = jax.jit(HEATERS.step).lower(params, given(params, 19.0), scalar(20.0), KEY).compile().as_text()
    written = str(compiled).partition("ENTRY")[2]
    assert "u32[10,1000]" in written  # random bits are
    assert "f32[10,1000]" not in written


@pytest.mark.parametrize("law", LAWS)
def test_settled_state_has_the_variables_and_steps_without_a_clock(law: Law) -> None:
    params = nominal(law=law, lambda1=-100.0)
    state = jax.tree.map(lambda leaf: leaf[-1], run_hours(params, given(params, 19.0), R_TILDE))
    settled = HEATERS.settled(params, state, HEATERS.variables(params, state))
    chex.assert_trees_all_equal_shapes_and_dtypes(settled, state)
    after, expected = (run_hours(params, each, R_TILDE).x for each in (settled, state))
    chex.assert_trees_all_close(after, expected, atol=1e-5)


def test_lumped_houses_are_as_cheap_as_one_however_many() -> None:
    env, params = jaxouter.make("heaters", n=10**9, law="lumped", x0_mean=17.8)
    assert float(HEATERS.output(params.plant, HEATERS.init(KEY, params.plant))) == pytest.approx(17.8, rel=1e-7)
    before = jax.jit(env.reset)(KEY, params)[1]
    after, reward = jax.jit(env.step)(KEY, before, scalar(20.0), params)[1:3]
    assert HEATERS.members is not None
    chex.assert_trees_all_equal(HEATERS.members(params.plant, after.plant), after.y[None])
    assert sum(leaf.size for leaf in jax.tree.leaves(after.plant)) == 3
    assert float(reward) == pytest.approx(-0.3 * abs(float(before.r - after.y)), abs=0.2)
    assert float(after.y) != float(before.y)


def test_lumped_training_starts_spread_like_the_mean_of_the_houses() -> None:
    keys, params = jax.random.split(KEY, 20_000), nominal(law="lumped")
    y = jax.jit(jax.vmap(lambda key, houses: start_y(key, replace(params, houses=houses)), (0, None)))
    mean = np.asarray(y(keys, scalar(1e12)))
    assert 15.0 <= mean.min() < 15.1
    assert 24.9 < mean.max() <= 25.0
    of_four = np.asarray(y(keys, scalar(4.0))) - mean
    assert of_four.var() == pytest.approx(1 / 12, rel=5 * math.sqrt(2 / 20_000))
    assert np.abs(np.asarray(y(keys, scalar(1.0))) - mean).max() == pytest.approx(1.0, abs=1e-5)


def start_y(key: jax.Array, params: HeatersParams) -> jax.Array:
    return HEATERS.output(params, HEATERS.training_start(key, params))


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ({"law": "exact"}, "law is 'exact'; it must be one of euler-maruyama, hourly, lumped"),
        ({"law": "lumped", "Ua": [0.2] * 4}, r"Ua has shape \(4,\); law 'lumped' is for identical houses.*'hourly'"),
        ({"law": "lumped", "x0_mean": [19.0]}, r"x0_mean has shape \(1,\); law 'lumped'"),
        ({"law": "lumped", "weights": [0.25] * 4}, r"weights has shape \(4,\).*weights: None"),
    ],
)
def test_laws_that_do_not_fit_are_refused(overrides: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        nominal(**overrides)
