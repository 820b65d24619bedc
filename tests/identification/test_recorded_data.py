"""Reading recorded data, and the models and the plant that come out of them."""

from __future__ import annotations

import math
import re
import sys
from pathlib import Path

import jax
import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from jaxouter import plants
from jaxouter.identification import linear_models, recorded_data
from jaxouter.identification.recorded_data import RecordedData
from jaxouter.loop import environment
from jaxouter.plants.simulators import PlantOptions
from tests import kinds, lag
from tests.precision import of_single_draws
from tests.recorded import recorded, write

KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def clean() -> RecordedData:
    return recorded(*lag.make(), rows=600)


@pytest.fixture(scope="module")
def noisy() -> RecordedData:
    return recorded(*lag.make(), rows=800, noise=0.05)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory, noisy: RecordedData) -> Path:
    return write(tmp_path_factory.mktemp("records") / "lag.csv", noisy)


def test_csv_is_read_as_it_was_written(path: Path, noisy: RecordedData) -> None:
    for column, expected in zip(recorded_data.read(path), noisy, strict=True):
        np.testing.assert_array_equal(column, expected)
    assert recorded_data.read(path).step == 0.1


def test_parquet_is_read_as_it_was_written(tmp_path: Path, clean: RecordedData) -> None:
    file = tmp_path / "lag.parquet"
    parquet.write_table(pyarrow.table({"mode": ["auto"] * 600, **clean._asdict()}), file)
    for column, expected in zip(recorded_data.read(str(file)), clean, strict=True):
        np.testing.assert_array_equal(column, expected)


def test_other_columns_any_order_and_a_byte_order_mark_do_no_harm(tmp_path: Path) -> None:
    rows = "\n".join(f"{k % 7}, x, {k}, {k * 0.5}" for k in range(200))
    file = tmp_path / "log.csv"
    file.write_text(f"\ufeffy, mode, r_tilde, time\n{rows}\n\n", encoding="utf-8")
    data = recorded_data.read(file)
    assert (data.time[2], data.r_tilde[2], data.y[2]) == (1.0, 2.0, 2.0)


def changed(column: str, row: int, value: object) -> str:
    """A CSV of 250 rows, of which one value is another; row from 1 on."""
    names = ["time", "r_tilde", "y"]
    table = [[k / 10, k % 5, k % 3] for k in range(250)]
    table[row - 1][names.index(column)] = value  # type: ignore[call-overload]
    return "\n".join([",".join(names), *(",".join(map(str, line)) for line in table)])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["it is empty", "time,r_tilde,y"]),
        ("time,r,y\n0,1,2\n", ["no column 'r_tilde' but 'r'", "and is time,r,y"]),
        ("time,r_tilde,y,y\n", ["2 columns 'y'"]),
        ("time,r_tilde,y\n", ["there are 0 rows", "at least 200"]),
        ("time,r_tilde,y\n0,1,2\n0.1,1,2\n", ["there are 2 rows", "at least 200"]),
        (changed("y", 17, "high"), ["y in row 17 is 'high'", "a number"]),
        (changed("y", 17, ""), ["y in row 17 is ''"]),
        (changed("r_tilde", 3, "nan"), ["r_tilde in row 3 is nan", "finite"]),
        (changed("time", 9, "inf"), ["time in row 9 is inf", "finite"]),
        (changed("time", 9, 0.7), ["time goes from 0.7 in row 8 to 0.7 in row 9", "increase"]),
        (changed("time", 9, 0.85), ["time goes from 0.7 in row 8 to 0.85 in row 9", "constant within 0.1%, here 0.1"]),
        (re.sub(r"(?m)^([\d.]+),\d+,", r"\1,3,", changed("y", 1, 0)), ["r_tilde is 3 in every row", "moves"]),
        (re.sub(r"(?m),\d+$", ",4", changed("y", 1, 0)), ["y is 4 in every row"]),
    ],
)
def test_what_is_wrong_is_named_with_its_row(tmp_path: Path, text: str, words: list[str]) -> None:
    file = tmp_path / "log.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=re.escape(words[0])) as caught:
        recorded_data.read(file)
    assert [word for word in [str(file), *words] if word not in str(caught.value)] == []


def test_a_file_that_is_none_of_these_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"there is no recorded data .*none\.csv"):
        recorded_data.read(tmp_path / "none.csv")
    with pytest.raises(ValueError, match=r"log\.xlsx is neither \.csv nor \.parquet"):
        recorded_data.read("log.xlsx")
    for name, words in (("log.parquet", "is no Parquet"), ("log.csv", "line 2 is no UTF-8")):
        (tmp_path / name).write_bytes(b"time,r_tilde,y\n\xff\xfe")
        with pytest.raises(ValueError, match=words):
            recorded_data.read(tmp_path / name)
    parquet.write_table(pyarrow.table({"time": [0.0], "r_tilde": [None], "y": [1.0]}), tmp_path / "gap.parquet")
    with pytest.raises(ValueError, match="r_tilde in row 1 is None"):
        recorded_data.read(tmp_path / "gap.parquet")


