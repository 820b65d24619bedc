"""What a record says about other r~, beside what the plant itself says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter import plants
from jaxouter.identification import counterfactual
from jaxouter.identification.records import Record, record
from jaxouter.loop.references import telegraph
from jaxouter.plants import make, simulate
from tests import lag
from tests.precision import FLOAT

KEY = jax.random.key(3)


def seen_twice(plant, params, episodes):
    """Record, and the same episodes (start, noise) under another r~: a record of both (episodes, ...)."""

    def both(key):
        key_start, key_run, key_one, key_other = jax.random.split(key, 4)
        state = plant.training_start(key_start, params)
        y0 = plant.output(params, state)
        r_tilde = [telegraph(k, plant.episode_steps, *plant.r_tilde_bounds, 0.1) for k in (key_one, key_other)]
        y = [simulate(plant, params, r, key_run, state) for r in r_tilde]
        return [(r, jnp.concatenate([y0[None], y])) for r, y in zip(r_tilde, y, strict=True)]

    one, other = jax.vmap(both)(jax.random.split(KEY, episodes))
    return Record(*(np.asarray(x, np.float64) for x in one)), Record(*(np.asarray(x, np.float64) for x in other))


@pytest.mark.parametrize(("name", "lags", "within"), [("pitch", 30, 1e-3), ("heaters", 5, 0.1)])
def test_the_other_past_of_an_episode_is_the_one_the_plant_would_have_had(name, lags, within):
    """But for 0.1 % of the difference on pitch; on heaters, whose response changes with time, but for 10 %."""
    plant, params = make(name)
    one, other = seen_twice(plant, params, 16)
    model = counterfactual.fit(one, lags)
    asked = counterfactual.plant(plant, lags)

    def answer(i, r_tilde):
        episode = jax.tree.map(lambda leaf: leaf[i], model)
        return simulate(asked, episode, r_tilde, KEY, asked.init(KEY, episode))

    found = jax.vmap(answer)(jnp.arange(16), jnp.asarray(other.r_tilde, float))
    error = np.asarray(found) - other.y[:, 1:]
    difference = np.sqrt(np.mean((other.y - one.y) ** 2))
    assert difference > 4.0  # it is quite another episode
    assert np.sqrt(np.mean(error**2)) < within * difference


def test_under_the_recorded_input_it_is_the_record():
    plant, params = lag.make()
    data = record(plant, params, KEY, 4)
    asked = counterfactual.plant(plant, 3)
    episode = asked.draw(jax.random.key(5), counterfactual.fit(data, 3))
    y = simulate(asked, episode, episode.r_tilde, KEY, asked.training_start(KEY, episode))
    np.testing.assert_array_equal(y, episode.y[1:])
    assert any(np.array_equal(np.asarray(episode.y, np.float64), other.astype(FLOAT)) for other in data.y)


def test_a_smoothed_episode_has_less_noise_and_the_same_course():
    plant, params = plants.make("heaters")
    model = counterfactual.fit(record(plant, params, KEY, 16), 5)
    difference = np.asarray(model.y - model.smoothed)
    np.testing.assert_array_equal(difference[:, :5], 0.0)

    def roughness(y):
        return np.abs(np.diff(np.asarray(y)[:, 6:], n=2)).mean()

    steady = counterfactual.fit(record(plant, plant.noise_free(params), KEY, 16), 5)
    noise, smoothed, without = (roughness(y) for y in (model.y, model.smoothed, steady.y))
    assert smoothed - without < 0.35 * (noise - without)
    assert np.abs(difference).mean() < 0.5
    assert np.abs(np.asarray(steady.smoothed - steady.y)).mean() < 0.1
