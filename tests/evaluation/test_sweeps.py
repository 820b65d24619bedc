from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxouter.evaluation import scenarios, sweeps
from jaxouter.evaluation.metrics import mae
from jaxouter.evaluation.rollout import rollout
from jaxouter.evaluation.sweeps import Axis
from jaxouter.loop.policy import none
from jaxouter.plants import REGISTRY, make
from tests import lag

PITCH = ["pitch/pilot-delay", "pitch/controller-delays", "pitch/gain", "pitch/sensor-noise"]
HEATERS = ["heaters/houses", "heaters/x-out", "heaters/heterogeneity", "heaters/sensor-noise"]


def inner_loop(sweep):
    return sweep.mae(rollout(*none(sweep.scenario.plant), sweep.scenario))


@pytest.mark.parametrize(("plant", "names"), [("pitch", PITCH), ("heaters", HEATERS)])
def test_catalogue(plant, names):
    assert list(sweeps.catalogue(plant)) == names


@pytest.mark.parametrize("identifier", PITCH + HEATERS)
def test_coarse_values_are_among_the_fine_ones(identifier):
    fine, coarse = sweeps.get(identifier), sweeps.get(identifier, coarse=True)
    assert fine.id == coarse.id == fine.scenario.id == identifier
    for few, many in zip(coarse.axes, fine.axes, strict=True):
        assert set(few.values) < set(many.values)
        assert many.nominal in few.values
    for sweep in (fine, coarse):
        assert len(sweep.scenario.keys) == sweep.repeats * np.prod([len(axis.values) for axis in sweep.axes])


@pytest.mark.parametrize("identifier", PITCH)
def test_inner_loop_has_the_papers_mae_at_the_nominal_point_of_pitch(identifier):
    sweep = sweeps.get(identifier, coarse=True)
    values = inner_loop(sweep)
    assert values.shape == tuple(len(axis.values) for axis in sweep.axes)
    nominal = tuple(axis.values.index(axis.nominal) for axis in sweep.axes)
    assert values[nominal] == pytest.approx(10.907, rel=1e-3)


def test_grid_of_two_axes_is_row_major():
    sweep = sweeps.get("pitch/controller-delays", coarse=True)
    values = inner_loop(sweep)
    plant, params = make("pitch", d1=3.0, d2=1.5)
    scenario = scenarios.get("pitch/paper")
    one = replace(scenario, params=jax.tree.map(lambda leaf: leaf[None], params))
    expected = mae(rollout(*none(plant), one))
    at = [axis.values.index(value) for axis, value in zip(sweep.axes, (3.0, 1.5), strict=True)]
    assert values[*at] == pytest.approx(expected, rel=1e-3)
    assert values[*at[::-1]] != pytest.approx(expected, rel=1e-2)


def test_repeats_have_the_same_noise_at_each_point():
    sweep = sweeps.get("heaters/x-out", coarse=True)
    traces = rollout(*none(sweep.scenario.plant), sweep.scenario)
    warmth = np.diff(traces.y.reshape(5, sweep.repeats, 200), axis=0)  # x_out acts the same on every noise
    np.testing.assert_allclose(warmth, warmth[:, :1].repeat(sweep.repeats, 1), atol=1e-3)
    assert np.ptp(traces.y.reshape(5, sweep.repeats, 200)[0, :, 100]) > 1e-3
    assert (np.diff(sweep.mae(traces)) > 0).all()


def test_houses_are_counted_by_their_weights():
    sweep = sweeps.get("heaters/houses", coarse=True)
    assert sweep.axes[0].values == (1.0, 10.0, 100.0, 1000.0, 10000.0)
    weights = np.asarray(sweep.scenario.params.weights)[:: sweep.repeats]
    np.testing.assert_array_equal((weights > 0).sum(1), sweep.axes[0].values)
    np.testing.assert_allclose(weights.sum(1), 1.0, rtol=1e-4)
    plant, scenario = sweep.scenario.plant, sweep.scenario
    starts = jax.vmap(lambda key, params: plant.output(params, plant.init(key, params)))(scenario.keys, scenario.params)
    np.testing.assert_allclose(starts, 17.8, atol=1e-3)


def test_heterogeneous_stock_is_nominal_at_zero_and_differs_from_repeat_to_repeat():
    sweep = sweeps.get("heaters/heterogeneity", coarse=True)
    Ca = np.asarray(sweep.scenario.params.house.Ca).reshape(6, sweep.repeats, 1000)
    np.testing.assert_array_equal(Ca[0], 10.0)
    assert 4.99 < Ca[-1].min() < 5.1
    assert 14.9 < Ca[-1].max() < 15.01
    assert not np.allclose(Ca[-1, 0], Ca[-1, 1])
    assert not np.allclose(Ca / 10, np.asarray(sweep.scenario.params.house.Ua).reshape(Ca.shape) / 0.2)


def test_mae_is_nan_where_a_repeat_is_not_finite():
    sweep = sweeps.get("pitch/sensor-noise", coarse=True)
    traces = rollout(*none(sweep.scenario.plant), sweep.scenario)
    y = traces.y.copy()
    y[sweep.repeats + 1, -1], y[-1, 0] = np.nan, np.inf
    np.testing.assert_array_equal(np.isnan(sweep.mae(traces._replace(y=y))), [False, True, False, False, True])


def test_axis_without_its_nominal_value_is_refused():
    with pytest.raises(ValueError, match=r"axis 'tau': nominal is 0\.3; it must be one of"):
        Axis("tau", "s", (0.0, 0.5), 0.3)


def test_unknown_sweep_lists_those_that_exist(monkeypatch):
    with pytest.raises(ValueError, match="no sweep 'pitch/delay'; pitch has: pitch/pilot-delay, "):
        sweeps.get("pitch/delay")
    monkeypatch.setitem(REGISTRY, "lag", lag.make)
    assert sweeps.catalogue("lag") == {}
    with pytest.raises(ValueError, match="lag has: none"):
        sweeps.get("lag/gain")
    with pytest.raises(ValueError, match="no plant 'boat'"):
        sweeps.catalogue("boat")
