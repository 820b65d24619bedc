"""The room of `room.py` with a reward term of its own: a price on the square of each move of r~."""

from dataclasses import replace

from tests.additions import room


def gentle(r, y, y_before, r_tilde, r_tilde_before):
    return -0.05 * (r_tilde - r_tilde_before) ** 2


def make(tau=3.0, outside=0.0):
    plant, params = room.make(tau, outside)
    return replace(plant, reward_terms=(gentle,)), params


Gentle = replace(room.Room, make=make)
