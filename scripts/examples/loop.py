"""A slow closed loop as a plain function, to run an outer loop around in real time.

    python -m jaxouter.live scripts/examples/loop.py:step --run runs/loop --dt 0.02 --steps 3000
        --learn --r-tilde-bounds 0 10 --setpoint-range 2 6

For your own loop, write such a `step`: apply r~, and return the measured y. This one is simulated in plain Python: y
follows 1 + 0.7 r~ with a time constant of 15 periods and a dead time of 3, and the sensor is noisy.
"""

import random
from collections import deque

GAIN, OFFSET = 0.7, 1.0
LAG = 15.0  # periods
DEAD_TIME = 3  # periods
NOISE = 0.01  # standard deviation

noise = random.Random(0)
line = deque([3.0] * DEAD_TIME)  # delayed r~
level = OFFSET + GAIN * 3.0


def step(r_tilde):
    """One period with r~ applied; returns y at its end."""
    global level
    line.append(r_tilde)
    level += (OFFSET + GAIN * line.popleft() - level) / LAG
    return level + noise.gauss(0.0, NOISE)
