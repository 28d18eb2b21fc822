"""The typed table of physical quantities that may vary: which elements, which model fields, which limits.

Each entry turns nominal model fields into varied ones for one world. What must be recomputed afterwards
follows from the fields (`simreal.constants`). `simreal.randomizers.physics` is the vocabulary over this
table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

Fields = dict[str, jax.Array]
Change = Callable[[jax.Array], jax.Array]
"""Applies a factor's operation and draw to an array whose first axis runs over the elements."""
Apply = Callable[[Fields, Change, dict[str, Any]], Fields]


@dataclass(frozen=True)
class Quantity:
    """One row of the table."""

    element: str
    """body, geom, joint, dof, actuator or option: whose names address it."""
    fields: tuple[str, ...]
    """Model fields that it changes (before derived constants)."""
    unit: str
    apply: Apply
    operations: tuple[str, ...] = ("times", "plus", "set")
    lowest: float = -np.inf
    """The value after the operation may not be below this (or not at it, with `strict`)."""
    strict: bool = False


def _scalar(field: str, column: int | None = None) -> Apply:
    """Changes a field of one number per element, or one column of it."""

    def apply(fields: Fields, change: Change, options: dict[str, Any]) -> Fields:
        values = fields[field]
        if column is None:
            return {field: change(values)}
        changed = change(values[:, column])
        return {field: jnp.where(np.arange(values.shape[1]) == column, changed[:, None], values)}

    return apply


def _body_mass(fields: Fields, change: Change, options: dict[str, Any]) -> Fields:
    mass = change(fields["body_mass"])
    if not options.get("inertia", True):
        return {"body_mass": mass}
    nominal = fields["body_mass"]
    ratio = mass / jnp.where(nominal > 0, nominal, 1)
    return {"body_mass": mass, "body_inertia": fields["body_inertia"] * ratio[:, None]}


def _rows(*names: str) -> Apply:
    """Scales all columns of the fields by what the operation does to 1."""

    def apply(fields: Fields, change: Change, options: dict[str, Any]) -> Fields:
        ratio = change(jnp.ones(fields[names[0]].shape[0], fields[names[0]].dtype))
        return {name: fields[name] * ratio.reshape((-1,) + (1,) * (fields[name].ndim - 1)) for name in names}

    return apply


def _body_com(fields: Fields, change: Change, options: dict[str, Any]) -> Fields:
    return _scalar("body_ipos", "xyz".index(options["axis"]))(fields, change, options)


def _kp(fields: Fields, change: Change, options: dict[str, Any]) -> Fields:
    gain, bias = fields["actuator_gainprm"], fields["actuator_biasprm"]
    changed = change(gain[:, 0])
    # The set-point of a position actuator stays where it is only if biasprm[1] follows gainprm[0].
    ratio = changed / jnp.where(gain[:, 0] != 0, gain[:, 0], 1)
    return {
        "actuator_gainprm": jnp.where(np.arange(gain.shape[1]) == 0, changed[:, None], gain),
        "actuator_biasprm": jnp.where(np.arange(bias.shape[1]) == 1, bias * ratio[:, None], bias),
    }


def _kv(fields: Fields, change: Change, options: dict[str, Any]) -> Fields:
    bias = fields["actuator_biasprm"]
    changed = -change(-bias[:, 2])
    return {"actuator_biasprm": jnp.where(np.arange(bias.shape[1]) == 2, changed[:, None], bias)}


def _joint_range(fields: Fields, change: Change, options: dict[str, Any]) -> Fields:
    low, high = fields["jnt_range"][:, 0], fields["jnt_range"][:, 1]
    end = options.get("end", "width")
    if end == "low":
        low = change(low)
    elif end == "high":
        high = change(high)
    else:
        centre, half = (low + high) / 2, change((high - low) / 2)
        low, high = centre - half, centre + half
    return {"jnt_range": jnp.stack([low, high], axis=-1)}


def _gravity(fields: Fields, change: Change, options: dict[str, Any]) -> Fields:
    gravity = fields["opt.gravity"]
    size = jnp.linalg.norm(gravity)
    return {"opt.gravity": gravity * (change(size[None])[0] / jnp.where(size > 0, size, 1))}


def _gravity_tilt(fields: Fields, change: Change, options: dict[str, Any]) -> Fields:
    """Turns gravity about a horizontal axis: a floor tilted by that angle, seen in the floor's frame."""
    angle = change(jnp.zeros(1, fields["opt.gravity"].dtype))[0]
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x, y, z = fields["opt.gravity"]
    if options["axis"] == "x":
        turned = jnp.stack([x, cos * y - sin * z, sin * y + cos * z])
    else:
        turned = jnp.stack([cos * x + sin * z, y, -sin * x + cos * z])
    return {"opt.gravity": turned}


