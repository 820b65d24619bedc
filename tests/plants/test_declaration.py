"""Declarations, field by field."""

import dataclasses
import math
import re

import jax.numpy as jnp
import numpy as np
import pytest

from jaxouter import check, evaluate, train
from jaxouter.loop.references import FAMILIES
from jaxouter.plants import Plant, declaration, interface
from jaxouter.plants.simulators import PlantOptions
from tests.lag import LAG, make
from tests.load import ROOT


def changed(**fields):
    return dataclasses.replace(LAG, **fields)


@pytest.mark.parametrize(
    ("field", "given", "meant"),
    [
        ("episode_steps", 120.0, 120),
        ("history", np.int64(7), 7),
        ("family_steps", jnp.asarray(90), 90),
        ("control_step", np.float32(0.02), 0.02),
        ("control_step", jnp.asarray(0.02), 0.02),
        ("control_step", np.array(3), 3.0),
        ("output_limit", np.float64(2.0), 2.0),
        ("move_threshold", math.inf, math.inf),
        ("r_tilde_bounds", [-4, 4], (-4.0, 4.0)),
        ("setpoint_range", np.array([-1.0, 1.0], np.float32), (-1.0, 1.0)),
        ("setpoint_range", (np.float32(-0.1), jnp.asarray(0.1)), (-0.1, 0.1)),
        ("evaluation_range", (), (-1.0, 1.0)),
        ("divergence_bounds", (), (-20.0, 20.0)),
        ("families", ["steps", "days"], ("steps", "days")),
        ("affine", np.True_, True),
    ],
)
def test_what_is_meant_is_taken(field, given, meant):
    plant = changed(**{field: given})
    assert getattr(plant, field) == meant
    assert type(getattr(plant, field)) is type(meant)
    assert hash(plant)


NUMBERS = ("control_step", "output_limit", "rate_limit", "move_threshold", "error_scale")
COUNTS = ("episode_steps", "history", "family_steps")
RANGES = ("r_tilde_bounds", "setpoint_range", "evaluation_range", "divergence_bounds")
FUNCTIONS = ("init", "step", "output", "start", "draw", "members", "reuse", "variables", "settled", "noise_free")
REFUSED = [
    *((field, value) for field in NUMBERS for value in (-1.0, math.nan, "0.1", True, np.ones(1), 1j)),
    *((field, 0.0) for field in ("control_step", "output_limit", "rate_limit")),
    ("control_step", math.inf),
    *((field, value) for field in COUNTS for value in (0, -3, 2.5, math.nan, math.inf, "9", [9])),
    *((field, None) for field in ("episode_steps", "family_steps")),  # None of history: chosen
    *((field, value) for field in RANGES for value in ((1, -1), (2, 2), (0, math.inf), (math.nan, 1), (1,), 3, "ab")),
    *((field, value) for field in FUNCTIONS for value in (3.0, "step")),
    *((field, value) for field in ("init", "step", "output", "reuse") for value in (None,)),
    *((field, value) for field in ("name", "y_unit", "time_unit") for value in (3, None, "", b"s")),
    *((field, value) for field in ("differentiable", "affine", "identified") for value in (1, "no", None)),
    *(("families", value) for value in (("steps", "waves"), (), "steps", None, ("steps", "steps"))),
]


@pytest.mark.parametrize(("field", "value"), REFUSED)
def test_what_is_not_allowed_is_refused_by_name(field, value):
    with pytest.raises(ValueError, match=re.escape(f"{field} is ")) as error:
        changed(**{field: value})
    assert "it must be " in str(error.value)
    assert declaration.shown(value) in str(error.value)


def test_every_field_of_a_plant_is_looked_at():
    assert set(declaration.PLANT) == {field.name for field in dataclasses.fields(Plant)}
    assert tuple(FAMILIES) == declaration.FAMILIES


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"control_step": math.nan}, "--control-step is nan; it must be a positive finite number"),
        ({"episode_steps": 0}, "--episode-steps is 0; it must be a whole number, at least 1"),
        ({"setpoint_range": (1.0, math.inf)}, "--setpoint-range is (1.0, inf); it must be two finite numbers"),
        ({"r_tilde_bounds": (1.0, 1.0)}, "--r-tilde-bounds is (1.0, 1.0)"),
        ({"y_unit": " "}, "--y-unit is ' '; it must be a text"),
    ],
)
def test_options_of_a_plant_are_refused_by_name(options, text):
    defaults = dict(r_tilde_bounds=(-1.0, 1.0), control_step=1.0, episode_steps=9, y_unit="1")
    with pytest.raises(ValueError, match=re.escape(text)):
        PlantOptions(**options).declared(**defaults)
    found = PlantOptions(r_tilde_bounds=[-2, 2], episode_steps=5.0).declared(**defaults)
    assert (found["r_tilde_bounds"], found["episode_steps"], found["setpoint_range"]) == ((-2.0, 2.0), 5, (-1.0, 1.0))


@pytest.mark.parametrize("command", [(check,), (train,), (train, "--dry-run"), (evaluate, "--policy", "none")])
def test_every_command_refuses_a_declaration_alike(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    tanks = (ROOT / "scripts" / "examples" / "tanks.py").read_text()
    (tmp_path / "own.py").write_text(tanks.replace("episode_steps=200", "episode_steps=-200"))
    module, *arguments = command
    with pytest.raises(SystemExit) as end:
        module.main([*(["--plant"] if module is evaluate else []), "own.py:Tanks", *arguments])
    assert end.value.code == 2
    text = "plant 'Tanks': episode_steps is -200; it must be a whole number, at least 1\n"
    assert capsys.readouterr().err.endswith(text)
    assert {path.name for path in tmp_path.iterdir()} <= {"own.py", "__pycache__"}


@pytest.mark.parametrize(
    ("field", "function", "text"),
    [
        ("output", lambda params, state: state.k, "output(params, state) gave int32[]; y must be one number"),
        ("output", lambda params, state: state.y[None], "output(params, state) gave float"),
        ("output", lambda params, state: (state.y,), "output(params, state) gave float"),
        ("output", lambda params, state: state.y.astype(jnp.float16), "output(params, state) gave float16[]"),
        ("output", lambda params, state: None, "output(params, state) gave None"),
        ("output", lambda params, state: "y", "output(params, state) failed: TypeError"),
        ("output", lambda params, state: float(state.y), "output(params, state) failed: ConcretizationTypeError"),
        ("noise_free", lambda params: None, "noise_free(params) returned"),
        ("reuse", lambda old, fresh: old.y, "reuse(old, fresh) returned"),
        ("members", lambda params, state: state.y, "members(params, state) gave float"),
        ("settled", lambda params, state, variables: variables, "settled(params, state, variables) returned"),
        ("draw", lambda params: params, "draw(key, params) failed: TypeError"),
    ],
)
def test_what_a_function_returns_is_refused_by_its_name(field, function, text):
    with pytest.raises(ValueError, match=re.escape(text)):
        interface.shapes(changed(**{field: function}), make()[1])
