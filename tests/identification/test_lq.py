"""The LQ law: the exact answer where it is known, and what it does on plants of every kind."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.signal import lfilter

from jaxouter.identification import lq, steady_state
from jaxouter.identification.records import Record, record
from jaxouter.identification.steady_state import IdentificationWarning
from jaxouter.loop.disturbances import Disturbances
from jaxouter.loop.episodes import TrainingEpisodes
from jaxouter.loop.policy import Linear, LinearLaw, affine, padded
from tests import kinds, lag

KEY = jax.random.key(0)
SLOW_KINDS = ("Nonminimum", "Negative", "Slow", "Unstable")  # those that take longer to run
KNOWN = {  # a and b of y_(k+1) = a y_k + ... + b r~_k + ...
    "lag": ([0.9], [0.1]),
    "oscillating": ([1.6, -0.8], [0.1, 0.1]),
    "late": ([0.9], [0.0, 0.0, 0.0, 0.0, 0.1]),
    "non-minimum-phase": ([1.5, -0.56], [-0.1, 0.16]),
    "integrating": ([1.7, -0.7], [0.05, 0.04]),
    "unstable": ([1.05], [0.2]),
}


def excited(a, b, episodes=8, steps=80) -> Record:
    """The response of a known model to random r~ from random levels."""
    rng = np.random.default_rng(0)
    r_tilde = np.repeat(rng.uniform(-1.0, 1.0, (episodes, steps // 5)), 5, 1)
    y = lfilter(np.append(0.0, b), np.append(1.0, -np.asarray(a)), np.pad(r_tilde, ((0, 0), (0, 1))))
    level = (
        np.zeros((episodes, 1)) if max(abs(np.roots([1.0, *-np.asarray(a)]))) >= 1.0 else rng.normal(size=(episodes, 1))
    )
    return Record(r_tilde, y + level)


def cost(law: LinearLaw, a, b, price, steps=400) -> float:
    """Sum of e^2 + price times squared moves of r~, from rest at 0 to a set-point at 1."""
    n = len(law.y_past)
    y, r_tilde, total = np.zeros(n + len(a) + 1), np.zeros(n + len(b) + 1), 0.0  # newest first
    for _ in range(steps):
        u = law.r + law.y * y[0] + law.y_past @ (y[1 : n + 1] - y[0]) + law.r_tilde_past @ r_tilde[:n]
        total += price * (u - r_tilde[0]) ** 2
        r_tilde = np.append(u, r_tilde[:-1])
        y = np.append(a @ y[: len(a)] + b @ r_tilde[: len(b)], y[:-1])
        total += (1.0 - y[0]) ** 2
    return total


def optimal_cost(a, b, price) -> float:
    """The least such cost: e^2 + price du^2 by scipy's Riccati solver, in all past moves as the state."""
    n = max(len(a), len(b))
    a, b = np.pad(a, (0, n - len(a))), np.pad(b, (0, n - len(b)))
    size = 2 * n
    A, B, Q = np.zeros((size, size)), np.zeros((size, 1)), np.zeros((size, size))
    A[1, 1 : 1 + n], A[1, 1 + n :], B[1, 0] = a, b[1:], b[0]  # state: e, dy_k .., dr~_(k-1) ..
    A[0], B[0] = A[1], B[1]
    A[0, 0] = Q[0, 0] = 1.0
    for i in range(1, n):
        A[1 + i, i] = 1.0
    if n > 1:
        B[1 + n, 0] = 1.0
    for i in range(1, n - 1):
        A[1 + n + i, n + i] = 1.0
    P = scipy.linalg.solve_discrete_are(A, B, Q, np.array([[price]]))
    return P[0, 0] - 1.0  # from e = 1, whose own square no policy can help


@pytest.mark.parametrize("name", KNOWN)
@pytest.mark.parametrize("price", [0.01, 1.0])
def test_the_law_of_a_record_has_the_least_cost(name, price):
    a, b = map(np.array, KNOWN[name])
    ((of_y, of_r_tilde),) = lq.fits(excited(a, b), max(len(a), len(b)), [0.0])
    assert cost(lq.law(of_y, of_r_tilde, price), a, b, price) == pytest.approx(optimal_cost(a, b, price), rel=1e-4)


def test_riccati_is_that_of_scipy():
    rng = np.random.default_rng(0)
    A, B = rng.normal(size=(6, 6)), rng.normal(size=(6, 1))
    Q = np.diag(rng.uniform(size=6))
    np.testing.assert_allclose(
        lq.riccati(A, B, Q, 0.3), scipy.linalg.solve_discrete_are(A, B, Q, np.array([[0.3]])), rtol=1e-6
    )


def test_what_no_input_can_bring_back_has_no_law():
    A, B, Q = np.diag([1.2, 0.5]), np.array([[0.0], [1.0]]), np.eye(2)
    assert np.isnan(lq.riccati(A, B, Q, 1.0)).all()