def _force_limit(fields: Fields, change: Change, options: dict[str, Any]) -> Fields:
    limit = fields["actuator_forcerange"]
    high = change(limit[:, 1])
    ratio = high / jnp.where(limit[:, 1] != 0, limit[:, 1], 1)
    return {"actuator_forcerange": jnp.stack([limit[:, 0] * ratio, high], axis=-1)}


_SLIDERS = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
_SCALES = ("times",)
_ACTUATOR = ("actuator_gainprm", "actuator_biasprm")

QUANTITIES: dict[str, Quantity] = {
    "body_mass": Quantity("body", ("body_mass", "body_inertia"), "kg", _body_mass, lowest=0, strict=True),
    "body_inertia": Quantity("body", ("body_inertia",), "x", _rows("body_inertia"), _SCALES, 0, True),
    "body_com": Quantity("body", ("body_ipos",), "m", _body_com, ("plus", "set")),
    "friction": Quantity("geom", ("geom_friction",), "1", _scalar("geom_friction", 0), lowest=0),
    "joint_damping": Quantity("dof", ("dof_damping",), "N m s/rad", _scalar("dof_damping"), lowest=0),
    "friction_loss": Quantity("dof", ("dof_frictionloss",), "N m", _scalar("dof_frictionloss"), lowest=0),
    "armature": Quantity("dof", ("dof_armature",), "kg m2", _scalar("dof_armature"), lowest=0),
    "stiffness": Quantity("joint", ("jnt_stiffness",), "N m/rad", _scalar("jnt_stiffness"), lowest=0),
    "joint_range": Quantity("joint", ("jnt_range",), "rad", _joint_range),
    "gravity": Quantity("option", ("opt.gravity",), "m/s2", _gravity, lowest=0),
    "gravity_tilt": Quantity("option", ("opt.gravity",), "rad", _gravity_tilt, ("plus", "set")),
    "kp": Quantity("actuator", _ACTUATOR, "N m/rad", _kp, lowest=0, strict=True),
    "kv": Quantity("actuator", ("actuator_biasprm",), "N m s/rad", _kv, lowest=0),
    "gain": Quantity("actuator", _ACTUATOR, "x", _rows(*_ACTUATOR), _SCALES, 0),
    "force_limit": Quantity("actuator", ("actuator_forcerange",), "N m", _force_limit, lowest=0, strict=True),
    "geom_size": Quantity("geom", ("geom_size",), "x", _rows("geom_size"), _SCALES, 0, True),
    "joint_reference": Quantity("joint_qpos", ("qpos0",), "rad", _scalar("qpos0"), ("plus", "set")),
}

_OBJECTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
}


def element_names(model: mujoco.MjModel, element: str) -> list[str]:
    """A name for each row of the element's fields; "" where it cannot be addressed.

    Rows of `dof` and `joint_qpos` bear the name of their joint (`joint_qpos` only for hinges and slides); the
    world body cannot be addressed.
    """
    if element == "option":
        return ["*"]
    if element == "dof":
        joints = element_names(model, "joint")
        return [joints[j] for j in model.dof_jntid]
    if element == "joint_qpos":
        names = [""] * model.nq
        for joint, name in enumerate(element_names(model, "joint")):
            if model.jnt_type[joint] in _SLIDERS:
                names[model.jnt_qposadr[joint]] = name
        return names
    count = {"body": model.nbody, "geom": model.ngeom, "joint": model.njnt, "actuator": model.nu}[element]
    names = [mujoco.mj_id2name(model, _OBJECTS[element], i) or "" for i in range(count)]
    if element == "body":
        names[0] = ""
    return names


def nominal_field(model: mujoco.MjModel, name: str) -> np.ndarray:
    """A field of the nominal model, with `opt.` reaching into its options; a copy."""
    owner, attribute = (model.opt, name[4:]) if name.startswith("opt.") else (model, name)
    return np.array(getattr(owner, attribute))


def control_units(model: mujoco.MjModel) -> list[str]:
    """The unit of each actuator's control, where it can be told: a servo's position, or a motor's force."""
    units = []
    for i in range(model.nu):
        driven = model.actuator_trntype[i] == int(mujoco.mjtTrn.mjTRN_JOINT)
        turns = driven and model.jnt_type[model.actuator_trnid[i, 0]] == int(mujoco.mjtJoint.mjJNT_HINGE)
        slides = driven and model.jnt_type[model.actuator_trnid[i, 0]] == int(mujoco.mjtJoint.mjJNT_SLIDE)
        gain, bias = model.actuator_gainprm[i, 0], model.actuator_biasprm[i, :3]
        if (turns or slides) and gain != 0 and bias[1] == -gain:
            units.append("rad" if turns else "m")
        elif (turns or slides) and gain == 1 and not bias.any():
            units.append("N m" if turns else "N")
        else:
            units.append("control")
    return units
