import json
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter import plants, tasks
from jaxouter.training.config import PretrainingConfig, from_dict, preset, to_dict, with_options
from jaxouter.training.trainer import build
from tests import lag
from tests.training.small import with_agent

EVERY = [(plant, name) for plant in tasks.TASKS for name in tasks.presets(plant)]


@pytest.mark.parametrize(("plant", "name"), EVERY)
def test_presets_are_sound_and_survive_json(plant, name):
    config = preset(plant, name).check()
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config


@pytest.mark.parametrize(("plant", "steps"), [("pitch", 1000 * 200), ("heaters", 2000 * 200)])
def test_paper_preset_is_the_papers(plant, steps):
    config = preset(plant, "paper")
    agent = config.agent
    assert (config.steps, config.environments, agent.updates, agent.replay) == (steps, 1, 1, 1_000_000)
    assert (agent.noise_theta, agent.noise_sigma) == (0.15, (0.2, 0.2))
    assert (config.base, config.redraws) == ("absolute", (0.0, 0.0))
    assert config.total_updates == steps - agent.prefill


def test_numbers_of_numpy_are_numbers():
    start = PretrainingConfig(gradient_steps=np.int32(3), log_above=np.float32(0.1))
    asked = dict(seeds=np.int64(2), randomise=[["d1", np.float64(0), 1]])
    config = with_agent(preset("pitch"), noise_sigma=[np.float32(0.1), jnp.asarray(0.2)])
    config = replace(config, pretraining=start, **asked).check()
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config
    assert (config.seeds, config.agent.noise_sigma, config.pretraining.log_above) == (2, (0.1, 0.2), 0.1)
    with pytest.raises(ValueError, match="reward_scale is nan"):
        replace(preset("pitch"), reward_scale=np.float32("nan")).check()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"plant": "submarine"}, "no plant 'submarine'; the plants are: pitch, heaters"),
        ({"steps": -1}, "steps is -1; it must be positive"),
        ({"seeds": 0}, "seeds is 0; it must be positive"),
        ({"seed": -1}, "seed is -1; it must not be negative"),
        ({"epoch": 100}, "epoch is 100; it must be a multiple of the 16 environments"),
        ({"agent.replay": 100}, "agent.replay is 100; it must hold at least a batch of 256"),
        ({"devices": 0}, "devices is 0; it must be positive"),
        ({"seeds": 3, "devices": 2}, "devices is 2 and seeds is 3; one must be a multiple of the other"),
        ({"devices": 32}, "environments is 16; it must be a multiple of the 32 devices that each of the 1 seeds gets"),
        ({"agent.prefill": 160}, "agent.prefill is 160; it must be at least the batch size, 256"),
        (
            {"steps": 8_000},
            "agent.prefill is 8000; it must be at least the batch size, 256 and less than the 8000 steps",
        ),
        ({"pretraining": PretrainingConfig()}, "steps is 0; it must be positive, or 0 with pretraining or rounds"),
        ({"pretraining": PretrainingConfig(1, plants=2)}, "pretraining.plants is 2; without randomise it must be 1"),
        (
            {"pretraining": PretrainingConfig(1, plants=3), "randomise": (("gain", 0.8, 1.2),)},
            "pretraining.episodes is 64; it must be a multiple of the 3 plants",
        ),
        ({"redraws": (2.0, 1.0)}, r"redraws is \(2.0, 1.0\)"),
        ({"compared": 0, "pairs.rounds": 2}, "compared is 0; it must be positive"),
        ({"agent.relabel": 0.5, "agent.hold": False}, "agent.relabel is 0.5 and agent.hold is False"),
        ({"agent.layer_norm": True}, "agent.critic is 'quadratic' and agent.layer_norm is True"),
        ({"disturbances.load": -0.1}, "disturbances.load is -0.1; it must not be negative"),
        ({"agent.noise_sigma": (0.0, 0.1)}, r"agent.noise_sigma is \(0.0, 0.1\)"),
        ({"agent.speed": 1}, "there is no option 'agent.speed'; there are: agent.hidden, agent.critic,"),
        ({"speed": 1}, "there is no option 'speed'; there are: agent, seed,"),
        ({"agent": "ddpg"}, "agent is 'ddpg'; it has settings of its own, such as agent.hidden"),
    ],
)
def test_errors_name_field_value_and_what_is_allowed(change, text):
    with pytest.raises(ValueError, match=text):
        with_options(preset("pitch", "record"), change).check()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"base": "lq"}, "base is lq and bank has 12 plants; a bank needs --base bank, and plants that a preset"),
        ({"bank": ()}, "base is bank and bank has 0 plants; a bank needs"),
        ({"bank": ((0.1, (("d1", 0.4),)),)}, "bank has 1 plants; it must have 2 to 12"),
        (
            {"randomise": (("gain", 0.8, 1.2),), "pretraining.closed_loop": 0},
            "randomise must be empty with --base bank",
        ),
        ({"steps": 16_000}, "steps is 16000; it must be 0 with --base bank, which is for pretraining alone"),
        ({"compared": 8, "pairs.rounds": 1}, "pairs.rounds is 1; it must be 0 with --base bank"),
    ],
)
def test_a_bank_is_for_pretraining_alone(change, text):
    with pytest.raises(ValueError, match=text):
        with_options(preset("pitch", "robust"), change).check()


