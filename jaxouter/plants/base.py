"""The plant interface: three pure functions on one unbatched plant, and a declaration of its numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import chex
import jax
import jax.numpy as jnp

from jaxouter.plants import declaration

RUN_ONCE = {"xla_backend_optimization_level": 0}  # compiler options for code that compiles longer than it runs
MOVE = 0.03  # default move threshold as share of the range of r~, like pitch's 3.5 of 120


def float_leaves(params: Any, state: Any) -> list[jax.Array]:
    """The default of `Plant.variables`: every float leaf of the state."""
    del params
    return [leaf for leaf in jax.tree.leaves(state) if _is_float(leaf)]


def with_float_leaves(params: Any, state: Any, variables: list[jax.Array]) -> Any:
    """The default of `Plant.settled`: the state with these float leaves, the rest as in `state`."""
    del params
    leaves, structure = jax.tree.flatten(state)
    given = iter(variables)
    return jax.tree.unflatten(structure, [next(given) if _is_float(leaf) else leaf for leaf in leaves])


def _is_float(leaf: jax.Array) -> bool:
    return jnp.issubdtype(leaf.dtype, jnp.floating)


@dataclass(frozen=True)
class Plant:
    """A plant with its inner loop, seen from outside: r~ goes in, y comes out.

    The functions are pure and work on one unbatched plant; callers vmap. Parameters and state are pytrees; parameters
    are always traced. Rewards, observation scaling and evaluation families derive from the declared numbers.
    """

    name: str
    init: Callable[[chex.PRNGKey, Any], Any]
    """`init(key, params) -> state`: the plant at rest (heaters: at the given temperatures)."""
    step: Callable[[Any, Any, jax.Array, chex.PRNGKey], Any]
    """`step(params, state, r_tilde, key) -> state`: one control step with r~ (scalar) held."""
    output: Callable[[Any, Any], jax.Array]
    """`output(params, state) -> y`, scalar."""

    y_unit: str
    time_unit: str
    control_step: float
    """Length of one control step, in `time_unit`."""
    episode_steps: int
    r_tilde_bounds: tuple[float, float]
    """Least and largest r~, in `y_unit`."""
    setpoint_range: tuple[float, float]
    """Set-points of the training distribution (paper section II)."""
    evaluation_range: tuple[float, float] = ()  # type: ignore[assignment]
    """Set-points of the evaluation families; default: those of training."""
    divergence_bounds: tuple[float, float] = ()  # type: ignore[assignment]
    """Training ends an episode when y leaves these; default: twice the range of r~ beyond each of its ends."""
    output_limit: float | None = None
    """|y| must not exceed this (the paper's L on pitch)."""
    rate_limit: float | None = None
    """|y_(k+1) - y_k| must not exceed this (the paper's L on heaters)."""
    move_threshold: float | None = None
    """Moves of r~ and of y of at least this size are charged (the paper's rho_h and rho_b); default: 3 % of the range
    of r~, inf: none. If moves are free, the learned r~ may jump to and fro between its bounds."""
    error_scale: float = 0.0
    """Error that counts as 1 for the learner, in `y_unit`. Costs, the price of divergence and tolerances are relative
    to it, so that no result depends on the unit; 0: a twentieth of the set-point range."""
    history: int | None = None
    """Past samples of y and r~ in the observation; None: training chooses by the dead time that it identifies."""
    families: tuple[str, ...] = ("steps", "staircase", "ramps")
    """Reference families of the evaluation, by name in `jaxouter.loop.references`."""
    family_steps: int = 600
    """Length of a family member in control steps (`steps`: one episode)."""

    differentiable: bool = True
    """Whether its functions are differentiable; `oracle` and the stability analysis need it."""
    affine: bool = False
    """Whether y is affine in r~ with additive noise along any episode; `clairvoyant` needs it."""
    start: Callable[[chex.PRNGKey, Any], Any] | None = None
    """`start(key, params) -> state`: a random start of a training episode; None: `init`."""
    draw: Callable[[chex.PRNGKey, Any], Any] | None = None
    """`draw(key, params) -> params`: parameters of a training episode (domain randomisation); None: the given ones."""
    identified: bool = False
    """Whether it is a model identified from a record, not the plant itself. A learner may then use its equations, as
    that costs no experiments on the plant."""
    reuse: Callable[[Any, Any], Any] = lambda old, fresh: fresh
    """`reuse(old, fresh) -> state`: the fresh state, but with those arrays of the old one that need not be cleared at a
    reset (delay lines). It saves a copy."""
    reward_terms: tuple[Callable[..., jax.Array], ...] = ()
    """Functions `term(r, y, y_before, r_tilde, r_tilde_before) -> reward` of scalars, added to the reward that is
    trained on; see `jaxouter.loop.rewards.reward`. Metrics name each by its function's name."""
    members: Callable[[Any, Any], jax.Array] | None = None
    """`members(params, state) -> (n,)`: the individual outputs of which y is a weighted mean; None: there are none."""

    variables: Callable[[Any, Any], Any] = float_leaves
    """`variables(params, state) -> pytree of floats`: the state variables in time-invariant form: delay lines from the
    oldest to the newest sample; no clocks, keys or constants of the episode."""
    settled: Callable[[Any, Any, Any], Any] = with_float_leaves
    """`settled(params, state, variables) -> state`, the inverse of `variables`: the state with these variables and the
    constants of `state`, long after the start (t to infinity), when no step depends on a clock any more."""
    noise_free: Callable[[Any], Any] = lambda params: params
    """`noise_free(params) -> params`: the same plant without noise."""
    smallest: Callable[[Any], Any] = lambda params: params
    """`smallest(params) -> params`: the same plant with the smallest state it needs; params are not traced."""
    widened: Callable[[Any, Mapping[str, tuple[float, float]]], Any] = lambda params, ranges: params
    """`widened(params, ranges) -> params`: the same plant, able to take any parameters in these ranges."""

    def __post_init__(self) -> None:
        self._take("r_tilde_bounds", "setpoint_range")
        low, high = self.r_tilde_bounds
        beyond = 2 * (high - low)
        if isinstance(self.error_scale, int | float) and self.error_scale == 0:
            object.__setattr__(self, "error_scale", (self.setpoint_range[1] - self.setpoint_range[0]) / 20)
        defaults = {
            "move_threshold": MOVE * (high - low),
            "evaluation_range": self.setpoint_range,
            "divergence_bounds": (low - beyond, high + beyond),
        }
        for field, value in defaults.items():
            given = getattr(self, field)
            if given is None or (isinstance(given, tuple) and not given):
                object.__setattr__(self, field, value)
        self._take(*declaration.PLANT)
        if (self.variables is float_leaves) != (self.settled is with_float_leaves):
            raise ValueError(f"plant {self.name!r}: variables and settled are inverse; declare both or neither")

    def _take(self, *fields: str) -> None:
        """Check and normalise these fields."""
        for field in fields:
            value = declaration.checked(declaration.PLANT[field], f"plant {self.name!r}: {field}", getattr(self, field))
            object.__setattr__(self, field, value)

    def training_start(self, key: chex.PRNGKey, params: Any) -> Any:
        """State at the start of a training episode."""
        return (self.start or self.init)(key, params)


def in_words(unit: str, form: str = " {}") -> str:
    """A unit within a text, such as ' crad', or ' in crad' by another form; '' for that of plain numbers, '' or '1'."""
    return "" if unit in ("", "1") else form.format(unit)


def parameters(params: Any, change: tuple[jax.Array, Any] | None, k: jax.Array) -> Any:
    """The plant's parameters at step k; from step `change[0]` on they are `change[1]`."""
    if change is None:
        return params
    at, after = change
    return jax.tree.map(lambda a, b: jnp.where(k >= at, a, b), after, params)


def outputs(
    plant: Plant,
    params: Any,
    state: Any,
    r_tilde: jax.Array,
    keys: chex.PRNGKey,
    change: tuple[jax.Array, Any] | None = None,
) -> jax.Array:
    """Y (T,) after each control step of the plant alone.

    Args:
        plant, params, state: unbatched.
        r_tilde: (T,), each held for one control step.
        keys: (T,).
        change: see `parameters`.
    """

    def step(state: Any, x: tuple[jax.Array, jax.Array, chex.PRNGKey]) -> tuple[Any, jax.Array]:
        k, r_tilde_k, key = x
        now = parameters(params, change, k)
        state = plant.step(now, state, r_tilde_k, key)
        return state, plant.output(now, state)

    return jax.lax.scan(step, state, (jnp.arange(r_tilde.shape[0]), r_tilde, keys))[1]


def array(name: str, value: Any, *shapes: tuple[int, ...]) -> jax.Array:
    """`value` as float array (float32, or float64 under x64) of one of `shapes`.

    Raises:
        ValueError: names the field, the shape got and the shapes allowed.
    """
    allowed = " or ".join("a number" if not s else f"an array of shape {s}" for s in shapes)
    try:
        out = jnp.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(f"{name} is {value!r}; it must be {allowed}") from None
    if out.shape not in shapes:
        raise ValueError(f"{name} has shape {out.shape}; it must be {allowed}")
    return out


def excess(plant: Plant, y: jax.typing.ArrayLike, y_before: jax.typing.ArrayLike) -> jax.Array:
    """By how much y (any shape) is outside the plant's limits; at most 0 where inside."""
    y, y_before = jnp.asarray(y), jnp.asarray(y_before)
    over = jnp.full_like(y, -jnp.inf)
    if plant.output_limit is not None:
        over = jnp.maximum(over, jnp.abs(y) - plant.output_limit)
    if plant.rate_limit is not None:
        over = jnp.maximum(over, jnp.abs(y - y_before) - plant.rate_limit)
    return over
