"""Data-enabled predictive control, against the full programme and against mpc on the lag."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxouter.evaluation.baselines import deepc, mpc
from jaxouter.evaluation.baselines.deepc import DeePCSettings
from jaxouter.evaluation.baselines.qp import Solver, blocks, differences
from jaxouter.evaluation.metrics import mae
from jaxouter.evaluation.rollout import rollout
from jaxouter.identification.linear_models import fit_arx
from jaxouter.identification.records import Record, record
from tests import lag

KEY = jax.random.key(0)
PAST, HORIZON, GAIN = 6, 10, 0.5
SETTINGS = DeePCSettings(PAST, HORIZON, move_weight=0.01, g_weight=1.0, margin=1.0, noise=0.0)
BUDGET = 2_500 + 400 + 10 * 800


@pytest.fixture(scope="module")
def data():
    return record(*lag.make(), KEY, 20)


@pytest.fixture(scope="module")
def noisy(data):
    return data._replace(y=data.y + np.random.default_rng(0).normal(0.0, 0.05, data.y.shape))


def like(settings, data):
    """mpc with the same costs on the exact model."""
    wanted = mpc.MPCSettings(settings.horizon, settings.move_weight, 1e-3, settings.margin, 1e-3)
    return mpc.controller(lag.LAG, mpc.innovations_form(fit_arx(data, 2, 2)), 0.0, wanted)


def test_windows_by_hand():
    data = Record(np.array([[1.0, 3.0, 6.0, 10.0, 15.0, 21.0]]), np.arange(7.0)[None])
    given, future = deepc.windows(data, past=2, horizon=2)
    # The newest window is at t_4: moves before it, y up to it, moves from it on; then y after it.
    np.testing.assert_array_equal(given[:, -1], [3.0, 4.0, 3.0, 4.0, 5.0, 6.0])
    np.testing.assert_array_equal(future[:, -1], [5.0, 6.0])


@pytest.mark.parametrize("past", [3, 4, 12])
@pytest.mark.parametrize("move_weight", [0.001, 0.1])
def test_without_noise_it_does_what_mpc_does(past, move_weight, data, steps):
    settings = SETTINGS._replace(past=past, move_weight=move_weight, g_weight=1e9)
    found = rollout(deepc.controller(lag.LAG, data, GAIN, settings), (), steps)
    expected = rollout(like(settings, data), (), steps)
    np.testing.assert_allclose(found.r_tilde, expected.r_tilde, atol=1e-2)
    assert np.abs(found.r_tilde).max() <= 4.0


def test_tuned_is_within_a_tenth_of_mpc_and_keeps_the_budget(data, steps):
    tuned = deepc.tune(*lag.make(), KEY, BUDGET, lambda text, share: None)
    policy, params = deepc.build(lag.LAG, tuned)
    settings = DeePCSettings(**{name: tuned.settings[name] for name in DeePCSettings._fields})
    found, expected = rollout(policy, params, steps), rollout(like(settings, data), (), steps)
    assert mae(found) == pytest.approx(mae(expected), rel=0.1)
    assert found.reward.sum() == pytest.approx(expected.reward.sum(), rel=0.1)
    assert tuned.steps <= BUDGET


def test_many_noisy_data_come_near_mpc(noisy, data, steps):
    found = rollout(deepc.controller(lag.LAG, noisy, GAIN, SETTINGS), (), steps)
    assert mae(found) < 1.5 * mae(rollout(like(SETTINGS, data), (), steps))


def gain_too_high(scenario):
    return replace(scenario, params=scenario.params.replace(K=1.1 * scenario.params.K))


def loaded(scenario):
    def step(params, state, r_tilde, key):
        return lag.step(params, state, r_tilde + 0.3, key)

    return replace(scenario, plant=replace(scenario.plant, step=step))


@pytest.mark.parametrize("fault", [gain_too_high, loaded])
def test_no_steady_state_error_is_left(fault, data, steps):
    found = rollout(deepc.controller(lag.LAG, data, GAIN, SETTINGS), (), fault(steps))
    np.testing.assert_allclose(found.y[:, -5:], found.r[:, -5:], atol=1e-4)


def test_large_weight_of_g_leaves_plain_least_squares(noisy):
    """The programme is then that of the predictor that linear regression gives: errors are weighed alike."""
    given, future = deepc.windows(noisy, PAST, HORIZON)
    predictor = np.linalg.lstsq(given.T, future.T, rcond=None)[0].T
    held = blocks(HORIZON)
    forced = predictor[:, 2 * PAST :] @ differences(HORIZON) @ held
    steps = differences(held.shape[1])
    moves = 0.01 * GAIN**2 * steps.T @ steps

    def error(g_weight):
        settings = SETTINGS._replace(g_weight=g_weight)
        return deepc.controller(lag.LAG, noisy, GAIN, settings).programme.H - moves

    np.testing.assert_allclose(error(1e9), forced.T @ forced, rtol=1e-6)
    assert np.linalg.eigvalsh(error(1e9) - error(1e-3)).min() > 0.0


@pytest.mark.parametrize("g_weight", [1e-4, 1e-2, 1.0])
def test_reduction_is_exact(g_weight, noisy):
    """The moves are those of the programme in g and u as it is written, solved whole, where nothing limits."""
    few = Record(noisy.r_tilde[:2], noisy.y[:2])
    settings = SETTINGS._replace(g_weight=g_weight)
    programme = deepc.controller(lag.LAG, few, GAIN, settings).programme
    given, future = deepc.windows(few, PAST, HORIZON)
    count, held = given.shape[1], blocks(HORIZON)
    moves, r, last = held.shape[1], 0.3, 0.2
    past = np.random.default_rng(1).normal(0.0, 0.1, 2 * PAST)

    beside = np.eye(count) - np.linalg.pinv(given) @ given
    price = g_weight * np.mean(few.y**2) * count  # windows count as a mean
    steps, first = differences(moves), np.eye(moves)[0]
    Q = np.zeros((count + moves, count + moves))
    Q[:count, :count] = future.T @ future + price * beside
    Q[count:, count:] = 0.01 * GAIN**2 * steps.T @ steps
    q = np.concatenate([-future.T @ np.full(HORIZON, r), -0.01 * GAIN**2 * steps[0] * last])
    of_levels = np.vstack([np.zeros((2 * PAST, moves)), differences(HORIZON) @ held])
    A = np.hstack([given, -of_levels])
    b = np.concatenate([past, np.zeros(HORIZON)])
    b[2 * PAST] = -last
    kkt = np.block([[Q, A.T], [A, np.zeros((len(A), len(A)))]])
    expected = np.linalg.lstsq(kkt, np.concatenate([-q, b]), rcond=1e-14)[0][count : count + moves]

    assert first @ expected != pytest.approx(last)
    found = Solver(programme._replace(low=-1e3, high=1e3))(np.concatenate([past, [r, last]]))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_output_that_is_not_a_number_gives_none(data):
    controller = deepc.controller(replace(lag.LAG, output_limit=0.5), data, GAIN, SETTINGS)
    assert np.isnan(controller.act((), controller.init((), 0.5, 0.0), 0.5, np.nan)[1])
