"""Electric space heaters as a mean field (paper section IV).

Units: temperatures in degC, time in h, Ca in kWh/degC, Ua in kW/degC. The houses are an axis of the state; each
parameter of a house is one number for all or an array (n,).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxouter.plants.base import Plant, array

CONTROL_STEP = 1.0  # h
FEW = 16  # houses; with fewer, one draw per substep would be too short to fill vector registers
UFree = Literal["printed", "physical"]
Law = Literal["euler-maruyama", "hourly", "lumped"]


@struct.dataclass
class HouseParams:
    """One house and its local law; each a number or (n,). Symbols are the paper's."""

    Ca: jax.Array  # thermal mass of the air, kWh/degC
    Ua: jax.Array  # conductance to outside, kW/degC
    x_out: jax.Array  # outside temperature, degC
    sigma: jax.Array  # volatility, degC/sqrt(h)
    Pi: jax.Array  # feedback of the local law (the paper's Pi_a)
    r_u: jax.Array  # control weight (the paper's r)
    phi: jax.Array  # discount of the local law, 1/h (the paper's phi, 'delta' in its numbers)
    gamma: jax.Array  # weight of the mean field
    beta2: jax.Array  # 1/h (printed as beta_1)
    lambda1: jax.Array  # 1/h
    gain: jax.Array  # multiplies u
    disturbance: jax.Array  # added to u, kW


@struct.dataclass
class HeatersParams:
    """Parameters of the population; every array is traced, the number of temperatures is a shape."""

    house: HouseParams
    x0_mean: jax.Array  # mean temperature at the start, degC; a number or (n,)
    x0_spread: jax.Array  # houses start at x0_mean plus or minus this, degC
    weights: jax.Array  # (n,), y = sum of weights times temperatures; (1,) when lumped
    houses: jax.Array  # number of houses per temperature: 1, or all of them when lumped
    law: Law = struct.field(pytree_node=False)  # how the noise of an hour is drawn
    u_free: UFree = struct.field(pytree_node=False)
    substeps: int = struct.field(pytree_node=False)  # Euler-Maruyama steps per hour


class HeatersState(NamedTuple):
    """State of the population; when lumped, n is 1 and the temperature is the mean of all houses."""

    x: jax.Array  # (n,), air temperatures, degC
    x0: jax.Array  # (n,), temperatures at the start of the episode, degC
    k: jax.Array  # int32, hours since the start of the episode


