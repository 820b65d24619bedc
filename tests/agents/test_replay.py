import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter.agents.replay import Replay

FIELDS = ("value", "environment", "age")
ENVIRONMENTS, STEPS, EPISODE = 3, 20, 7


def rows_at(t: int) -> np.ndarray:
    """Row number t of each environment; episodes last EPISODE steps, the first of environment e is e steps shorter."""
    return np.array(
        [[100 * e + t, e, t if t < EPISODE - e else (t + e) % EPISODE] for e in range(ENVIRONMENTS)], np.float32
    )


def filled(replay: Replay, written: int):
    state = replay.init()
    for t in range(written):
        state = replay.write(state, jnp.asarray(rows_at(t)))
    return state


@pytest.mark.parametrize("written", [5, 19, 20, 21, 26, 67])
@pytest.mark.parametrize(("lead", "window"), [(0, 1), (4, 1), (4, 3)])
def test_windows_equal_those_of_a_plain_ring(written, lead, window):
    replay = Replay(FIELDS, ENVIRONMENTS, STEPS, lead, window)
    rows, valid = replay.sample(filled(replay, written), jax.random.bits(jax.random.key(written), (500, 2), jnp.uint32))
    chex.assert_shape([rows, valid], [(500, lead + window, 3), (500, lead + window)])
    kept = range(max(0, written - STEPS), written)
    seen = set()
    for row, ok in zip(np.asarray(rows), np.asarray(valid), strict=True):
        e = int(row[lead, 1])
        first = int(row[lead, 0]) - 100 * e  # number of the first transition
        seen.add((e, first))
        for i in range(lead + window):
            t = first - lead + i
            same_episode = t >= 0 and (t + e) // EPISODE == (first + e) // EPISODE
            assert ok[i] == same_episode
            if same_episode:
                assert t in kept
                np.testing.assert_array_equal(row[i], rows_at(t)[e])
    oldest = max(0, written - STEPS + lead + 1)
    assert seen == {(e, t) for e in range(ENVIRONMENTS) for t in range(oldest, written - window + 1)}


def test_rows_are_float32_and_samples_have_the_default_float():
    replay = Replay(FIELDS, ENVIRONMENTS, STEPS, 2)
    state = filled(replay, 8)
    assert state.rows.dtype == jnp.float32
    assert replay.sample(state, jax.random.bits(jax.random.key(0), (4, 2), jnp.uint32))[0].dtype == jnp.zeros(()).dtype


def test_write_and_sample_are_the_same_under_jit():
    replay = Replay(FIELDS, ENVIRONMENTS, STEPS, 4)
    state = filled(replay, 33)
    row = jnp.asarray(rows_at(33))
    chex.assert_trees_all_equal(jax.jit(replay.write)(state, row), replay.write(state, row))
    bits = jax.random.bits(jax.random.key(3), (9, 2), jnp.uint32)
    chex.assert_trees_all_equal(jax.jit(replay.sample)(state, bits), replay.sample(state, bits))


@pytest.mark.parametrize("written", [1, 4, 20, 24, 33])
def test_what_is_taken_back_and_written_again_changes_nothing(written):
    replay = Replay(FIELDS, ENVIRONMENTS, STEPS, 4)
    state = filled(replay, written)
    before, rows = replay.take_back(state)
    np.testing.assert_array_equal(rows, rows_at(written - 1))
    assert int(before.written) == written - 1
    chex.assert_trees_all_equal(replay.write(before, rows), state)
    if written > 1:
        bits = jax.random.bits(jax.random.key(2), (500, 2), jnp.uint32)
        (drawn, valid), (then, _) = (replay.sample(s, bits) for s in (before, filled(replay, written - 1)))
        np.testing.assert_array_equal(drawn[valid], then[valid])


def test_a_replay_shorter_than_its_windows_is_refused():
    with pytest.raises(ValueError, match=r"keeps 10 steps.*more than 10"):
        Replay(FIELDS, ENVIRONMENTS, 10, 5)