def test_what_a_bank_sets_must_be_a_number_of_the_plant():
    config = with_options(preset("pitch", "robust"), {"bank": ((0.1, (("d1", 0.4),)), (0.1, (("d3", 0.4),)))})
    with pytest.raises(ValueError, match="a plant of the bank sets 'd3'; the numbers are: A_h, B"):
        build(config)


def test_a_bank_survives_json_and_counts_what_is_recorded():
    config = preset("pitch", "robust").check()
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config
    assert config.identification_steps == 12 * (64 + 128) * 400
    assert {name: ends for name, *ends in config.ranges}["d2"] == [0.0, 5.9]


def test_unknown_preset_lists_those_that_exist():
    with pytest.raises(ValueError, match="no preset 'fast' for heaters; the presets are: default, scratch, record,"):
        preset("heaters", "fast")


def test_a_plant_of_ones_own_has_presets_without_what_is_pitchs(monkeypatch):
    monkeypatch.setitem(plants.REGISTRY, "lag", lag.make)
    paid = {"correction": 1.0, "reward.beta_h": 0.1}
    default = {"reward.beta_h": 0.03, "reward.rest": 0.05, "disturbances.noise": 0.005, "pairs.rounds": 45}
    default["pretraining.gradient_steps"] = 1_500
    scratch = {"disturbances.load": 0.1}
    for name, own in dict(default=default, scratch=scratch, record={}, paper={}).items():
        wanted = with_options(replace(preset("pitch", name), plant="lag"), paid | own)
        assert preset("lag", name).check() == wanted
    with pytest.raises(ValueError, match="no preset 'robust' for lag; the presets are: default, scratch, record,"):
        preset("lag", "robust")


def test_configuration_with_an_unknown_field_is_refused():
    with pytest.raises(ValueError, match="speed"):
        from_dict({**to_dict(preset("pitch")), "speed": 3})


def test_ranges_survive_json():
    config = replace(preset("pitch"), randomise=(("gain", 0.8, 1.2), ("d1", 0.0, 0.7)))
    assert from_dict(json.loads(json.dumps(to_dict(config)))) == config


def test_last_epoch_may_be_shorter():
    config = replace(preset("pitch"), steps=8_000 + 6_400 + 160, epoch=6_400)
    assert config.agent_epochs == 2
    assert [config.agent_steps(epoch) for epoch in range(2)] == [6_400, 160]
    compared = 2 * 512 * 200
    assert [config.steps_of(epoch, 200) for epoch in range(2)] == [(6_400 + compared, 1_600), (160 + compared, 40)]