def make(
    *,
    n: int = 4,
    law: Law = "euler-maruyama",
    x0_mean: Any = 19.25,
    x0_spread: float = 1.0,
    Ca: Any = 10.0,
    Ua: Any = 0.2,
    x_out: Any = -5.0,
    sigma: Any = 0.25,
    Pi: Any = 0.4,
    r_u: Any = 10.0,
    phi: Any = 0.001,
    gamma: Any = 0.6,
    beta2: Any = 0.038,
    lambda1: Any = -0.028,
    gain: Any = 1.0,
    disturbance: Any = 0.0,
    weights: Any = None,
    u_free: UFree = "printed",
    substeps: int = 10,
) -> tuple[Plant, HeatersParams]:
    """The space heaters and their parameters.

    Args:
        n: number of houses.
        law: how the noise of an hour is drawn. From a given start, y has the same distribution after each hour in all
            three. 'euler-maruyama' draws every substep of every house: the scheme itself. 'hourly' draws their sum
            over the hour at once, so `substeps` times fewer numbers: for many houses. 'lumped' simulates only the mean
            of n identical houses, at a cost independent of n: if only y matters. `members` is then this mean as one
            member, and x0_spread has no effect.
        x0_mean, x0_spread: houses start at x0_mean + U(-1, 1) x0_spread, recentred to the exact mean, degC.
        Ca, Ua, x_out, sigma, Pi, r_u, phi, gamma, beta2, lambda1: house and local law, see `HouseParams`; each one
            number for all houses or an array (n,). Pi = 0.4 is the paper's poorly tuned law, 17.186 the Riccati root.
        gain, disturbance: multiplies u; added to u, kW.
        weights: (n,), y is the mean under these; None: 1/n each.
        u_free: 'printed' is the paper's -(Ua/Ca)(x_out - x0). 'physical' is the power that holds x0, Ua (x0 - x_out);
            it needs Pi >= 17 (with a small Pi no r~ >= 0 reaches 15 degC).
        substeps: Euler-Maruyama steps per hour.

    Raises:
        ValueError: a shape is wrong, n or substeps is not positive, u_free does not fit Pi, or lumped houses differ.
    """
    for name, value in (("n", n), ("substeps", substeps)):
        if int(value) != value or value < 1:
            raise ValueError(f"{name} is {value}; it must be a whole number of at least 1")
    for name, value, allowed in (("u_free", u_free, get_args(UFree)), ("law", law, get_args(Law))):
        if value not in allowed:
            raise ValueError(f"{name} is {value!r}; it must be one of {', '.join(allowed)}")
    per_house = dict(
        Ca=Ca, Ua=Ua, x_out=x_out, sigma=sigma, Pi=Pi, r_u=r_u, phi=phi, gamma=gamma, beta2=beta2, lambda1=lambda1
    )
    per_house |= dict(gain=gain, disturbance=disturbance)
    lumped = law == "lumped"
    for name, value in (per_house | dict(x0_mean=x0_mean, weights=weights)).items():
        if lumped and np.shape(value):
            raise ValueError(
                f"{name} has shape {np.shape(value)}; law 'lumped' is for identical houses: "
                "give one number (weights: None), or take law 'hourly'"
            )
    house = HouseParams(**{name: array(name, value, (), (n,)) for name, value in per_house.items()})
    for name, lowest in (("Ca", 1e-6), ("r_u", 1e-6), ("sigma", 0.0)):
        if float(jnp.min(getattr(house, name))) < lowest:
            raise ValueError(f"{name} is {per_house[name]}; it must {'be positive' if lowest else 'not be negative'}")
    if u_free == "physical" and float(jnp.min(house.Pi)) < 17.0:
        raise ValueError(f"u_free 'physical' goes with Pi = 17.186 only; Pi is {Pi} (then no r~ >= 0 reaches 15 degC)")
    size = 1 if lumped else n
    shares = jnp.full(size, 1.0 / size) if weights is None else array("weights", weights, (size,))
    if not float(jnp.sum(shares)) > 0.0:
        raise ValueError(f"weights are {weights}; their sum must be positive")
    params = HeatersParams(
        house=house,
        x0_mean=array("x0_mean", x0_mean, (), (n,)),
        x0_spread=array("x0_spread", x0_spread, ()),
        weights=shares,
        houses=array("n", n / size, ()),
        law=law,
        u_free=u_free,
        substeps=substeps,
    )
    return HEATERS, params


def init(key: chex.PRNGKey, params: HeatersParams) -> HeatersState:
    """The houses at their given temperatures: x0_mean + U(-1, 1) x0_spread, recentred so that y is exact."""
    offsets = jax.random.uniform(key, params.weights.shape, params.weights.dtype, -1.0, 1.0) * params.x0_spread
    centre = jnp.sum(params.weights * offsets) / jnp.sum(params.weights)
    return _state(params.x0_mean + (offsets - centre))


def start(key: chex.PRNGKey, params: HeatersParams) -> HeatersState:
    """A training start: a mean uniform in 15..25 degC, each house within 1 degC of it.

    When lumped, the mean of the n houses' deviations is drawn as a normal number of the same variance, within 1 degC.
    """
    key_mean, key_house = jax.random.split(key)
    shape, dtype = params.weights.shape, params.weights.dtype
    if params.law == "lumped":
        offsets = jnp.clip(jax.random.normal(key_house, shape, dtype) / jnp.sqrt(3.0 * params.houses), -1.0, 1.0)
    else:
        offsets = jax.random.uniform(key_house, shape, dtype, -1.0, 1.0)
    return _state(jax.random.uniform(key_mean, (), dtype, 15.0, 25.0) + offsets)


def _state(x0: jax.Array) -> HeatersState:
    return HeatersState(x=x0, x0=x0, k=jnp.zeros((), jnp.int32))


def output(params: HeatersParams, state: HeatersState) -> jax.Array:
    """y, the weighted mean of the temperatures, degC."""
    return jnp.sum(params.weights * state.x)


def members(params: HeatersParams, state: HeatersState) -> jax.Array:
    """Temperatures of the individual houses (n,), degC; when lumped, their mean (1,)."""
    del params
    return state.x


