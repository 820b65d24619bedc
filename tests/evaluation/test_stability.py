"""Local stability against eigenvalues computed by other means, and what is said where there is something to say."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from jaxouter.evaluation.baselines.pi import PI, PIParams
from jaxouter.evaluation.stability import LocalStability, analyse, spectral_radius
from jaxouter.identification import steady_state
from jaxouter.loop import bank
from jaxouter.loop.observation import Observer
from jaxouter.loop.policy import Policy, affine, none
from jaxouter.plants import Plant, make
from jaxouter.plants.base import float_leaves, with_float_leaves
from jaxouter.plants.heaters import HEATERS
from jaxouter.plants.pitch import PITCH, W_PRINTED
from jaxouter.training.policy import LearnedParams, LearnedPolicy
from tests import lag
from tests.precision import of_single_draws

KEY = jax.random.key(0)
W_NOMINAL = (0.1, 0.003, -0.003)


def pi(plant: Plant, kp: float, ki: float, slope: float) -> tuple[PI, PIParams]:
    numbers = [jnp.asarray(value, float) for value in (slope, 0.0, kp, ki)]
    return PI(plant.r_tilde_bounds, plant.control_step), PIParams(affine(*numbers[:2]), *numbers[2:])


def one(policy: Policy, policy_params: Any, plant: Plant, params: Any, set_point: float = 0.5) -> LocalStability:
    (found,) = analyse(policy, policy_params, plant, params, [set_point])
    return found


def largest(matrix: np.ndarray) -> float:
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def sampled_pi(A: np.ndarray, B: np.ndarray, y: np.ndarray, kp: float, ki: float, dt: float) -> np.ndarray:
    """Matrix of z' = A z + B r~ closed with r~ = kp e + ki I', I' = I + dt e, e = -y z."""
    e = -np.append(y, 0.0)
    integral = np.append(np.zeros(len(A)), 1.0) + dt * e
    open_loop = np.block([[A, np.zeros((len(A), 1))], [integral]])
    return open_loop + np.outer(np.append(B, 0.0), kp * e + ki * integral)


def chebyshev(n: int) -> np.ndarray:
    """(n + 1, n + 1): differentiation on the points cos(j pi / n), from 1 to -1."""
    x = np.cos(np.pi * np.arange(n + 1) / n)
    c = np.r_[2.0, np.ones(n - 1), 2.0] * (-1.0) ** np.arange(n + 1)
    D = np.outer(c, 1.0 / c) / (x[:, None] - x + np.eye(n + 1))
    return D - np.diag(D.sum(1))


