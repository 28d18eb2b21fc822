"""Lengths and moments of actuators in the reference pose (mj_transmission), and their armature."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import mujoco
import numpy as np

from simreal.constants.arrays import (
    Array,
    common,
    conjugate,
    cross,
    matrix,
    multiply,
    normalize,
    override,
    product,
    rotate,
    rotation_vector,
    transpose,
    varies,
)
from simreal.constants.pose import Pose, Skeleton
from simreal.constants.tendons import Tendons

_JOINT, _IN_PARENT, _SLIDERCRANK, _TENDON, _SITE = (
    int(getattr(mujoco.mjtTrn, f"mjTRN_{name}"))
    for name in ("JOINT", "JOINTINPARENT", "SLIDERCRANK", "TENDON", "SITE")
)
_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
_JOINT_WIDTH = {_FREE: 6, _BALL: 3}


class Targets:
    """What actuators pull at. Static, NumPy."""

    def __init__(self, model: mujoco.MjModel, skeleton: Skeleton):
        self.ntendon, self.nout, self.nv = model.ntendon, model.nout, model.nv
        self.site_body = model.site_bodyid.copy()
        kind, address = model.actuator_trntype, model.actuator_outadr
        self.actuator_output = address.copy()
        self.of_joint = np.flatnonzero((kind == _JOINT) | (kind == _IN_PARENT))
        self.in_parent = kind[self.of_joint] == _IN_PARENT
        self.of_tendon = np.flatnonzero(kind == _TENDON)
        self.of_crank = np.flatnonzero(kind == _SLIDERCRANK)
        has_reference = model.actuator_trnid[:, 1] >= 0
        self.of_site = np.flatnonzero((kind == _SITE) & ~has_reference)
        self.of_site_pair = np.flatnonzero((kind == _SITE) & has_reference)
        self.target = model.actuator_trnid.copy()

        # dof that each component of a joint's gear acts on: (actuators of joints, 6, nv)
        self.joint_dofs = np.zeros((len(self.of_joint), 6, model.nv))
        for row, joint in enumerate(self.target[self.of_joint, 0]):
            for k in range(_JOINT_WIDTH.get(skeleton.joint_type[joint], 1)):
                self.joint_dofs[row, k, skeleton.joint_dof[joint] + k] = 1

        # the site's and the reference's bodies move together with a common dof, which does not count
        body = self.site_body[self.target[self.of_site_pair]]
        self.pair_dofs = skeleton.affects[body[:, 0]] ^ skeleton.affects[body[:, 1]]


class Transmission:
    """Actuators of one world in qpos0."""

    def __init__(
        self,
        targets: Targets,
        skeleton: Skeleton,
        field: Callable[[str], Array],
        pose: Pose,
        tendons: Tendons,
    ):
        self.targets = targets
        self.skeleton = skeleton
        self.field = field
        self.pose = pose
        self.tendons = tendons

    @cached_property
    def dof_armature(self) -> Array:
        """Armature that actuators add to the dofs of their joints, (nv,): gear^2 times actuator_armature."""
        targets = self.targets
        reach = targets.joint_dofs.sum(1)
        return product(reach.T, self._reflected(targets.of_joint))

    @cached_property
    def tendon_armature(self) -> Array:
        """Armature of the tendons and of the actuators that pull at them, (ntendon,)."""
        of_tendon = self.targets.of_tendon
        member = (self.targets.target[of_tendon, 0] == np.arange(self.targets.ntendon)[:, None]).astype(float)
        _, own, added = common(self.field("tendon_armature"), product(member, self._reflected(of_tendon)))
        return own + added

    @property
    def has_tendon_armature(self) -> bool:
        """Whether tendons carry inertia."""
        armature = self.tendon_armature
        return len(armature) > 0 and (varies(armature) or bool(np.any(armature)))

    def _reflected(self, actuator: np.ndarray) -> Array:
        armature = self.field("actuator_armature")[actuator]
        if not varies(armature) and not np.any(armature):
            return armature  # else a varied gear would drag the mass matrix into the program
        gear = self.field("actuator_gear")[self.targets.actuator_output[actuator], 0]
        _, armature, gear = common(armature, gear)
        return gear**2 * armature

    @property
    def length(self) -> Array:
        """actuator_length0, (nout,)."""
        return self._both[0]

    @property
    def moment(self) -> Array:
        """Torques on the dofs by a unit force, (nout, nv); 0 for adhesion, which has no contact in qpos0."""
        return self._both[1]

    @cached_property
    def _both(self) -> tuple[Array, Array]:
        targets = self.targets
        length, moment = np.zeros(targets.nout), np.zeros((targets.nout, targets.nv))
        parts = (
            (targets.of_joint, self._joint_actuators),
            (targets.of_tendon, self._tendon_actuators),
            (targets.of_site, self._site_actuators),
            (targets.of_site_pair, self._site_pair_actuators),
            (targets.of_crank, self._crank_actuators),
        )
        for actuator, part in parts:
            if len(actuator):
                output = targets.actuator_output[actuator]
                part_length, part_moment = part(self.field("actuator_gear")[output], targets.target[actuator])
                length, moment = override(length, output, part_length), override(moment, output, part_moment)
        return length, moment

    def _joint_actuators(self, gear: Array, target: np.ndarray) -> tuple[Array, Array]:
        joint = target[:, 0]
        kind, address = self.skeleton.joint_type[joint], self.skeleton.joint_qpos[joint]
        qpos0 = self.field("qpos0")
        for width, part in ((_BALL, slice(0, 3)), (_FREE, slice(3, 6))):
            rows = np.flatnonzero((kind == width) & self.targets.in_parent)
            if len(rows):
                quat = normalize(qpos0[address[rows, None] + part.start + np.arange(4)])
                turned = rotate(transpose(matrix(quat)), gear[rows, part])
                xp, kept, turned = common(gear[rows], turned)
                turned = xp.concatenate([kept[:, : part.start], turned, kept[:, part.stop :]], axis=1)
                gear = override(gear, rows, turned)
        _, force, dofs = common(gear, self.targets.joint_dofs)
        moment = (force[:, :, None] * dofs).sum(1)

        _, lever, position = common(gear[:, 0], qpos0[address])
        length = override(lever * position, np.flatnonzero(kind == _FREE), np.zeros((kind == _FREE).sum()))
        ball = np.flatnonzero(kind == _BALL)
        if len(ball):
            angle = rotation_vector(normalize(qpos0[address[ball, None] + np.arange(4)]))
            _, angle, lever = common(angle, gear[ball, :3])
            length = override(length, ball, (angle * lever).sum(1))
        return length, moment

    def _tendon_actuators(self, gear: Array, target: np.ndarray) -> tuple[Array, Array]:
        _, length, lever = common(self.tendons.length[target[:, 0]], gear[:, 0])
        _, jacobian, column = common(self.tendons.jacobian[target[:, 0]], gear[:, :1])
        return length * lever, jacobian * column

    def _site_frames(self, site: np.ndarray) -> tuple[np.ndarray, Array, Array]:
        body = self.targets.site_body[site]
        return body, *self.pose.frames(body, self.field("site_pos")[site], self.field("site_quat")[site])

    def _site_quats(self, site: np.ndarray) -> Array:
        own = normalize(self.field("site_quat")[site])
        return multiply(self.pose.quats[self.targets.site_body[site]], own)

    def _wrench_moment(self, axes: Array, gear: Array, move: Array, turn: Array) -> Array:
        """Joint torques by the wrench `gear` (n, 6) in axes (n, 3, 3), for Jacobians (n, nv, 3): (n, nv)."""
        _, force, torque, move, turn = common(
            rotate(axes, gear[:, :3]), rotate(axes, gear[:, 3:]), move, turn
        )
        return (move * force[:, None, :] + turn * torque[:, None, :]).sum(-1)

    def _site_actuators(self, gear: Array, target: np.ndarray) -> tuple[Array, Array]:
        body, pos, axes = self._site_frames(target[:, 0])
        moment = self._wrench_moment(axes, gear, self.pose.jacobian(body, pos), self.pose.turning(body))
        return np.zeros(len(target)), moment

    def _site_pair_actuators(self, gear: Array, target: np.ndarray) -> tuple[Array, Array]:
        body, pos, _ = self._site_frames(target[:, 0])
        base_body, base_pos, base_axes = self._site_frames(target[:, 1])
        _, move, turn, base_move, base_turn, mask = common(
            *(self.pose.jacobian(body, pos), self.pose.turning(body)),
            *(self.pose.jacobian(base_body, base_pos), self.pose.turning(base_body)),
            self.targets.pair_dofs[:, :, None].astype(float),
        )
        moment = self._wrench_moment(base_axes, gear, (move - base_move) * mask, (turn - base_turn) * mask)
        _, pos, base_pos = common(pos, base_pos)
        offset = rotate(transpose(base_axes), pos - base_pos)
        quat, base_quat = (self._site_quats(target[:, k]) for k in (0, 1))
        angle = rotation_vector(multiply(conjugate(base_quat), quat))
        xp, offset, angle, gear = common(offset, angle, gear)
        return (xp.concatenate([offset, angle], axis=1) * gear).sum(1), moment

    def _crank_actuators(self, gear: Array, target: np.ndarray) -> tuple[Array, Array]:
        body, pin, _ = self._site_frames(target[:, 0])
        slider_body, slider, axes = self._site_frames(target[:, 1])
        axis = axes[:, :, 2]
        rod = self.field("actuator_cranklength")[self.targets.of_crank]
        xp, pin, slider, axis, rod, move, slide, turn = common(
            *(pin, slider, axis, rod, self.pose.jacobian(body, pin)),
            *(self.pose.jacobian(slider_body, slider), self.pose.turning(slider_body)),
        )
        arm = pin - slider
        along = (arm * axis).sum(1)
        square = along**2 + rod**2 - (arm**2).sum(1)
        reached = square > 0
        root = xp.sqrt(xp.where(reached, square, xp.ones_like(square)))
        length = xp.where(reached, along - root, along)
        share = xp.where(reached, 1 - along / root, xp.ones_like(along))[:, None]
        pull = share * axis + xp.where(reached, 1 / root, xp.zeros_like(root))[:, None] * arm
        swing = cross(turn, axis[:, None, :])
        moment = ((move - slide) * pull[:, None, :] + swing * (share * arm)[:, None, :]).sum(-1)
        _, length, moment, lever = common(length, moment, gear[:, 0])
        return length * lever, moment * lever[:, None]