def test_without_pyarrow_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    (tmp_path / "log.parquet").touch()
    with pytest.raises(ValueError, match=re.escape("pip install 'jaxouter[parquet]'")):
        recorded_data.read(tmp_path / "log.parquet")


def step_of_lag(steps: int, K: float = 0.5, T: float = 0.3, d: float = 0.25) -> np.ndarray:
    t = 0.1 * np.arange(steps)
    return K * np.where(t > d, 1.0 - np.exp(-np.maximum(t - d, 0.0) / T), 0.0)


def test_a_clean_log_gives_the_lag_exactly(clean: RecordedData) -> None:
    models = recorded_data.ensemble(clean)
    assert (models.order, models.dead) == (2, 2)
    for model in (models.nominal, *models.members):
        assert linear_models.gain(model) == pytest.approx(0.5, abs=1e-5)
        assert linear_models.offset(model) == pytest.approx(0.0, abs=1e-5)
        np.testing.assert_allclose(linear_models.step_response(model, 40), step_of_lag(40), atol=1e-5)
    assert linear_models.settling(models.nominal) == 12  # 0.25 s + 3 T = 1.15 s


def test_a_noisy_log_gives_it_within_what_the_ensemble_spreads(noisy: RecordedData) -> None:
    """The noise is 5 % of the standard deviation of y."""
    models = recorded_data.ensemble(noisy)
    gains = [linear_models.gain(model) for model in models.members]
    assert linear_models.gain(models.nominal) == pytest.approx(0.5, rel=0.02)
    assert abs(models.dead - 2) <= 1
    assert 1e-4 < np.std(gains) < 0.01
    np.testing.assert_allclose(linear_models.step_response(models.nominal, 40), step_of_lag(40), atol=0.03)
    assert models.redrawn == 0
    again = recorded_data.ensemble(noisy)
    jax.tree.map(np.testing.assert_array_equal, again, models)


def test_pitch_is_identified_from_its_log() -> None:
    plant, params = plants.make("pitch")
    data = recorded(plant, params, rows=2_000, redraw=0.03)
    models = recorded_data.ensemble(data, members=2)
    assert linear_models.gain(models.nominal) == pytest.approx(1 / 3, rel=0.01)
    assert models.dead == 5  # 0.5 s
    base = np.zeros(150)
    true = np.asarray(plants.simulate(plant, params, base + 1.0, KEY) - plants.simulate(plant, params, base, KEY))
    np.testing.assert_allclose(linear_models.step_response(models.nominal, 151)[1:], true, atol=3e-3)


@pytest.mark.parametrize(("dead", "rows"), [(70, 600), (90, 1_200)])
def test_a_long_dead_time_is_found(dead: int, rows: int) -> None:
    data = recorded(*kinds.late(dead)(), rows=rows, noise=0.01)
    models = recorded_data.ensemble(data, members=2)
    assert models.dead == dead
    assert linear_models.gain(models.nominal) == pytest.approx(0.5, rel=0.02)


def test_the_plant_of_a_log_sees_past_the_dead_time_and_its_episodes_show_y_settle(tmp_path: Path) -> None:
    file = write(tmp_path / "late.csv", recorded(*kinds.late(90)(), rows=800))
    plant, _ = recorded_data.make("late", str(file))
    assert plant.history == 90 + 2
    assert plant.episode_steps == 400
    slow = recorded(*kinds.kind([math.exp(-1 / 100)], [0.005])(), rows=900)
    plant, _ = recorded_data.make("slow", str(write(tmp_path / "slow.csv", slow)))
    assert plant.episode_steps == 2 * 300  # 95 % of a step after three time constants


@pytest.mark.parametrize(("plant", "words"), [(kinds.Integrating, "y integrates r~"), (kinds.Unstable, "are unstable")])
def test_all_commands_refuse_alike_what_does_not_settle(tmp_path: Path, plant: kinds.Maker, words: str) -> None:
    data = recorded(*plant(), rows=400)
    with pytest.raises(ValueError, match=words):
        recorded_data.ensemble(data)
    with pytest.raises(ValueError, match=words):  # `check` and `train` both make the plant, and see this alone
        recorded_data.make("log", str(write(tmp_path / "log.csv", data)))


def test_what_cannot_be_validated_is_refused_before_it_is_a_plant(tmp_path: Path, clean: RecordedData) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorded_data, "without_last_quarter", lambda *_: recorded_data.ensemble(clean, members=1))
        with pytest.raises(ValueError, match="members is 1"):
            recorded_data.make("log", str(write(tmp_path / "log.csv", clean)))


def test_free_run_continues_from_what_was_recorded(clean: RecordedData) -> None:
    models = recorded_data.ensemble(clean, members=2)
    np.testing.assert_allclose(recorded_data.free_run(models.nominal, clean, 300, 250), clean.y[300:550], atol=1e-5)