def exact_pitch(
    W: tuple[float, ...], d1: float = 0.0, d2: float = 0.0, tau: float = 0.5, n: int = 40
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B, y of the pitch loop over a control step, from the equations as printed.

    The past of each delayed signal stands at Chebyshev points; r~ is held and comes five control steps late.
    """
    A = [[-0.003, 0.039, 0.0, -0.322], [-0.065, -0.319, 7.740, 0.0], [0.020, -0.101, -0.429, 0.0], [0.0, 0.0, 1.0, 0.0]]
    B = np.array([0.010, -0.180, -1.160, 0.0])
    augmented = np.block([[np.array(A), np.zeros((4, 1))], [0.0, 0.0, 0.0, 1.0, 0.0]])
    P = scipy.linalg.solve_continuous_are(augmented, np.append(B, 0.0)[:, None], np.diag([0, 0, 0, 1, 2.5]), [[10.0]])
    K = np.append(B, 0.0) @ P / 10.0

    size = 6 + 3 * n  # [x; xc; xi], pasts of theta, K1 x and K2 xc
    G, late = np.zeros((size + 1, size + 1)), np.zeros((3, size + 1))  # the last is the r~ that acts
    signals = np.zeros((3, size + 1))
    signals[0, 3], signals[1, :4], signals[2, 4] = 1.0, K[:4], K[4]
    for i, delay in enumerate((tau, d1, d2)):
        rows = slice(6 + i * n, 6 + (i + 1) * n)
        D = chebyshev(n) * 2.0 / (delay or 1.0)
        G[rows, rows] = D[1:, 1:]
        G[rows] += np.outer(D[1:, 0], signals[i])
        late[i] = np.eye(size + 1)[5 + (i + 1) * n] if delay else signals[i]
    theta_e = np.eye(size + 1)[size] - late[0]
    G[:4, :4] += A + np.outer(B, [W[1], W[2], 0.0, 0.0])
    G[:4] -= np.outer(B, late[1] + late[2])
    G[4] = np.eye(size + 1)[3] - 0.08 * np.eye(size + 1)[5] - 0.1 * theta_e
    G[5] = -0.2 * np.eye(size + 1)[5] + theta_e

    line = np.eye(5, k=-1)  # r~_(k-1) to r~_(k-5)
    step = scipy.linalg.expm(0.1 * G)[:size]
    transition = np.zeros((size + 5, size + 5))
    transition[:size, :size], transition[:size, -1], transition[size:, size:] = step[:, :size], step[:, size], line
    return transition, np.eye(size + 5)[size], np.eye(size + 5)[3]


@pytest.mark.parametrize(
    ("W", "d1", "d2", "stable"),
    [
        (W_NOMINAL, 0.0, 0.0, True),
        (W_PRINTED, 0.0, 0.0, False),
        (W_NOMINAL, 5.7, 0.57, False),
        (W_NOMINAL, 0.57, 5.7, False),
    ],
    ids=["nominal", "uncertainty", "delay-5.7", "delay-swapped"],
)
def test_inner_loop_alone_on_pitch_is_exact(W: tuple[float, ...], d1: float, d2: float, stable: bool) -> None:
    plant, params = make("pitch", W=W, d1=d1, d2=d2)
    found = one(*none(plant), plant, params, 9.0)
    assert found.spectral_radius == pytest.approx(largest(exact_pitch(W, d1, d2)[0]), abs=1e-5)
    assert (found.spectral_radius < 1.0) is stable
    assert found.y == pytest.approx(3.0, abs=1e-5)
    assert found.r_tilde == 9.0
    assert found.note == ""


def test_length_of_the_lines_does_not_matter() -> None:
    short, long = (make("pitch", d1=0.07, d2=0.33, max_delay=longest) for longest in (None, 1.5))
    radii = [one(*none(PITCH), *plant, 9.0).spectral_radius for plant in (short, long)]
    assert radii[0] == pytest.approx(radii[1], abs=1e-9)


def test_static_prefilter_leaves_the_spectrum_of_pitch() -> None:
    plant, params = make("pitch")
    stabilities = analyse(*steady_state.static(plant, params, KEY), plant, params, [-10.0, 0.0, 14.66])
    exact = largest(exact_pitch(W_NOMINAL)[0])
    np.testing.assert_allclose([c.spectral_radius for c in stabilities], exact, atol=1e-5)
    np.testing.assert_allclose([c.y for c in stabilities], [-10.0, 0.0, 14.66], atol=0.05)
    assert [c.set_point for c in stabilities] == [-10.0, 0.0, 14.66]


@pytest.mark.parametrize(
    ("kp", "ki", "W", "stable"),
    [
        (0.1, 0.01, W_NOMINAL, True),
        (0.0, 0.003, W_NOMINAL, True),
        (3.0, 3.0, W_NOMINAL, False),
        (10.0, 5.0, W_NOMINAL, False),
        (-1.0, 0.2, W_PRINTED, False),
    ],
)
def test_pi_on_pitch_is_exact(kp: float, ki: float, W: tuple[float, ...], stable: bool) -> None:
    plant, params = make("pitch", W=W)
    found = one(*pi(plant, kp, ki, 3.0), plant, params, 9.0)
    exact = largest(sampled_pi(*exact_pitch(W), kp, ki, 0.1))
    assert found.spectral_radius == pytest.approx(exact, abs=1e-5)
    assert (exact < 1.0) is stable
    assert abs(exact - largest(exact_pitch(W)[0])) > 5e-4
    assert found.y == pytest.approx(9.0, abs=1e-6)
    assert found.note == ""


def euler_heaters() -> tuple[float, float]:
    """a, b of x(t + 1 h) = a x(t) + b r~ + c, from ten substeps of the paper's equations at t to infinity."""
    Ca, Ua, Pi, r_u, phi = 10.0, 0.2, 0.4, 10.0, 0.001
    alpha = 1.0 - 0.1 / Ca * (Ua + Pi / (Ca * r_u))
    beta = 0.1 / Ca * -1.0 / (Ca * r_u) / (-Ua / Ca - Pi / (Ca**2 * r_u) - phi)
    return alpha**10, beta * (1.0 - alpha**10) / (1.0 - alpha)


def test_heaters_alone_have_the_eigenvalue_of_euler() -> None:
    plant, params = make("heaters")
    a, b = euler_heaters()
    found = one(*none(plant), plant, params, 20.0)
    assert found.spectral_radius == pytest.approx(a, abs=1e-7)
    # 0 = -Ua (y - x_out) + u + u_free without the part of s that dies out; r~ counts by b / (1 - a) for each degree.
    held = (0.2 * -5.0 + 0.02 * (5.0 + 19.25)) / (0.2 + 0.4 / 100.0)
    assert found.y == pytest.approx(held + b / (1.0 - a) * 20.0, abs=1e-4)
    assert found.note == ""


@pytest.mark.parametrize(("kp", "ki"), [(2.0, 0.5), (0.5, 0.001), (5.0, 90.0)])
def test_pi_on_heaters_has_the_eigenvalues_of_euler(kp: float, ki: float) -> None:
    plant, params = make("heaters")
    a, b = euler_heaters()
    loop = sampled_pi(np.array([[a]]), np.array([b]), np.ones(1), kp, ki, 1.0)
    found = one(*pi(plant, kp, ki, 0.5), plant, params, 20.0)
    # Two houses that differ return to each other by themselves, with a.
    assert found.spectral_radius == pytest.approx(max(a, largest(loop)), abs=1e-6)
    assert found.y == pytest.approx(20.0, abs=1e-6)


def exact_lag() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B, y of the default lag: the dead time of 2.5 control steps makes r~ jump in the middle of one."""
    half = np.exp(-0.05 / 0.3)
    A = np.zeros((4, 4))  # y, r~_(k-1) to r~_(k-3)
    A[0] = [half**2, 0.0, 0.5 * (1.0 - half), 0.5 * (1.0 - half) * half]
    A[2, 1] = A[3, 2] = 1.0
    return A, np.eye(4)[1], np.eye(4)[0]


def test_lag_alone_has_its_time_constant() -> None:
    plant, params = lag.make()
    assert one(*none(plant), plant, params).spectral_radius == pytest.approx(np.exp(-0.1 / 0.3), abs=1e-6)


@pytest.mark.parametrize(("kp", "ki", "stable"), [(0.0, 0.5, True), (1.0, 2.0, True), (8.0, 3.0, False)])
def test_pi_on_lag_is_exact(kp: float, ki: float, stable: bool) -> None:
    plant, params = lag.make()
    exact = largest(sampled_pi(*exact_lag(), kp, ki, 0.1))
    found = one(*pi(plant, kp, ki, 2.0), plant, params)
    assert found.spectral_radius == pytest.approx(exact, abs=1e-6)
    assert (exact < 1.0) is stable
    assert found.y == pytest.approx(0.5, abs=1e-9)


@of_single_draws
def test_learned_policy_returns_as_fast_as_the_analysis_says() -> None:
    plant, params = lag.make(d=0.1)
    observer = Observer.of(plant, history=3)
    policy = LearnedPolicy(observer, (16, 16), 4.0)
    network = policy.init_actor(KEY)
    actor = jax.tree.map(lambda leaf: jax.random.normal(jax.random.key(1), leaf.shape, float) / 4.0, network)
    policy_params = LearnedParams(actor, affine(2.0, 0.0))
    found = one(policy, policy_params, plant, params)
    with jax.enable_x64(True):
        policy_params, params = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), (policy_params, params))
        r, rest = jnp.asarray(0.5), plant.init(KEY, params)

        def step(loop: Any, _: None) -> tuple[Any, jax.Array]:
            carry, r_tilde = policy.act(policy_params, loop[1], r, loop[0].y)
            state = plant.step(params, loop[0], r_tilde, KEY)
            return (state, carry), state.y

        loop = (rest, policy.init(policy_params, r, rest.y))
        y = np.asarray(jax.jit(lambda loop: jax.lax.scan(step, loop, length=1000)[1])(loop))
    away = np.abs(y - y[-1])
    first, last = np.flatnonzero((away > 1e-9) & (away < 1e-5))[[0, -1]]
    assert found.spectral_radius == pytest.approx((away[last] / away[first]) ** (1.0 / (last - first)), abs=1e-4)
    assert found.y == pytest.approx(y[-1], abs=1e-9)
    assert found.note == ""


def test_static_prefilter_at_its_bound_says_so() -> None:
    plant, params = lag.make()
    found = one(*steady_state.static(plant, params, KEY), plant, params, 3.0)
    assert found.r_tilde == 4.0
    assert found.y == pytest.approx(2.0, abs=1e-6)
    assert found.spectral_radius == pytest.approx(np.exp(-0.1 / 0.3), abs=1e-6)
    assert found.note == "r~ at its bound"


def test_integral_that_stands_still_at_the_bound_is_neutral() -> None:
    plant, params = lag.make()
    found = one(*pi(plant, 1.0, 2.0, 2.0), plant, params, 3.0)
    assert found.note == "r~ at its bound"
    assert found.r_tilde == 4.0
    assert found.spectral_radius == 1.0


@dataclass(frozen=True)
class Bent:
    """r~ = 2 r + gain |r - y - at|."""

    gain: float
    at: float = 0.0
    host: bool = False

    def init(self, params: Any, r0: Any, y0: Any) -> tuple[()]:
        return ()

    def act(self, params: Any, carry: tuple[()], r: Any, y: Any, key: Any = None) -> tuple[tuple[()], Any]:
        return carry, 2.0 * r + self.gain * (jnp.abs(r - y - self.at) - abs(self.at))


def test_kink_is_named_with_the_radii_of_its_sides() -> None:
    plant, params = lag.make()
    A, B, y = exact_lag()
    falling, rising = (largest(A + gain * np.outer(B, y)) for gain in (-1.5, 1.5))
    assert abs(falling - rising) > 0.01
    for set_point in (0.0, 0.5):
        found = one(Bent(1.5), (), plant, params, set_point)
        assert found.y == pytest.approx(set_point, abs=1e-6)
        assert found.spectral_radius == pytest.approx(max(falling, rising), abs=1e-6)
        low, high = min(falling, rising), max(falling, rising)
        assert found.note == f"at a kink: spectral radius {low:.6g} to {high:.6g} on its sides"


@pytest.mark.parametrize("at", [-1e-3, 1e-3])
def test_beside_a_kink_only_its_side_counts(at: float) -> None:
    plant, params = lag.make()
    A, B, y = exact_lag()
    found = one(Bent(1.5, at), (), plant, params)
    assert found.y == pytest.approx(0.5, abs=1e-6)
    slope = -1.5 if at < 0 else 1.5
    assert found.spectral_radius == pytest.approx(largest(A + slope * np.outer(B, y)), abs=1e-6)
    assert found.note == ""


def test_host_policy_has_no_stability() -> None:
    plant, params = lag.make()
    policy = replace(Bent(1.0), host=True)
    assert analyse(policy, (), plant, params, [0.5]) == [
        LocalStability(0.5, None, None, None, "policy is not a JAX function")
    ]


def bare(slope: float, drift: float = 0.0) -> Plant:
    """y' = slope y - 0.1 y^3 + 0.1 r~ + drift: nothing but y, and nothing declared about it."""

    def step(params: Any, state: jax.Array, r_tilde: jax.Array, key: Any) -> jax.Array:
        return slope * state - params * state**3 + params * r_tilde + drift

    return replace(
        lag.LAG,
        name="bare",
        init=lambda key, params: jnp.zeros(()),
        step=step,
        output=lambda params, state: state,
        start=None,
        variables=float_leaves,
        settled=with_float_leaves,
    )


def test_a_plant_that_declares_nothing_is_analysed_too() -> None:
    found = one(*none(bare(0.9)), bare(0.9), jnp.asarray(0.1), 2.0)
    assert found.y == pytest.approx(1.0, abs=1e-6)
    assert found.spectral_radius == pytest.approx(0.6, abs=1e-6)


def test_equilibrium_is_found_though_the_loop_never_settles() -> None:
    plant = bare(-1.2)  # y = 0 is unstable; it ends in a limit cycle
    found = one(*none(plant), plant, jnp.asarray(-0.1), 0.0)
    assert found.y == pytest.approx(0.0, abs=1e-9)
    assert found.spectral_radius == pytest.approx(1.2, abs=1e-9)


def test_loop_without_equilibrium_says_so() -> None:
    plant = bare(1.0, drift=1.0)
    found = one(*none(plant), plant, jnp.asarray(0.0))
    assert found == LocalStability(0.5, None, None, None, "no equilibrium found")


def test_undeclared_clock_and_undeclared_noise_are_noticed() -> None:
    clock = replace(lag.LAG, variables=float_leaves, settled=with_float_leaves)
    noise = replace(HEATERS, noise_free=lambda params: params)
    for plant, params in ((clock, lag.make()[1]), (noise, make("heaters")[1])):
        note = "depends on a clock or on noise that is not declared"
        assert one(*none(plant), plant, params) == LocalStability(0.5, None, None, None, note)


def test_parameters_that_are_no_numbers_give_no_equilibrium() -> None:
    plant, params = lag.make()
    found = one(*none(plant), plant, replace(params, K=jnp.asarray(jnp.nan)))
    assert found == LocalStability(0.5, None, None, None, "no equilibrium found")


def test_variables_without_their_inverse_are_refused() -> None:
    with pytest.raises(ValueError, match=r"'lag'.*both or neither"):
        replace(lag.LAG, settled=with_float_leaves)


@pytest.mark.parametrize("steps", [2, 7, 53])
@pytest.mark.parametrize(
    ("plant", "params"),
    [
        make("pitch", tau=0.137, d1=0.021, d2=0.05),
        make("heaters", lambda1=-100.0, sigma=0.0),
        lag.make(),
    ],
    ids=["pitch", "heaters", "lag"],
)
def test_variables_step_alike_at_any_clock(plant: Plant, params: Any, steps: int) -> None:
    step = jax.jit(plant.step)
    state = plant.training_start(KEY, params)
    levels = jax.random.uniform(KEY, (steps + 5,), float, *plant.r_tilde_bounds)
    for level in levels[:steps]:
        state = step(params, state, level, KEY)
    variables = plant.variables(params, state)
    settled = plant.settled(params, state, variables)
    chex.assert_trees_all_equal(plant.variables(params, settled), variables)
    chex.assert_trees_all_equal_shapes_and_dtypes(settled, state)
    for level in levels[steps:]:
        state, settled = (step(params, each, level, KEY) for each in (state, settled))
        chex.assert_trees_all_close(plant.variables(params, settled), plant.variables(params, state), atol=1e-4)


def test_spectral_radius_of_many_variables_is_that_of_few() -> None:
    rng = np.random.default_rng(0)
    block, coupling = rng.normal(size=(500, 500)) / 20.0, rng.normal(size=(500, 700))
    line = np.eye(700, k=-1)  # eigenvalues zero, that rounding would make large
    matrix = np.block([[block, coupling], [np.zeros((700, 500)), line]])
    assert spectral_radius(matrix) == pytest.approx(largest(block), rel=1e-9)
    assert spectral_radius(line) == 0.0


@pytest.mark.parametrize("K", [0.5, 2.0])
def test_of_a_bank_the_law_that_acts_at_the_equilibrium_is_analysed(K: float) -> None:
    plant, params = lag.make(K=K, T=5.0, d=0.0)
    pole = np.exp(-lag.CONTROL_STEP / 5.0)
    models = [[[pole, 0.0]] * 2, [[gain * (1.0 - pole), 0.0] for gain in (0.5, 2.0)]]
    made = bank.of([affine(1.0 / gain, 0.0, 2) for gain in (0.5, 2.0)], *models, 1.0)
    policy = LearnedPolicy(replace(Observer.of(plant, 3, lags=2), laws=2), (8, 8), 1.0)
    idle = jax.tree.map(jnp.zeros_like, policy.init_actor(KEY))
    found = one(policy, LearnedParams(idle, made), plant, params)
    assert found.r_tilde == pytest.approx(0.5 / K, rel=1e-6)
    assert found.spectral_radius == pytest.approx(pole, rel=1e-6)
    assert found.note == ""
