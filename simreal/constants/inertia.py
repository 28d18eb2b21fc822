"""Inertia in the reference pose, and what a unit force moves there: subtreemass, dof_M0, *_invweight0, acc0.

The mass matrix is summed from the Jacobians of the bodies, M = sum_b J_b' diag(m, m, m, I) J_b + armature
(Featherstone 2008, Rigid Body Dynamics Algorithms, eq. 6.1 ff.), since the inverse weights need them anyway.
With M = L L' and W = inv(L), every inverse weight is a sum of squares: j inv(M) j' = |W j'|^2.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import jax
import mujoco
import numpy as np

from simreal.constants.arrays import Array, common, module, norm, override, product
from simreal.constants.pose import Pose, Skeleton
from simreal.constants.transmission import Transmission


def mass_pattern(model: mujoco.MjModel) -> np.ndarray:
    """Entries of the mass matrix that MuJoCo keeps: (nv, nv) bool."""
    pattern = np.zeros((model.nv, model.nv), bool)
    for row in range(model.nv):
        start = model.M_rowadr[row]
        pattern[row, model.M_colind[start : start + model.M_rownnz[row]]] = True
    return pattern | pattern.T


class Inertia:
    """Masses, the mass matrix and the inverse weights of one world."""

    def __init__(
        self,
        skeleton: Skeleton,
        pattern: np.ndarray,
        field: Callable[[str], Array],
        pose: Pose,
        transmission: Transmission,
    ):
        self.skeleton = skeleton
        self.pattern = pattern
        self.field = field
        self.pose = pose
        self.transmission = transmission

    @cached_property
    def subtree_mass(self) -> Array:
        """body_subtreemass, (nbody,), kg."""
        return product(self.skeleton.contains.astype(float), self.field("body_mass"))

    @cached_property
    def _jacobians(self) -> Array:
        """Of the centres of mass, in axes of inertia for the rotation: (6 * moving bodies, nv)."""
        moving = self.skeleton.moving
        centre, axes = self.pose.inertial
        xp, move, turn, axes = common(
            self.pose.jacobian(moving, centre[moving]), self.pose.turning(moving), axes[moving]
        )
        stacked = xp.concatenate([move, turn @ axes], axis=2)
        return xp.swapaxes(stacked, 1, 2).reshape(-1, self.skeleton.nv)

    @cached_property
    def _rigid_bodies(self) -> Array:
        """Mass matrix of the bodies and the armature of the joints, (nv, nv)."""
        moving = self.skeleton.moving
        xp, mass, inertia = common(self.field("body_mass")[moving], self.field("body_inertia")[moving])
        weight = xp.concatenate([xp.stack([mass] * 3, axis=1), inertia], axis=1).reshape(-1, 1)
        _, jacobians, weight = common(self._jacobians, weight)
        xp, matrix, armature, reflected = common(
            product(jacobians.T, weight * jacobians),
            self.field("dof_armature"),
            self.transmission.dof_armature,
        )
        return matrix + xp.diag(armature + reflected)

    @cached_property
    def mass_diagonal(self) -> Array:
        """dof_M0, (nv,): the diagonal of the mass matrix without the tendons' armature."""
        return module(self._rigid_bodies).diagonal(self._rigid_bodies)

    @cached_property
    def _inverse_factor(self) -> Array:
        """W with inv(M) = W' W, (nv, nv)."""
        matrix = self._rigid_bodies
        if self.transmission.has_tendon_armature:
            _, jacobian, armature = common(
                self.transmission.tendons.jacobian, self.transmission.tendon_armature
            )
            _, matrix, added = common(matrix, product(jacobian.T, armature[:, None] * jacobian))
            matrix = matrix + added
        xp, matrix, kept = common(matrix, self.pattern.astype(float))
        factor = xp.linalg.cholesky(matrix if self.pattern.all() else matrix * kept)
        if xp is np:
            return np.linalg.inv(factor)
        identity = xp.eye(self.skeleton.nv, dtype=factor.dtype)
        return jax.scipy.linalg.solve_triangular(factor, identity, lower=True)

    def inverse_weight(self, jacobian: Array) -> Array:
        """Diagonal of J inv(M) J' for J (n, nv): (n,)."""
        return (product(jacobian, self._inverse_factor.T) ** 2).sum(1)

    @cached_property
    def body_inverse_weight(self) -> Array:
        """body_invweight0, (nbody, 2): translation, 1/kg, and rotation, 1/(kg m^2): means of three."""
        tree = self.skeleton
        weights = self.inverse_weight(self._jacobians).reshape(-1, 2, 3).mean(2)
        xp = module(weights)
        # A body that turns about its centre of mass does not move, not by rounding errors either.
        rounding = float(64 * xp.finfo(weights.dtype).eps) ** 2
        move, turn = weights[:, 0], weights[:, 1]
        weights = xp.stack([xp.where(move < rounding * turn, xp.zeros_like(move), move), turn], axis=1)
        weights = override(xp.zeros((tree.nbody, 2), weights.dtype), tree.moving, weights)
        sliders = np.flatnonzero(tree.body_simple == 2)
        return override(weights, sliders, self._point_masses(sliders))

    def _point_masses(self, body: np.ndarray) -> Array:
        """Inverse weights of bodies that only slide, (n, 2)."""
        mass = self.field("body_mass")[body]
        xp = module(mass)
        return xp.stack([1 / xp.maximum(mujoco.mjMINVAL, mass), xp.zeros_like(mass)], axis=1)

    @cached_property
    def dof_inverse_weight(self) -> Array:
        """dof_invweight0, (nv,): for free and ball joints the mean of three translations or rotations."""
        tree = self.skeleton
        inverse = (self._inverse_factor**2).sum(0)
        offset = np.arange(tree.nv) - tree.joint_dof[tree.dof_joint]
        in_three = np.isin(tree.dof_joint, np.concatenate([tree.free, tree.ball]))[:, None]
        own = np.arange(tree.nv)[:, None]
        inverse = inverse[np.where(in_three, own - offset[:, None] % 3 + np.arange(3), own)].mean(1)
        body = tree.joint_body[tree.dof_joint]
        sliders = np.flatnonzero(tree.body_simple[body] == 2)
        return override(inverse, sliders, self._point_masses(body[sliders])[:, 0])

    @cached_property
    def tendon_inverse_weight(self) -> Array:
        """tendon_invweight0, (ntendon,)."""
        return self.inverse_weight(self.transmission.tendons.jacobian)

    @cached_property
    def actuator_acceleration(self) -> Array:
        """actuator_acc0, (nout,): |inv(M) moment|, the acceleration by a unit force."""
        moments = product(self.transmission.moment, self._inverse_factor.T)
        return norm(product(moments, self._inverse_factor))
