"""The pitch plant with its observation and reward as a Gymnasium environment in plain NumPy: what the peers step.

The nominal plant only (d1 = d2 = 0, tau = 0.5 s): K1 and K2 fold into the matrix of the linear part, and the delay is
five whole control steps, so a control step is one 16 x 17 product. `check.py` compares it with jaxouter's environment.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

CONTROL_STEP, SUBSTEPS, DELAY = 0.1, 10, 5  # s; inner steps a control step; tau in control steps
EPISODE = 200  # control steps
HISTORY = 15  # past samples of y and of r~ in the observation
INTEGRAL_STEPS = EPISODE / 4  # time constant of the leaky integral, in control steps
R_TILDE_BOUND, SETPOINT_BOUND, OUTPUT_LIMIT, DIVERGENCE = 60.0, 17.0, 18.0, 60.0  # crad, of the absolute value
MOVE_THRESHOLD = 3.5  # crad; moves of r~ and y from this size on are charged
START_SPREAD = (1.0, 1.0, 0.5, 5.0)  # ft/s, ft/s, crad/s, crad

A = [[-0.003, 0.039, 0.0, -0.322], [-0.065, -0.319, 7.740, 0.0], [0.020, -0.101, -0.429, 0.0], [0.0, 0.0, 1.0, 0.0]]
B = np.array([0.010, -0.180, -1.160, 0.0])
W = (0.1, 0.003, -0.003)
A_h, B_h, C_h, D_h = -0.2, 1.0, 0.08, 0.1  # pilot
K1, K2 = np.array([-0.02014198, 0.07273815, -0.79113165, -1.26381637]), -0.5  # LQR


def control_step_matrix() -> np.ndarray:
    """One control step of the closed loop, (16, 17), exact for inputs held over each inner step.

    From [x (4); xc; xi; theta_e as the pilot sees it in each of the 10 inner steps; 1] to [x; xc; xi] at the end and
    theta in the middle of each inner step.

    Source: paper section III.
    """
    F = np.zeros((8, 8))  # of [x; xc; xi; delayed theta_e; 1]
    F[:4, :4] = np.array(A) + np.outer(B, np.array([W[1], W[2], 0.0, 0.0]) - K1)
    F[:4, 4], F[:4, 7] = -B * K2, B * W[0]
    F[4, 3], F[4, 5], F[4, 6] = 1.0, -C_h, -D_h
    F[5, 5], F[5, 6] = A_h, B_h
    inner = np.eye(8)
    for order in range(10, 0, -1):  # the exponential's series, to double precision for a step this short
        inner = np.eye(8) + F @ inner * (CONTROL_STEP / SUBSTEPS / order)
    z, middles = np.eye(6, 7 + SUBSTEPS), []
    for i in range(SUBSTEPS):
        before, z = z, inner[:6, :6] @ z
        z[:, 6 + i] += inner[:6, 6]
        z[:, -1] += inner[:6, 7]
        middles.append((before[3] + z[3]) / 2)
    return np.vstack([z, middles])


class Pitch(gymnasium.Env[np.ndarray, np.ndarray]):
    """Pitch control on the training distribution: the action is r~ (crad), the observation has 33 numbers."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3 + 2 * HISTORY,), np.float32)
    action_space = gymnasium.spaces.Box(-R_TILDE_BOUND, R_TILDE_BOUND, (1,), np.float32)

    def __init__(self) -> None:
        self.matrix = control_step_matrix()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A new episode; `options` may fix "x" (4,) and "r" (crad), else both are drawn.

        Returns:
            obs (33,) float32, and no info.
        """
        super().reset(seed=seed)
        drawn = {
            "x": self.np_random.uniform(-1.0, 1.0, 4) * START_SPREAD,
            "r": self.np_random.uniform(-SETPOINT_BOUND, SETPOINT_BOUND),
        }
        start = drawn | (options or {})
        self.k = 0
        self.input = np.zeros(self.matrix.shape[1])
        self.input[:4], self.input[-1] = start["x"], 1.0
        self.line = np.zeros((DELAY, SUBSTEPS))  # theta_e of the last control steps, a ring
        self.r, self.y, self.integral = float(start["r"]), float(self.input[3]), 0.0
        self.r_tilde = min(max(self.y, -R_TILDE_BOUND), R_TILDE_BOUND)
        # Histories of a whole episode, newest first, as seen: what lies behind the start is constant.
        self.y_past = np.full(EPISODE + HISTORY, self.y / SETPOINT_BOUND, np.float32)
        self.r_tilde_past = np.full(EPISODE + HISTORY, self.r_tilde / R_TILDE_BOUND, np.float32)
        return self.observation(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control step with r~ = `action` (1,), crad, clipped to its bounds."""
        r_tilde = min(max(float(action[0]), -R_TILDE_BOUND), R_TILDE_BOUND)
        seen = self.line[self.k % DELAY]
        self.input[6:-1] = seen
        after = self.matrix @ self.input
        self.input[:6] = after[:6]
        np.subtract(r_tilde, after[6:], out=seen)
        y = float(after[3])
        terminated = not -DIVERGENCE <= y <= DIVERGENCE  # so that NaN counts as divergence
        if terminated:
            y = -DIVERGENCE if y < 0 else DIVERGENCE
        reward = self.reward(y, r_tilde) - (50.0 if terminated else 0.0)

        self.k += 1
        self.y_past[EPISODE - self.k] = self.y / SETPOINT_BOUND
        self.r_tilde_past[EPISODE - self.k] = r_tilde / R_TILDE_BOUND
        self.y, self.r_tilde = y, r_tilde
        return self.observation(), reward, terminated, self.k >= EPISODE, {}

    def reward(self, y: float, r_tilde: float) -> float:
        """R = G(e) + H(r~) + B(y) of the step that ends at `y` (paper eq. 1)."""
        delta_y, delta_r_tilde = abs(y - self.y), abs(r_tilde - self.r_tilde)
        return (
            -0.3 * abs(self.r - y)
            - (0.1 * delta_r_tilde if delta_r_tilde >= MOVE_THRESHOLD else 0.0)
            - (0.1 * delta_y if delta_y >= MOVE_THRESHOLD else 0.0)
            - max(0.0, abs(y) - OUTPUT_LIMIT)
        )

    def observation(self) -> np.ndarray:
        """[r, r - y, leaky integral, past y minus y, past r~], scaled; integrates r - y."""
        error, first = self.r - self.y, EPISODE - self.k
        self.integral += (error - self.integral) / INTEGRAL_STEPS
        obs = np.empty(3 + 2 * HISTORY, np.float32)
        obs[0], obs[1], obs[2] = self.r / SETPOINT_BOUND, error / SETPOINT_BOUND, self.integral / SETPOINT_BOUND
        np.subtract(self.y_past[first : first + HISTORY], self.y / SETPOINT_BOUND, out=obs[3 : 3 + HISTORY])
        obs[3 + HISTORY :] = self.r_tilde_past[first : first + HISTORY]
        return obs
