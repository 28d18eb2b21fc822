"""What can vary between the true state and what the policy is told. See `simreal.sensors` for the formulas.

Sensors are addressed by the names of the environment's readings; a reading of several numbers has channels
`name[0]`, `name[1]`, ..., and its bare name addresses them all.
"""

from __future__ import annotations

from simreal.factors import Target, target


def noise(*readings: str) -> Target:
    """Standard deviation of white noise, drawn anew each control step (unit of the reading)."""
    return target("sensor", "noise", readings)


def bias(*readings: str) -> Target:
    """Constant offset over an episode (unit of the reading)."""
    return target("sensor", "bias", readings)


def drift(*readings: str) -> Target:
    """Standard deviation of a random walk after one second (unit per square root of a second)."""
    return target("sensor", "drift", readings)


def scale(*readings: str) -> Target:
    """Scale error: what is reported is scale times the true value."""
    return target("sensor", "scale", readings)


def delay(*readings: str) -> Target:
    """Age of what is reported (s)."""
    return target("sensor", "delay", readings)


def rate(*readings: str) -> Target:
    """Samples per second (Hz), held in between; 0 samples at every control step."""
    return target("sensor", "rate", readings)


def quantization(*readings: str) -> Target:
    """Smallest step that is resolved (unit of the reading)."""
    return target("sensor", "quantization", readings)


def dropout(*readings: str) -> Target:
    """Probability, at each control step, that the last value is repeated."""
    return target("sensor", "dropout", readings)


def burst_rate(*readings: str) -> Target:
    """Bursts of dropout per second; see `burst_duration`."""
    return target("sensor", "burst_rate", readings)


def burst_duration(*readings: str) -> Target:
    """Mean duration of a burst of dropout (s)."""
    return target("sensor", "burst_duration", readings)