def drift(
    p: HouseParams, x: jax.Array, x0: jax.Array, decay: jax.Array, r_tilde: jax.Array, u_free: UFree
) -> jax.Array:
    """Deterministic part of dx/dt of the houses under their local law, degC/h; `decay` is exp(lambda1 t).

    Source: paper section IV, x* = r~ in both terms.
    """
    s_inf = r_tilde / (-p.Ua / p.Ca - p.Pi / (p.Ca**2 * p.r_u) - p.phi)
    s = s_inf + p.gamma / (p.beta2 - p.lambda1) * decay * (r_tilde - x0)
    u = -p.gain / (p.Ca * p.r_u) * (p.Pi * x + s) + p.disturbance
    held = p.Ua / p.Ca if u_free == "printed" else p.Ua  # power that holds x0, per degC
    return 1.0 / p.Ca * (-p.Ua * (x - p.x_out) + u + held * (x0 - p.x_out))


def step(params: HeatersParams, state: HeatersState, r_tilde: jax.Array, key: chex.PRNGKey) -> HeatersState:
    """One hour with r~ (scalar, degC) held: Euler-Maruyama, one Wiener process per house.

    The scheme is x_(i+1) = a x_i + h b_i + sigma h^(1/2) w_i, and b_i is affine in exp(lambda1 t_i). So the m substeps
    equal one step of length h sum a^(m-1-i), at the mean of exp(lambda1 t_i) under these weights, plus their noise.
    """
    chex.assert_rank([state.x, r_tilde], [1, 0])
    p, m, n = params.house, params.substeps, state.x.size
    h = CONTROL_STEP / m
    a = 1.0 - h / p.Ca * (p.Ua + p.gain * p.Pi / (p.Ca * p.r_u))
    ones, per_substep = [1.0] * m, jnp.exp(p.lambda1 * h)
    steps = _left(a, ones)
    decay = jnp.exp(p.lambda1 * (state.k.astype(state.x.dtype) * CONTROL_STEP))
    decay = decay * _left(a, [per_substep**i for i in range(m)]) / steps
    if params.law == "euler-maruyama":
        # Both shapes give the same numbers; rows of many houses can be split over devices.
        w = jax.random.normal(key, (m, n) if n >= FEW else (m * n,), state.x.dtype)
        noise = _left(a, list(w.reshape(m, n)))
    else:
        noise = jnp.sqrt(_left(a**2, ones)) * jax.random.normal(key, (n,), state.x.dtype)
    x = state.x + h * steps * drift(p, state.x, state.x0, decay, r_tilde, params.u_free)
    return HeatersState(x + p.sigma * jnp.sqrt(h / params.houses) * noise, state.x0, state.k + 1)


def _left(a: jax.Array, terms: Sequence[Any]) -> Any:
    """What remains after m substeps of a term added in each: the sum of a^(m-1-i) terms_i."""
    total = terms[0]
    for term in terms[1:]:
        total = a * total + term
    return total


def variables(params: HeatersParams, state: HeatersState) -> HeatersState:
    """The temperatures; the starting temperatures are constants."""
    del params
    return state._replace(x0=None, k=None)


def settled(params: HeatersParams, state: HeatersState, variables: HeatersState) -> HeatersState:
    """These temperatures when exp(lambda1 t) has died out."""
    del params
    return state._replace(x=variables.x, k=jnp.full_like(state.k, 2**30))


def noise_free(params: HeatersParams) -> HeatersParams:
    """The same houses with sigma 0."""
    house = dataclasses.replace(params.house, sigma=jnp.zeros_like(params.house.sigma))
    return dataclasses.replace(params, house=house)


HEATERS = Plant(
    name="heaters",
    init=init,
    step=step,
    output=output,
    start=start,
    members=members,
    variables=variables,
    settled=settled,
    noise_free=noise_free,
    affine=True,
    y_unit="degC",
    time_unit="h",
    control_step=CONTROL_STEP,
    episode_steps=200,
    r_tilde_bounds=(0.0, 40.0),
    setpoint_range=(15.0, 25.0),
    evaluation_range=(15.0, 25.0),
    divergence_bounds=(-20.0, 60.0),
    rate_limit=1.0,
    move_threshold=1.0,
    error_scale=1.0,
    history=5,
    families=("steps", "staircase", "ramps", "days"),
    family_steps=200,
)
