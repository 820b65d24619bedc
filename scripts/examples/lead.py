"""Compare your own policy with the others.

    python -m jaxouter.compare pitch --policy scripts/examples/lead.py:Lead

Any class with `host`, `init` and `act` will do. It is constructed from the plant's declaration (bounds, units, control
step). This one is plain Python (`host = True`): a static gain with a lead, r~ = gain (r + lead (r - r filtered)).
"""


class Lead:
    """Overdrives each change of r for a while."""

    host = True

    def __init__(self, plant):
        self.low, self.high = plant.r_tilde_bounds
        self.gain = 3.0  # 1 / DC gain of the pitch plant
        self.lead = 0.3
        self.decay = 0.9  # of the filter, per control step

    def init(self, params, r0, y0):
        """The carry before the first step: the filtered reference."""
        return y0

    def act(self, params, carry, r, y, key=None):
        """One control step: from r and y, the next carry and r~."""
        filtered = self.decay * carry + (1.0 - self.decay) * r
        r_tilde = self.gain * (r + self.lead * (r - filtered))
        return filtered, min(max(r_tilde, self.low), self.high)
