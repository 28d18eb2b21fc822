"""What can push the robot. Events in mid-episode are any physics factor with `.at(time)`."""

from __future__ import annotations

from simreal.factors import Target, target


def push_rate(body: str) -> Target:
    """Pushes per second on a body, at random times (1/s)."""
    return target("disturbance", "push_rate", (body,))


def push_impulse(body: str) -> Target:
    """Impulse of each push (N s), in a random horizontal direction, spread over one control period."""
    return target("disturbance", "push_impulse", (body,))
