"""Lengths and Jacobians of tendons in the reference pose (mj_tendon)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from simreal.constants.arrays import Array, common, direction, norm, override, product, varies
from simreal.constants.pose import Pose, Skeleton

_JOINT, _PULLEY, _SITE, _SPHERE = (
    int(getattr(mujoco.mjtWrap, f"mjWRAP_{name}")) for name in ("JOINT", "PULLEY", "SITE", "SPHERE")
)


class Paths:
    """What tendons run along. Static, NumPy."""

    def __init__(self, model: mujoco.MjModel):
        self.count = model.ntendon
        self.site_body, self.geom_body = model.site_bodyid.copy(), model.geom_bodyid.copy()
        joints, straight, wrapped = [], [], []
        for tendon in range(model.ntendon):
            start, pulley = model.tendon_adr[tendon], -1
            path = list(range(start, start + model.tendon_num[tendon]))
            if model.wrap_type[start] == _JOINT:
                joints += [(tendon, wrap) for wrap in path]
                continue
            for here, there in pairwise(path):
                if model.wrap_type[here] == _PULLEY:
                    pulley = here
                elif model.wrap_type[here] == _SITE:
                    if model.wrap_type[there] == _SITE:
                        straight.append((tendon, pulley, here, there))
                    elif model.wrap_type[there] != _PULLEY:
                        wrapped.append((tendon, pulley, here, there + 1, there))
        self.joint_wraps = np.array(joints, int).reshape(-1, 2)
        self.straight = np.array(straight, int).reshape(-1, 4)
        self.wrapped = np.array(wrapped, int).reshape(-1, 5)
        self.wrap_object, self.wrap_type = model.wrap_objid.copy(), model.wrap_type.copy()
        self.side_site = np.where(self.wrap_type >= _SPHERE, np.round(model.wrap_prm), -1).astype(int)
        self.nominal_lengths, self.nominal_jacobians = (
            np.zeros(model.ntendon),
            np.zeros((model.ntendon, model.nv)),
        )
        if len(wrapped):
            data = mujoco.MjData(model)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_tendon(model, data)
            self.nominal_lengths[:] = data.ten_length
            for tendon, (address, number) in enumerate(
                zip(model.ten_J_rowadr, model.ten_J_rownnz, strict=True)
            ):
                entries = slice(address, address + number)
                self.nominal_jacobians[tendon, model.ten_J_colind[entries]] = data.ten_J.ravel()[entries]


class Tendons:
    """Tendons of one world in qpos0."""

    def __init__(self, paths: Paths, skeleton: Skeleton, field: Callable[[str], Array], pose: Pose):
        self.paths = paths
        self.skeleton = skeleton
        self.field = field
        self.pose = pose

    @property
    def length(self) -> Array:
        """tendon_length0, (ntendon,): m; of a fixed tendon the unit of its joints."""
        return self._both[0]

    @property
    def jacobian(self) -> Array:
        """Derivative of the lengths by the dofs, (ntendon, nv)."""
        return self._both[1]

    @cached_property
    def _both(self) -> tuple[Array, Array]:
        length, jacobian = self._fixed
        parts = [self._straight] if len(self.paths.straight) else []
        parts += [self._wrapped] if len(self.paths.wrapped) else []
        for tendon, part_length, part_jacobian in parts:
            member = (tendon == np.arange(self.paths.count)[:, None]).astype(float)
            _, length, added = common(length, product(member, part_length))
            _, jacobian, moved = common(jacobian, product(member, part_jacobian))
            length, jacobian = length + added, jacobian + moved
        return length, jacobian

    @cached_property
    def _fixed(self) -> tuple[Array, Array]:
        tendon, wrap = self.paths.joint_wraps.T
        joint = self.paths.wrap_object[wrap]
        member = (tendon == np.arange(self.paths.count)[:, None]).astype(float)
        dof = (self.skeleton.joint_dof[joint][:, None] == np.arange(self.skeleton.nv)).astype(float)
        coefficient = self.field("wrap_prm")[wrap]
        _, scale, dof = common(coefficient, dof)
        _, scaled, position = common(coefficient, self.field("qpos0")[self.skeleton.joint_qpos[joint]])
        return product(member, scaled * position), product(member, scale[:, None] * dof)

    def _divisor(self, pulley: np.ndarray) -> Array:
        """What the pulley before each part of a tendon divides by; 1 without one, (n,)."""
        xp, values, one = common(self.field("wrap_prm"), np.ones(1))
        return xp.maximum(mujoco.mjMINVAL, xp.concatenate([values, one]))[pulley]

    def _sites(self, site: np.ndarray) -> tuple[np.ndarray, Array]:
        """Bodies and world positions of sites, (n,) and (n, 3)."""
        body = self.paths.site_body[site]
        return body, self.pose.points(body, self.field("site_pos")[site])

    def _segments(
        self, body0: np.ndarray, point0: Array, body1: np.ndarray, point1: Array
    ) -> tuple[Array, Array]:
        """Lengths (n,) and Jacobians (n, nv) of straight segments between points on bodies."""
        _, point0, point1 = common(point0, point1)
        span = point1 - point0
        _, before, after = common(self.pose.jacobian(body0, point0), self.pose.jacobian(body1, point1))
        _, along, difference = common(direction(span), after - before)
        apart = (body0 != body1)[:, None].astype(difference.dtype)
        return norm(span), (difference * along[:, None, :]).sum(-1) * apart

    @cached_property
    def _straight(self) -> tuple[np.ndarray, Array, Array]:
        """Parts of spatial tendons between two sites: tendon (n,), length (n,), Jacobian (n, nv)."""
        tendon, pulley, start, end = self.paths.straight.T
        objects = self.paths.wrap_object
        length, jacobian = self._segments(*self._sites(objects[start]), *self._sites(objects[end]))
        _, length, jacobian, divisor = common(length, jacobian, self._divisor(pulley))
        return tendon, length / divisor, jacobian / divisor[:, None]

    @cached_property
    def _wrapped(self) -> tuple[np.ndarray, Array, Array]:
        """Parts of spatial tendons around a sphere or cylinder, as `_straight`."""
        paths = self.paths
        tendon, pulley, start, end, around = paths.wrapped.T
        geom, side = paths.wrap_object[around], paths.side_site[around]
        geom_body = paths.geom_body[geom]
        body0, point0 = self._sites(paths.wrap_object[start])
        body1, point1 = self._sites(paths.wrap_object[end])
        centre, axes = self.pose.frames(
            geom_body, self.field("geom_pos")[geom], self.field("geom_quat")[geom]
        )
        radius, side_point = self.field("geom_size")[geom, 0], self._sites(side)[1]
        inputs = (point0, point1, centre, axes, radius, side_point)
        if not any(varies(value) for value in inputs):
            return self._nominal_rest()

        _, point0, point1, centre, axes, radius, side_point = common(*inputs)
        arc, touch0, touch1 = _wrap(
            *(point0, point1, centre, axes, radius, side_point),
            *(side >= 0, paths.wrap_type[around] == _SPHERE),
        )
        length, jacobian = self._segments(body0, point0, body1, point1)
        length0, jacobian0 = self._segments(body0, point0, geom_body, touch0)
        length1, jacobian1 = self._segments(geom_body, touch1, body1, point1)
        xp, arc, length0 = common(arc, length0)
        free = arc < 0
        length = xp.where(free, length, length0 + arc + length1)
        jacobian = xp.where(free[:, None], jacobian, jacobian0 + jacobian1)
        _, length, jacobian, divisor = common(length, jacobian, self._divisor(pulley))
        return tendon, length / divisor, jacobian / divisor[:, None]

    def _nominal_rest(self) -> tuple[np.ndarray, Array, Array]:
        """The nominal tendons of C less their straight parts, one row for each tendon that wraps."""
        tendon = np.unique(self.paths.wrapped[:, 0])
        straight_of, length, jacobian = self._straight
        member = (straight_of == tendon[:, None]).astype(float)
        rest = self.paths.nominal_lengths[tendon], self.paths.nominal_jacobians[tendon]
        return tendon, rest[0] - product(member, length), rest[1] - product(member, jacobian)


def _wrap(*geometry: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Arc length (n,), negative where the tendon runs free, and the two points (n, 3) where it touches.

    `geometry`: end points (n, 3) twice, centre (n, 3), axes (n, 3, 3), radius (n,), side site (n, 3), whether
    there is one (n,) and whether the geom is a sphere (n,), both static. By MJX's own `wrap`, except that
    as in C's mju_wrap a tendon runs inside wherever its side site lies inside.
    """
    from mujoco.mjx._src import support  # only here: importing MJX takes seconds

    *_, centre, _, radius, side, has_side, _ = geometry
    # In single precision a finer tolerance is missed now and then, and a tendon inside a ring goes astray.
    tolerance, start = max(1e-9, 80 * float(jnp.finfo(centre.dtype).eps)), 1 - 1e-7

    def wrap(inside: bool, rows: np.ndarray) -> list[jax.Array]:
        def one(*values: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            arc, touch0, touch1 = support.wrap(*values, inside, 20, tolerance, start)
            return jnp.reshape(arc, ()), touch0, touch1

        *arrays, given, sphere = (value[rows] for value in geometry)
        with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
            parts = jax.vmap(one)(*arrays, jnp.asarray(given)[:, None], jnp.asarray(sphere))
        return [part.astype(centre.dtype) for part in parts]

    outside = wrap(False, np.arange(len(has_side)))
    sided = np.flatnonzero(has_side)
    if len(sided):
        chosen = norm(side[sided] - centre[sided]) < radius[sided]
        for k, inside in enumerate(wrap(True, sided)):
            pick = chosen.reshape((-1,) + (1,) * (inside.ndim - 1))
            outside[k] = override(outside[k], sided, jnp.where(pick, inside, outside[k][sided]))
    arc, touch0, touch1 = outside
    return arc, touch0, touch1
