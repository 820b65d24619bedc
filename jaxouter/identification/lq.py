"""The LQ law: the linear base law that suits a record of r~ and y best.

An ARX model of n lags is fitted by least squares as if y had been measured with more noise, and a linear-quadratic
regulator is made from it in velocity form: it moves r~ by r - y and by past moves of y and r~, and so needs no level.
Lags, noise and the price of moves are chosen by what the laws do on held-out episodes, replayed under
other r~ (`counterfactual`), with other set-points, noise and loads.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaxouter.identification import counterfactual
from jaxouter.identification.counterfactual import CounterfactualParams
from jaxouter.identification.records import Record
from jaxouter.identification.steady_state import IdentificationWarning
from jaxouter.loop import rewards
from jaxouter.loop.disturbances import Disturbances
from jaxouter.loop.episodes import TrainingEpisodes
from jaxouter.loop.policy import Linear, LinearLaw
from jaxouter.plants import Plant
from jaxouter.plants.base import excess

LAGS = (15, 30, 60)
NOISES = (2e-3, 6e-3, 2e-2, 6e-2)  # standard deviation in the fit; 1 is half the set-point range
PRICES = tuple(np.geomspace(1e-4, 100.0, 13).tolist())  # of a squared move, in squared errors; both in half ranges
EPISODES = 64  # on which the laws are compared
WITHIN = 1e-3  # share of steps outside the plant's limits that a law may have beyond those of the static prefilter
NOISIER = 0.5  # largest standard deviation of y at rest over that of measurement noise, where that is not known
MEAN_OF_NOISE = math.sqrt(2 / math.pi)  # mean of |x| over its standard deviation, x normal
REST = 0.1  # least share of a deviation that must die out in an episode
PLANTS = 8  # at most, at whose equilibria a law must come to rest
DOUBLINGS = 60  # at most: a horizon of 2^60 steps
Figure = Literal["mae", "return"]


class Settings(NamedTuple):
    """What is chosen."""

    lags: int
    noise: float
    price: float


class Choice(NamedTuple):
    """The law that was chosen, and what it is worth."""

    law: LinearLaw
    settings: Settings | None  # None: no LQ law counts, and it is the static prefilter
    mae: float  # on the record's own model
    static_mae: float  # of the static prefilter
    most: int | None  # lags that the record allows, where it is too short for more


def lags_for(plant: Plant, history: int) -> list[int]:
    """Numbers of lags to try: up to half an episode, and enough for the dead time that `history` holds."""
    most = max(1, plant.episode_steps // 2)
    return sorted({min(n, most) for n in (*LAGS, history) if n >= min(history, LAGS[0])})


def fits(data: Record, n: int, noises: Sequence[float], levels: bool = True) -> list[tuple[np.ndarray, np.ndarray]]:
    """ARX models y_(k+1) = sum_i a_i y_(k-i) + b_i r~_(k-i) + level of the episode, i from 0 to n - 1.

    Measurement noise that is independent from step to step adds its variance to the squares of each lag of y, and
    nothing else: so least squares on endlessly many noisy copies of a record are a ridge regression.

    Args:
        data: exciting episodes; samples that are not finite are left out.
        n: lags.
        noises: standard deviations of the noise, in the unit of y.
        levels: whether each episode has a level of its own, or all have the same.

    Returns:
        a and b, (n,) each, for each of the noises.
    """
    k = np.arange(n - 1, data.r_tilde.shape[1])
    past = k[:, None] - np.arange(n)
    rows = np.concatenate(
        [data.y[:, past], data.r_tilde[:, past], data.y[:, k + 1, None]], -1
    )  # (E, T - n + 1, 2 n + 1)
    known = np.isfinite(rows).all(-1, keepdims=True)
    rows = np.where(known, rows, 0.0)
    axes = 1 if levels else (0, 1)
    rows -= rows.sum(axes, keepdims=True) / np.maximum(known.sum(axes, keepdims=True), 1)
    rows = np.where(known, rows, 0.0).reshape(-1, 2 * n + 1)
    gram, count = rows.T @ rows, int(known.sum())
    found = []
    for noise in noises:
        noisy = gram[:-1, :-1] + np.diag(np.repeat([count * noise**2, 0.0], n))
        theta = np.linalg.lstsq(noisy, gram[:-1, -1], rcond=None)[0]
        found.append((theta[:n], theta[n:]))
    return found


def law(a: np.ndarray, b: np.ndarray, price: float) -> LinearLaw:
    """The LQ law of an ARX model: it minimises the sum of (y - r)^2 + price (move of r~)^2.

    The state is y - r and the model's own in observer canonical form, driven by moves of r~ and written out in past
    moves of y and r~.

    Args:
        a, b: (n,), see `fits`.
        price: in (unit of y / unit of r~)^2.
    """
    n = len(a)
    A, B, Q = np.zeros((n + 1, n + 1)), np.append(0.0, b)[:, None], np.zeros((n + 1, n + 1))
    A[1:, 1:] = np.eye(n, k=1)
    A[1:, 1] = a
    A[0], B[0] = A[1], B[1]
    A[0, 0] = Q[0, 0] = 1.0
    P = riccati(A, B, Q, price)
    K = np.linalg.solve(price + B.T @ P @ B, B.T @ P @ A)[0]
    of_y, of_r_tilde = np.append(K[1], K[2:] @ scipy.linalg.hankel(a[1:])), K[2:] @ scipy.linalg.hankel(b[1:])
    r_tilde_past = -np.diff(of_r_tilde, prepend=0.0, append=0.0)
    r_tilde_past[0] += 1.0
    return LinearLaw(np.zeros(()), K[0], -K[0], -np.diff(of_y, append=0.0), r_tilde_past)  # type: ignore[arg-type]


def law_for(plant: Plant, a: np.ndarray, b: np.ndarray, price: float) -> LinearLaw:
    """`law` with the price of a squared move in squared errors, both in half ranges of the plant, as in `PRICES`."""
    of_y, of_r_tilde = (float(np.ptp(each)) / 2 for each in (plant.setpoint_range, plant.r_tilde_bounds))
    return law(a, b, price * (of_y / of_r_tilde) ** 2)


def riccati(A: np.ndarray, B: np.ndarray, Q: np.ndarray, price: float) -> np.ndarray:
    """P of P = Q + A' P A - A' P B (price + B' P B)^-1 B' P A, by doubling the horizon.

    A tenth of the time of scipy's `solve_discrete_are`, and more where other processes work.

    Args:
        A, Q: (n, n).
        B: (n, 1).
        price: positive.

    Where no input can keep the sum finite, P is nan.

    The structure-preserving doubling algorithm; tested against scipy.
    """
    G, P, one = B @ B.T / price, Q, np.eye(len(A))
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(DOUBLINGS):
            AW, GW = np.hsplit(np.linalg.solve(one + G @ P, np.hstack([A, G])), 2)
            more = A.T @ P @ AW
            G, P, A = G + A @ GW @ A.T, P + more, A @ AW
            if not np.isfinite(P).all():
                return np.full_like(P, np.nan)
            if np.abs(more).max() <= 1e-12 * np.abs(P).max():
                break
    return P


def amplification(laws: LinearLaw, a: np.ndarray, b: np.ndarray, steps: int) -> np.ndarray:
    """Standard deviation of y over that of measurement noise, in the loop of each law with an ARX model.

    Args:
        laws: (G, ...), NumPy.
        a, b: of the model.
        steps: after which what is left of a measurement error counts no more.

    Returns:
        (G,), infinite where it grows without bound.
    """
    n = max(laws.y_past.shape[1], len(a))
    y, seen, r_tilde = np.zeros((3, len(laws.y_past), n + 1 + steps))  # of which the first n are the past
    seen[:, n] = 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(n, n + steps):
            past, applied = (each[:, k - laws.y_past.shape[1] : k][:, ::-1] for each in (seen, r_tilde))
            moved = np.einsum("gi,gi->g", laws.y_past, past - seen[:, k, None])
            r_tilde[:, k] = laws.y * seen[:, k] + moved + np.einsum("gi,gi->g", laws.r_tilde_past, applied)
            y[:, k + 1] = y[:, k + 1 - len(a) : k + 1][:, ::-1] @ a + r_tilde[:, k + 1 - len(b) : k + 1][:, ::-1] @ b
            seen[:, k + 1] = y[:, k + 1]
        total = np.sqrt(np.sum(y**2, 1))
    return np.where(np.isfinite(total), total, np.inf)


def radius(found: LinearLaw, a: np.ndarray, b: np.ndarray) -> float:
    """Spectral radius of the loop of a law with n lags and an ARX model (a, b) with m, at a held set-point."""
    n = max(len(found.y_past), len(a))
    y, r_tilde = np.zeros(n + 1), np.zeros(n)  # of y_k to y_(k-n), and of r~_(k-1) to r~_(k-n): the next r~
    y[0] = found.y - np.sum(found.y_past)
    y[1 : 1 + len(found.y_past)], r_tilde[: len(found.r_tilde_past)] = found.y_past, found.r_tilde_past
    chosen = np.concatenate([y, r_tilde])
    loop = np.zeros((2 * n + 1, 2 * n + 1))
    loop[0, : len(a)], loop[0, n + 1 : n + len(b)] = a, b[1:]
    loop[0] += b[0] * chosen
    loop[1 : n + 1, :n], loop[n + 1] = np.eye(n), chosen
    loop[n + 2 :, n + 1 : 2 * n] = np.eye(n - 1)
    return float(np.abs(np.linalg.eigvals(loop)).max())


def comes_to_rest(found: LinearLaw, a: np.ndarray, b: np.ndarray, steps: int) -> bool:
    """Whether a deviation at a held set-point dies out, and measurement noise moves y little; see `choose`."""
    alone = LinearLaw(*(np.asarray(each, np.float64)[None] for each in found))  # type: ignore[arg-type]
    return radius(found, a, b) <= 1.0 - REST / steps and amplification(alone, a, b, 2 * steps)[0] <= NOISIER


def choose(
    plant: Plant,
    data: Sequence[Record],
    static: LinearLaw,
    key: chex.PRNGKey,
    history: int,
    disturbances: Disturbances,
    figure: Figure = "mae",
    on: Any = None,
    models: Sequence[CounterfactualParams] | None = None,
    prices: Sequence[float] = PRICES,
    lags: Sequence[int] | None = None,
) -> Choice:
    """The best LQ law on held-out episodes of the records' own models.

    What the loudest noise adds to the mean |y| counts beside the MAE: few episodes have much noise, and a law that is
    best in the others may be useless there. A law counts if it stays within the plant's limits, up to 0.1 % of the
    steps more than the static prefilter, and if it comes to rest at a held set-point: a deviation dies out by a tenth
    or more in an episode.

    Args:
        plant: as declared; it is not simulated.
        data: exciting episodes of a plant, or of each of several; those that are not finite throughout count only in
            the fit.
        static: the static prefilter.
        key: of the episodes on which laws are compared.
        history: past samples that show the state of the plant and its dead time.
        disturbances: of these episodes.
        figure: what is best.
        on: parameters of the plant, to compare the laws on the plant itself, whatever they do with measurement noise;
            None: on the record's own model.
        models: other episodes on which they are compared than the last quarter of the record.
        prices: of moves, to choose from.
        lags: of the laws, to choose from; None: `lags_for` the plant.
    """
    whole = Record(*map(np.concatenate, zip(*data, strict=True)))
    steps, wanted = whole.r_tilde.shape[1], lags_for(plant, history) if lags is None else list(lags)
    tried = [n for n in wanted if n < steps and len(whole.y) * (steps - n) >= 4 * n] or [1]
    most = max(tried) if tried != wanted else None
    if models is None:
        fitted = min(history, max(1, steps // 2))
        models = [counterfactual.fit(each, fitted) for each in map(_finite, data) if len(each.y)]
        held_out = [jax.tree.map(lambda leaf: leaf[3 * len(leaf) // 4 :], model) for model in models]
    else:
        held_out = list(models)
    if not models:
        return Choice(static, None, np.inf, np.inf, most)
    noises = NOISES if on is None else (0.0, *NOISES)
    settings, laws = zip(*_candidates(plant, whole, tried, noises, prices), strict=True)
    numbers = LinearLaw(*map(np.stack, zip(*(_padded(each, max(tried)) for each in (static, *laws)), strict=True)))  # type: ignore[arg-type]
    together = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), numbers)
    if on is None:
        episodes = TrainingEpisodes(counterfactual.plant(plant, models[0].a.shape[1]), disturbances)
        replayed = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *held_out)
    else:
        episodes, replayed = TrainingEpisodes(plant, disturbances), on
    mae, reward, outside = (np.asarray(each, np.float64) for each in _compared(episodes, together, replayed, key))
    responses = [[np.asarray(each[0], np.float64) for each in (model.a, model.b)] for model in models[:PLANTS]]
    counts = np.isfinite(mae) & (outside <= outside[0] + WITHIN)
    cost, noise = mae if figure == "mae" else -reward, disturbances.noise * float(np.ptp(plant.setpoint_range)) / 2
    if noise:
        louder = np.max([amplification(numbers, a, b, 2 * steps) for a, b in responses], axis=0)
        cost = cost + (1.0 if figure == "mae" else rewards.PAPER.alpha_g) * MEAN_OF_NOISE * noise * louder
    order = np.argsort(np.where(counts, cost, np.inf)[1:], kind="stable")
    for i in order[: np.count_nonzero(counts[1:])]:
        if all(radius(laws[i], a, b) <= 1.0 - REST / plant.episode_steps for a, b in responses):
            return Choice(laws[i], settings[i], float(mae[1 + i]), float(mae[0]), most)
    return Choice(static, None, float(mae[0]), float(mae[0]), most)


def _padded(found: LinearLaw, lags: int) -> list[np.ndarray]:
    """The law's numbers, with zeros for further lags."""
    offset, r, y, *pasts = (np.asarray(each, np.float64) for each in found)
    return [offset, r, y, *(np.pad(each, (0, lags - len(each))) for each in pasts)]


def _finite(data: Record) -> Record:
    """The episodes that are finite throughout."""
    return Record(*(each[np.isfinite(data.y).all(1)] for each in data))


def warn_short(plant: Plant, most: int | None) -> None:
    """Warn that the record was too short for the lags that would have been tried."""
    if most is not None:
        text = f"{plant.name}: the record is too short for more than {most} lags; make episodes longer, or record more"
        warnings.warn(text, IdentificationWarning, stacklevel=3)


def _candidates(
    plant: Plant, data: Record, lags: Sequence[int], noises: Sequence[float], prices: Sequence[float]
) -> Iterator[tuple[Settings, LinearLaw]]:
    """The laws that are compared."""
    of_y = float(np.ptp(plant.setpoint_range)) / 2
    for n in lags:
        models = fits(data, n, [noise * of_y for noise in noises])
        for noise, (a, b) in zip(noises, models, strict=True):
            for price in prices:
                yield Settings(n, noise, price), law_for(plant, a, b, price)


@partial(jax.jit, static_argnums=0, compiler_options={"xla_backend_optimization_level": 1})
def _compared(
    episodes: TrainingEpisodes, laws: LinearLaw, params: Any, key: chex.PRNGKey
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """MAE, mean reward, and share of steps outside the limits, of each law (G, ...); each (G,).

    The MAE of an episode counts as the set-point range at most: where y may diverge, how often it does so counts.
    """
    policy, plant = Linear(episodes.plant.r_tilde_bounds), episodes.plant

    def one(law: LinearLaw, key: chex.PRNGKey) -> tuple[jax.Array, ...]:
        seen = episodes.run(policy, law, params, key)
        outside = excess(plant, seen.y[1:], seen.y[:-1]) > 0.0
        error = jnp.minimum(jnp.mean(jnp.abs(seen.r - seen.y)), float(np.ptp(plant.setpoint_range)))
        return error, jnp.mean(seen.reward), jnp.mean(jnp.where(outside, 1.0, 0.0))

    of_all = jax.vmap(jax.vmap(one, (None, 0)), (0, None))(laws, jax.random.split(key, EPISODES))
    mae, reward, outside = (jnp.mean(each, 1) for each in of_all)
    return mae, reward, outside
