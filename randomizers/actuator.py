"""What can vary between the policy's command and the torque. See `simreal.actuators` for the formulas."""

from __future__ import annotations

from simreal.factors import Target, target


def gain(*actuators: str) -> Target:
    """Motor strength: scale of the whole force of an actuator (`times`)."""
    return target("physics", "gain", actuators)


def delay(*actuators: str) -> Target:
    """Transport delay of commands (s)."""
    return target("actuator", "delay", actuators)


def lag(*actuators: str) -> Target:
    """Time constant of a first-order lag of commands (s)."""
    return target("actuator", "lag", actuators)


def deadband(*actuators: str) -> Target:
    """Half-width of the band about zero in which a command does nothing (control unit)."""
    return target("actuator", "deadband", actuators)


def saturation(*actuators: str) -> Target:
    """Share of the control range that can be reached (0 to 1)."""
    return target("actuator", "saturation", actuators)


def backlash(*actuators: str) -> Target:
    """Full width of the play in a position actuator's gear (control unit: rad)."""
    return target("actuator", "backlash", actuators)


def no_load_speed(*actuators: str) -> Target:
    """Speed at which no torque is left in the driving direction (rad/s); infinite without."""
    return target("actuator", "no_load_speed", actuators)


def thermal_limit(*actuators: str) -> Target:
    """Continuous force (N m): above it the motor heats up until its peak force is derated."""
    return target("actuator", "thermal_limit", actuators)


def thermal_time(*actuators: str) -> Target:
    """Thermal time constant (s)."""
    return target("actuator", "thermal_time", actuators)


def initial_heat(*actuators: str) -> Target:
    """Heat at the start of the episode: 0 cold, 1 as warm as after a long time at `thermal_limit`."""
    return target("actuator", "initial_heat", actuators)


def noise(*actuators: str) -> Target:
    """Standard deviation of white noise on commands (control unit)."""
    return target("actuator", "noise", actuators)


def correlated_noise(*actuators: str) -> Target:
    """Stationary standard deviation of noise correlated in time (control unit); see `correlation_time`."""
    return target("actuator", "correlated_noise", actuators)


def correlation_time(*actuators: str) -> Target:
    """Correlation time of `correlated_noise` (s)."""
    return target("actuator", "correlation_time", actuators)


def period_jitter() -> Target:
    """Mean extra length of each control period, as a share of it; each is drawn from an exponential."""
    return target("actuator", "period_jitter")