def test_noise_in_the_fit_is_that_of_many_noisy_copies():
    data, noise, rng = excited(*KNOWN["oscillating"]), 0.3, np.random.default_rng(1)
    copies = [(data.r_tilde, data.y + noise * rng.normal(size=data.y.shape)) for _ in range(400)]
    tiled = Record(*map(np.concatenate, zip(*copies, strict=True)))
    (expected,), (found,) = lq.fits(tiled, 4, [0.0]), lq.fits(data, 4, [noise])
    np.testing.assert_allclose(np.concatenate(found), np.concatenate(expected), atol=0.01)


def test_samples_that_are_not_finite_are_left_out():
    data = excited(*KNOWN["late"])
    broken = data._replace(y=np.where(np.arange(data.y.shape[1]) > 60, np.nan, data.y))
    for ours, theirs in zip(lq.fits(broken, 5, [0.0])[0], lq.fits(data, 5, [0.0])[0], strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


@pytest.mark.parametrize("name", KNOWN)
def test_radius_and_amplification_are_those_of_a_simulation(name):
    a, b = map(np.array, KNOWN[name])
    law = lq.law(*(np.pad(each, (0, 6 - len(each))) for each in (a, b)), 0.3)
    rng = np.random.default_rng(0)

    def simulated(noise, steps, begin):
        y, seen, r_tilde, out = np.full(8, begin), np.full(8, begin), np.full(8, 0.0), []
        for k in range(steps):
            seen = np.append(y[0] + noise[k], seen[:-1])
            u = law.y * seen[0] + law.y_past @ (seen[1:7] - seen[0]) + law.r_tilde_past @ r_tilde[:6]
            r_tilde = np.append(u, r_tilde[:-1])
            y = np.append(a @ y[: len(a)] + b @ r_tilde[: len(b)], y[:-1])
            out.append(y[0])
        return np.array(out)

    noisy = simulated(rng.normal(size=40_000), 40_000, 0.0)
    laws = LinearLaw(*(np.asarray(each)[None] for each in law))
    assert lq.amplification(laws, a, b, 400)[0] == pytest.approx(noisy.std(), rel=0.03)
    left = np.abs(simulated(np.zeros(400), 400, 1.0))
    decay = (left[300:].max() / left[100:200].max()) ** (1 / 200) if left[300:].max() > 1e-12 else 0.0
    assert lq.radius(law, a, b) < 1.0
    assert decay <= lq.radius(law, a, b) + 0.02


def chosen(make, episodes=16, **changes):
    plant, params = make(**changes)
    _, static = steady_state.static(plant, params, KEY)
    data = record(plant, params, jax.random.key(1), episodes)
    return plant, params, static, lq.choose(plant, [data], static, jax.random.key(2), 15, Disturbances(0.015, 0.1))


def mean_error(plant, params, law) -> float:
    episodes, policy = TrainingEpisodes(plant, Disturbances(0.015, 0.1)), Linear(plant.r_tilde_bounds)

    @jax.jit
    @jax.vmap
    def error(key):
        seen = episodes.run(policy, law, params, key)
        return jnp.mean(jnp.abs(seen.r - seen.y))

    return float(error(jax.random.split(jax.random.key(3), 32)).mean())


def test_on_the_lag_it_is_better_than_the_static_prefilter_and_as_good_as_told():
    plant, params, static, found = chosen(lag.make)
    assert found.settings is not None
    reached = mean_error(plant, params, padded(found.law, 60))
    assert reached < 0.95 * mean_error(plant, params, static)  # the dead time alone leaves little
    assert reached == pytest.approx(found.mae, rel=0.35)  # other episodes, of which some have noise
    assert found.mae < 0.95 * found.static_mae


@pytest.mark.parametrize("name", ["Integrating", *(pytest.param(n, marks=pytest.mark.slow) for n in SLOW_KINDS)])
@pytest.mark.filterwarnings("ignore:.*no DC gain to invert")
def test_plants_of_every_kind_are_held_and_followed(name):
    plant, params, static, found = chosen(getattr(kinds, name))
    assert found.settings is not None
    assert mean_error(plant, params, padded(found.law, 60)) < 0.8 * mean_error(plant, params, static)


def test_a_short_record_gets_fewer_lags_and_it_is_said():
    plant, _, _, found = chosen(lag.make, episodes=1)
    assert found.most is not None
    assert found.most < 60
    assert found.settings is None or found.settings.lags <= found.most
    with pytest.warns(IdentificationWarning, match=f"too short for more than {found.most} lags"):
        lq.warn_short(plant, found.most)


def test_where_nothing_is_finite_it_is_the_static_prefilter():
    plant, _ = lag.make()
    data = Record(np.zeros((4, 50)), np.full((4, 51), np.nan))
    found = lq.choose(plant, [data], affine(2.0, 0.0), KEY, 15, Disturbances(0.015, 0.1))
    assert found.settings is None
    assert float(found.law.r) == 2.0