def test_what_never_comes_to_rest_is_refused() -> None:
    rng = np.random.default_rng(0)
    r_tilde = np.repeat(rng.uniform(-1.0, 1.0, 30), 10)
    y = 1e-3 * np.exp(0.05 * np.arange(300)) + 0.1 * np.cumsum(r_tilde)
    with pytest.raises(ValueError, match="unstable"):
        recorded_data.ensemble(RecordedData(0.1 * np.arange(300), r_tilde, y))


def test_too_few_members_are_refused(clean: RecordedData) -> None:
    with pytest.raises(ValueError, match="members is 1; it must be at least 2"):
        recorded_data.ensemble(clean, members=1)


@of_single_draws  # of other draws the models may agree by chance
def test_an_output_that_has_nothing_to_do_with_r_tilde_is_refused(tmp_path: Path, clean: RecordedData) -> None:
    noise = clean._replace(y=np.random.default_rng(0).standard_normal(600))
    file = write(tmp_path / "noise.csv", noise)
    with pytest.raises(ValueError, match="do not agree on any y"):
        recorded_data.make("log", str(file))


def test_the_plant_declares_what_the_log_has_seen(path: Path, noisy: RecordedData) -> None:
    plant, params = recorded_data.make("log", str(path))
    low, high = plant.r_tilde_bounds
    assert (low, high) == (noisy.r_tilde.min(), noisy.r_tilde.max())
    np.testing.assert_allclose(plant.setpoint_range, (0.5 * low, 0.5 * high), atol=0.1)
    assert noisy.y.min() <= plant.setpoint_range[0] < plant.setpoint_range[1] <= noisy.y.max()
    assert plant.evaluation_range == plant.setpoint_range
    assert plant.divergence_bounds[0] < 2 * noisy.y.min()
    assert plant.divergence_bounds[1] > 2 * noisy.y.max()
    assert (plant.control_step, plant.time_unit, plant.y_unit) == (0.1, "s", "1")
    assert (plant.episode_steps, plant.family_steps, plant.output_limit) == (100, 300, None)
    assert params.ensemble.c.shape == (16,)
    y = plants.simulate(plant, plant.noise_free(params), np.full(200, params.held[1]), KEY)
    assert float(y[-1]) == pytest.approx(plant.setpoint_range[1], abs=1e-3)


def test_what_it_declares_can_be_overridden(path: Path) -> None:
    changes = dict(r_tilde_bounds=(-3.0, 3.0), setpoint_range=(-1.0, 0.5), episode_steps=77, y_unit="degC")
    plant, _ = recorded_data.make("log", str(path), PlantOptions(**changes))
    assert {name: getattr(plant, name) for name in changes} == changes
    assert plant.evaluation_range == (-1.0, 0.5)
    narrower, _ = recorded_data.make("log", str(path), PlantOptions(r_tilde_bounds=(-1.0, 1.0)))
    np.testing.assert_allclose(narrower.setpoint_range, (-0.5, 0.5), atol=0.02)
    with pytest.raises(ValueError, match="recorded data define the control step"):
        recorded_data.make("log", str(path), PlantOptions(control_step=1.0))


def test_an_environment_draws_a_member_for_each_episode(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(plants.REGISTRY, "logged", lambda: recorded_data.make("log", str(path)))
    env, params = environment.make("logged")
    _, state = jax.vmap(env.reset, (0, None))(jax.random.split(KEY, 40), params)
    found = np.asarray(state.plant_params.model.c)
    assert len(np.unique(found)) > 8
    assert set(found.tolist()) <= set(np.asarray(params.plant.ensemble.c).tolist())
    with pytest.raises(ValueError, match="nothing to draw by a range"):
        environment.make("logged", drawn=(("c", 0.0, 1.0),))


def test_a_log_is_identified_once_until_it_changes(tmp_path: Path, clean: RecordedData) -> None:
    file = write(tmp_path / "lag.csv", clean)
    (first, params), (second, _) = recorded_data.make("log", str(file)), recorded_data.make("log", str(file))
    assert hash(first) == hash(second)
    assert first == second
    assert recorded_data.identified(file)[1] is recorded_data.identified(file)[1]
    write(file, clean._replace(y=2.0 * clean.y))
    assert float(recorded_data.make("log", str(file))[1].model.b.sum()) == pytest.approx(
        2.0 * float(params.model.b.sum()), rel=1e-3
    )


def test_an_error_of_identification_names_the_file(tmp_path: Path) -> None:
    t = 0.1 * np.arange(300)
    file = write(tmp_path / "away.csv", RecordedData(t, np.sin(t), np.exp(0.05 * np.arange(300))))
    with pytest.raises(ValueError, match=r"away\.csv: the models of this record are unstable"):
        recorded_data.make("log", str(file))
    assert math.isfinite(recorded_data.read(file).step)
