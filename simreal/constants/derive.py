"""The entry point: from varied model fields to the fields that follow from them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from simreal.constants.arrays import (
    Array,
    common,
    conjugate,
    multiply,
    norm,
    override,
    rotate,
    transpose,
    varies,
)
from simreal.constants.bounds import Bounds, Shapes
from simreal.constants.inertia import Inertia, mass_pattern
from simreal.constants.pose import Pose, Skeleton
from simreal.constants.tendons import Paths, Tendons
from simreal.constants.transmission import Targets, Transmission
from simreal.errors import UserError

C_ONLY = frozenset(
    [
        *("actuator_length0", "body_margin", "bvh_aabb", "dof_length"),
        *("body_sameframe", "geom_sameframe", "site_sameframe"),
    ]
)
"""Derived fields that MuJoCo C works with; MJX does not use them and has no place for a value per world."""

_FRAMES = ("body_pos", "body_quat", "body_ipos", "body_iquat")
_INPUTS = frozenset(
    [
        *("qpos0", *_FRAMES, "body_mass", "body_inertia", "jnt_pos", "jnt_axis", "dof_armature"),
        *("geom_size", "geom_pos", "geom_quat", "geom_margin", "geom_gap", "site_pos", "site_quat"),
        *("cam_pos", "cam_quat", "light_pos", "light_dir", "eq_data", "wrap_prm"),
        *("tendon_armature", "actuator_gear", "actuator_armature", "actuator_cranklength"),
    ]
)
# mj_setConst reads these too, but what follows from them is not calculated here.
_REFUSED = frozenset(["geom_aabb", "geom_fluid", "hfield_size"])


def derived_constants(
    model: mujoco.MjModel, varied: Collection[str]
) -> Callable[[Mapping[str, jax.Array]], dict[str, jax.Array]]:
    """A pure function from the varied fields to every field that `mj_setConst` would change for them.

    `varied` names fields of MjModel, with `opt.` before those of MjOption. The function takes whole arrays in
    MjModel's shapes under these names, for one world (vmap it for many), and returns whole arrays in the
    dtype of its inputs: those that depend on what varies and no others, so for damping or friction none.
    Fields that do not vary keep the values that `model` had when this was called; what follows from them
    alone is calculated in NumPy while tracing.

    Derived: body_subtreemass, dof_M0, body_invweight0, dof_invweight0, tendon_invweight0, tendon_length0,
    actuator_acc0, actuator_length0, eq_data (anchors, and the pose of a weld without relpose), geom_rbound,
    geom_aabb, bvh_aabb (only the rows of bodies, which come first, as `mujoco.batch` has it), body_margin,
    dof_length, cam_pos0, cam_poscom0, cam_mat0, light_pos0, light_poscom0, light_dir0, and as uint8
    body_sameframe, geom_sameframe and site_sameframe, without which C takes a moved centre of mass for the
    origin of the body. `C_ONLY` names those that MJX has no use for.

    Left at their nominal values:
    - `stat.*`: mj_setConst of MuJoCo 3.17 does not touch them, and `mujoco.batch` cannot vary them.
    - the switches ngravcomp, flg_gravcomp, flg_surfacevel, flg_adhesion, jnt_actuatorid, tendon_actuatorid:
      body_gravcomp, geom_surfacevel, geom_adhesion and an actuator's damping and armature have an effect only
      where the nominal model has some.
    - body_simple: a body that the compiler found simple (only slides, or a free joint and no children, centre
      of mass at the origin) must keep its body_ipos and body_iquat unless it has simple="false"; C refuses.

    Quaternions that are not of unit length are taken as the rotations that they stand for, where C scales.

    Raises UserError for a name that the model does not have, and for what is not supported: flexes, actuators
    with SO(3) transmission, geom_aabb, geom_fluid, hfield_size, and sizes of geoms with ellipsoid fluid
    forces.
    """
    names = frozenset(varied)
    _check(model, names)
    if not names & _INPUTS:
        return lambda fields: {}
    nominal = {name: np.array(getattr(model, name)) for name in _INPUTS}
    structure = _Structure(model)

    def derive(fields: Mapping[str, jax.Array]) -> dict[str, jax.Array]:
        if missing := names - set(fields):
            raise ValueError(f"derived_constants: no value for {', '.join(sorted(missing))}")
        given = {name: jnp.asarray(fields[name]) for name in names & _INPUTS}
        for name, value in given.items():
            if value.shape != nominal[name].shape:
                raise ValueError(f"derived_constants: {name} is {value.shape}, not {nominal[name].shape}")
            if name in _FRAMES:
                given[name] = override(value, np.array([0]), nominal[name][:1])
        with jax.default_matmul_precision("highest"):
            everything = structure.derive({**nominal, **given})
        return {name: value for name, value in everything.items() if varies(value) and value.size}

    return derive


def _check(model: mujoco.MjModel, names: frozenset[str]) -> None:
    for name in sorted(names):
        owner = model.opt if name.startswith("opt.") else model
        if not hasattr(owner, name.removeprefix("opt.")):
            raise UserError(f"derived_constants: MjModel has no field {name!r}")
    if refused := names & _REFUSED or {name for name in names if name.startswith("flex")}:
        raise UserError(f"{', '.join(sorted(refused))} cannot vary: what follows from it is not calculated")
    if not names & _INPUTS:
        return
    if model.nflex:
        raise UserError(f"{', '.join(sorted(names & _INPUTS))} cannot vary in a model with flexes")
    if np.any(model.actuator_trntype == mujoco.mjtTrn.mjTRN_SO3):
        raise UserError(f"{', '.join(sorted(names & _INPUTS))} cannot vary in a model with SO(3) actuators")
    if "geom_size" in names and np.any(model.geom_fluid[:, 0]):
        raise UserError('geom_size cannot vary in a model with fluidshape="ellipsoid"')


class _Structure:
    """Everything about a model that does not vary. Static, NumPy."""

    def __init__(self, model: mujoco.MjModel):
        self.skeleton = Skeleton(model)
        self.paths = Paths(model)
        self.targets = Targets(model, self.skeleton)
        self.shapes = Shapes(model, self.skeleton)
        self.pattern = mass_pattern(model)
        body = model.eq_objtype == mujoco.mjtObj.mjOBJ_BODY
        posed = model.eq_data[:, 11] == 0  # a weld's relpose was given, and stays
        self.connects = np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_CONNECT) & body)
        self.welds = np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_WELD) & body & ~posed)
        self.eq_bodies = model.eq_obj1id.copy(), model.eq_obj2id.copy()
        self.camera_body, self.light_body = model.cam_bodyid.copy(), model.light_bodyid.copy()
        targets = (model.cam_targetbodyid, self.camera_body), (model.light_targetbodyid, self.light_body)
        self.camera_target, self.light_target = (
            np.where(target >= 0, target, own) for target, own in targets
        )

    def derive(self, fields: Mapping[str, Array]) -> dict[str, Array]:
        """Every derived field; those that depend on no JAX array among `fields` come out as NumPy arrays."""
        field = fields.__getitem__
        pose = Pose(self.skeleton, field)
        tendons = Tendons(self.paths, self.skeleton, field, pose)
        transmission = Transmission(self.targets, self.skeleton, field, pose, tendons)
        inertia = Inertia(self.skeleton, self.pattern, field, pose, transmission)
        bounds = Bounds(self.shapes, self.skeleton, field, pose)
        derived = {
            "body_subtreemass": inertia.subtree_mass,
            "geom_rbound": bounds.geom_radius,
            "geom_aabb": bounds.geom_box,
            "bvh_aabb": bounds.body_boxes,
            "body_margin": bounds.body_margin,
            "body_sameframe": bounds.body_sameframe,
            "geom_sameframe": bounds.sameframe("geom"),
            "site_sameframe": bounds.sameframe("site"),
            "tendon_length0": tendons.length,
            "actuator_length0": transmission.length,
            **self._views(field, pose, inertia),
        }
        if len(self.connects) or len(self.welds):
            derived["eq_data"] = self._equality_data(field, pose)
        if self.skeleton.nv:
            derived |= {
                "dof_M0": inertia.mass_diagonal,
                "dof_length": bounds.dof_length,
                "body_invweight0": inertia.body_inverse_weight,
                "dof_invweight0": inertia.dof_inverse_weight,
                "tendon_invweight0": inertia.tendon_inverse_weight,
                "actuator_acc0": inertia.actuator_acceleration,
            }
        return derived

    def _equality_data(self, field: Callable[[str], Array], pose: Pose) -> Array:
        """eq_data, (neq, 12): anchor of a connect or weld in the other body, m, and turn between a weld's."""
        data = field("eq_data")
        for rows, own, other in ((self.connects, *self.eq_bodies), (self.welds, *self.eq_bodies[::-1])):
            if not len(rows):
                continue
            here, there = own[rows], other[rows]
            xp, anchor, origin = common(pose.points(here, data[rows, :3]), pose.bodies[0][there])
            parts = [
                data[rows, :3],
                rotate(transpose(pose.bodies[1])[there], anchor - origin),
                data[rows, 6:],
            ]
            if rows is self.welds:
                parts[2:] = multiply(conjugate(pose.quats[there]), pose.quats[here]), data[rows, 10:]
            xp, *parts = common(*parts)
            data = override(data, rows, xp.concatenate(parts, axis=1))
        return data

    def _views(self, field: Callable[[str], Array], pose: Pose, inertia: Inertia) -> dict[str, Array]:
        """Cameras and lights relative to what they track; pos0 and dir0 in world axes, m."""
        turn = pose.bodies[1]
        centre = pose.subtree_com(field("body_mass"), inertia.subtree_mass)

        def from_centre(body: np.ndarray, pos: Array, target: np.ndarray) -> Array:
            _, there, here = common(pose.points(body, pos), centre[target])
            return there - here

        camera, light = self.camera_body, self.light_body
        axes = pose.frames(camera, field("cam_pos"), field("cam_quat"))[1]
        direction = rotate(turn[light], field("light_dir"))
        return {
            "cam_pos0": rotate(turn[camera], field("cam_pos")),
            "cam_poscom0": from_centre(camera, field("cam_pos"), self.camera_target),
            "cam_mat0": axes.reshape(-1, 9),
            "light_pos0": rotate(turn[light], field("light_pos")),
            "light_poscom0": from_centre(light, field("light_pos"), self.light_target),
            "light_dir0": direction / norm(direction)[:, None],
        }
