"""What can vary in the physics.

    body_mass("pole").times(LogUniform(0.7, 1.4))      # one draw for all addressed elements
    kp("*").times(Uniform(0.95, 1.05)).each()          # one draw for each motor
    friction("floor").set(Uniform(0.2, 0.4)).at(Uniform(2, 8))   # slips in mid-episode

Elements are addressed by their names in the model, or by patterns over them.
"""

from __future__ import annotations

from simreal.errors import UserError
from simreal.factors import Target, target


def body_mass(*bodies: str, inertia: bool = True) -> Target:
    """Mass of bodies (kg); their inertia scales with it unless `inertia=False`."""
    return target("physics", "body_mass", bodies, inertia=inertia)


def body_inertia(*bodies: str) -> Target:
    """Scale of the principal moments of inertia of bodies (`times` only, so that they stay possible)."""
    return target("physics", "body_inertia", bodies)


def body_com(*bodies: str, axis: str = "x") -> Target:
    """Centre of mass of bodies along one axis of the body frame (m)."""
    if axis not in ("x", "y", "z"):
        raise UserError(f"body_com: axis {axis!r}; valid: x, y, z")
    return target("physics", "body_com", bodies, axis=axis)


def friction(*geoms: str) -> Target:
    """Sliding friction coefficient of geoms. Where geoms differ in priority, only the higher one's counts."""
    return target("physics", "friction", geoms)


def joint_damping(*joints: str) -> Target:
    """Viscous damping of joints (N m s/rad, or N s/m)."""
    return target("physics", "joint_damping", joints)


def friction_loss(*joints: str) -> Target:
    """Dry friction of joints (N m, or N)."""
    return target("physics", "friction_loss", joints)


def armature(*joints: str) -> Target:
    """Rotor inertia reflected to the joint (kg m2)."""
    return target("physics", "armature", joints)


def stiffness(*joints: str) -> Target:
    """Spring stiffness of joints (N m/rad)."""
    return target("physics", "stiffness", joints)


def joint_range(*joints: str, end: str = "width") -> Target:
    """Range of joints (rad or m): half its width about the centre, or one `end` of it ("low" or "high")."""
    return target("physics", "joint_range", joints, end=end)


def gravity() -> Target:
    """Magnitude of gravity (m/s2)."""
    return target("physics", "gravity")


def gravity_tilt(axis: str = "x") -> Target:
    """Tilt of the floor about a horizontal axis (rad), applied as the opposite turn of gravity."""
    if axis not in ("x", "y"):
        raise UserError(f"gravity_tilt: axis {axis!r}; valid: x, y")
    return target("physics", "gravity_tilt", axis=axis)


def kp(*actuators: str) -> Target:
    """Position gain of servo actuators; `biasprm[1]` follows, so that the set-point stays."""
    return target("physics", "kp", actuators)


def kv(*actuators: str) -> Target:
    """Velocity gain (damping) of servo actuators."""
    return target("physics", "kv", actuators)


def force_limit(*actuators: str) -> Target:
    """Largest force or torque of actuators; the lower end scales with the upper."""
    return target("physics", "force_limit", actuators)


def geom_size(*geoms: str) -> Target:
    """Scale of all dimensions of primitive geoms (`times` only); bounding volumes follow."""
    return target("physics", "geom_size", geoms)


def joint_reference(*joints: str) -> Target:
    """Offset of a hinge's or slide's zero (rad or m): the encoder's zero is not where the model has it."""
    return target("physics", "joint_reference", joints)
