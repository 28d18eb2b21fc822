"""Where everything is, and how it moves, in the reference pose qpos0.

In qpos0 hinges and slides are at rest, so the frames follow from the body offsets, and from qpos0 itself for
free and ball joints only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property

import mujoco
import numpy as np

from simreal.constants.arrays import (
    Array,
    common,
    cross,
    matrix,
    module,
    multiply,
    normalize,
    override,
    product,
    rotate,
    transpose,
)

_FREE, _BALL, _SLIDE, _HINGE = (
    int(getattr(mujoco.mjtJoint, f"mjJNT_{name}")) for name in ("FREE", "BALL", "SLIDE", "HINGE")
)


class Skeleton:
    """The kinematic tree of a model: which body and joint hangs where. Static, NumPy."""

    def __init__(self, model: mujoco.MjModel):
        self.nbody, self.nv = model.nbody, model.nv
        self.joint_body, self.joint_type = model.jnt_bodyid.copy(), model.jnt_type.copy()
        self.joint_qpos, self.joint_dof = model.jnt_qposadr.copy(), model.jnt_dofadr.copy()
        self.body_simple = model.body_simple.copy()
        self.dof_joint = model.dof_jntid.copy()

        self.parent = model.body_parentid.copy()
        self.affects = np.zeros((model.nbody, model.nv), bool)  # does this dof move this body?
        self.contains = np.eye(model.nbody, dtype=bool)  # is the second body in the subtree of the first?
        depth = np.zeros(model.nbody, int)
        for body in range(1, model.nbody):
            parent, dof = self.parent[body], model.body_dofadr[body]
            depth[body] = depth[parent] + 1
            self.affects[body] = self.affects[parent]
            if dof >= 0:
                self.affects[body, dof : dof + model.body_dofnum[body]] = True
            self.contains[:, body] |= self.contains[:, parent]
        self.doublings = int(np.ceil(np.log2(max(depth.max(), 1))))

        self.free = np.flatnonzero(self.joint_type == _FREE)
        self.ball = np.flatnonzero(self.joint_type == _BALL)
        ball_of_body = {self.joint_body[joint]: k for k, joint in enumerate(self.ball)}
        # joints that come before the ball of their body, and do not turn with it
        pairs = [(joint, ball_of_body.get(body, -1)) for joint, body in enumerate(self.joint_body)]
        pairs = [(joint, ball) for joint, ball in pairs if ball >= 0 and joint < self.ball[ball]]
        self.early, self.early_ball = np.array(pairs, int).reshape(-1, 2).T

        offset = np.arange(model.nv) - self.joint_dof[self.dof_joint]
        kind = self.joint_type[self.dof_joint]
        self.dof_turns = (kind == _HINGE) | (kind == _BALL) | ((kind == _FREE) & (offset >= 3))
        # row of [joint axes; x, y, z axes of all bodies; unit vectors] along or about which a dof moves
        about_body = model.njnt + 3 * model.dof_bodyid + offset % 3
        along_world = model.njnt + 3 * model.nbody + offset % 3
        self.dof_axis = np.select(
            [(kind == _SLIDE) | (kind == _HINGE), self.dof_turns], [self.dof_joint, about_body], along_world
        )
        self.moving = np.flatnonzero(self.affects.any(1))


class Pose:
    """Frames and Jacobians of one world in qpos0. `field` returns a model field by name."""

    def __init__(self, skeleton: Skeleton, field: Callable[[str], Array]):
        self.skeleton = skeleton
        self.field = field

    @cached_property
    def _local_quats(self) -> tuple[Array, Array]:
        """Quaternions of bodies in their parents (nbody, 4) and of ball joints (nball, 4)."""
        tree, quat = self.skeleton, normalize(self.field("body_quat"))
        if len(tree.free):
            address = tree.joint_qpos[tree.free][:, None] + np.arange(3, 7)
            quat = override(quat, tree.joint_body[tree.free], normalize(self.field("qpos0")[address]))
        if not len(tree.ball):
            return quat, np.zeros((0, 4))
        turn = normalize(self.field("qpos0")[tree.joint_qpos[tree.ball][:, None] + np.arange(4)])
        return quat, turn

    @cached_property
    def bodies(self) -> tuple[Array, Array]:
        """World frames of all bodies: positions (nbody, 3), m, and rotations (nbody, 3, 3)."""
        tree, pos = self.skeleton, self.field("body_pos")
        if len(tree.free):
            address = tree.joint_qpos[tree.free][:, None] + np.arange(3)
            pos = override(pos, tree.joint_body[tree.free], self.field("qpos0")[address])
        quat, turn = self._local_quats
        axes = matrix(quat)
        if len(tree.ball):
            body, turned = tree.joint_body[tree.ball], matrix(turn)
            anchor = self.field("jnt_pos")[tree.ball]
            _, shift, back = common(anchor, rotate(turned, anchor))
            _, base, shift = common(pos[body], rotate(axes[body], shift - back))
            pos = override(pos, body, base + shift)
            axes = override(axes, body, product(axes[body], turned))
        _, pos, axes = common(pos, axes)
        for above in self._above:
            pos = pos[above] + rotate(axes[above], pos)
            axes = axes[above] @ axes
        return pos, axes

    @property
    def _above(self) -> Iterator[np.ndarray]:
        """Parents, then their parents' parents and so on: each round joins twice as many links of a chain."""
        above = self.skeleton.parent
        for _ in range(self.skeleton.doublings):
            yield above
            above = above[above]

    @cached_property
    def quats(self) -> Array:
        """World rotations of all bodies as quaternions, (nbody, 4)."""
        quat, turn = self._local_quats
        body = self.skeleton.joint_body[self.skeleton.ball]
        quat = override(quat, body, multiply(quat[body], turn))
        for above in self._above:
            quat = multiply(quat[above], quat)
        return normalize(quat)

    @cached_property
    def inertial(self) -> tuple[Array, Array]:
        """World positions of the centres of mass (nbody, 3), m, and axes of inertia (nbody, 3, 3)."""
        body = np.arange(self.skeleton.nbody)
        return self.frames(body, self.field("body_ipos"), self.field("body_iquat"))

    def points(self, body: np.ndarray, local: Array) -> Array:
        """World positions of points fixed to bodies, (n, 3)."""
        pos, axes = self.bodies
        _, pos, offset = common(pos[body], rotate(axes[body], local))
        return pos + offset

    def frames(self, body: np.ndarray, pos: Array, quat: Array) -> tuple[Array, Array]:
        """World positions (n, 3) and rotations (n, 3, 3) of things fixed to bodies: geoms, sites, cameras."""
        return self.points(body, pos), product(self.bodies[1][body], matrix(normalize(quat)))

    @cached_property
    def _joints(self) -> tuple[Array, Array]:
        """Anchor and axis of every joint in the frame of its body as it stands in qpos0, (njnt, 3) each."""
        tree, pos, axis = self.skeleton, self.field("jnt_pos"), self.field("jnt_axis")
        if len(tree.free):
            pos = override(pos, tree.free, np.zeros((len(tree.free), 3)))
        if len(tree.early):
            back = transpose(matrix(self._local_quats[1]))[tree.early_ball]
            centre = pos[tree.ball[tree.early_ball]]
            _, moved, centre = common(rotate(back, pos[tree.early] - centre), centre)
            axis = override(axis, tree.early, rotate(back, axis[tree.early]))
            pos = override(pos, tree.early, moved + centre)
        return pos, axis

    @cached_property
    def anchors(self) -> Array:
        """World positions of the joints, (njnt, 3), m."""
        return self.points(self.skeleton.joint_body, self._joints[0])

    @cached_property
    def _dofs(self) -> tuple[Array, Array]:
        """Axis of every dof, and the point that it goes through, (nv, 3) each."""
        tree, turned = self.skeleton, self.bodies[1]
        axes = rotate(turned[tree.joint_body], self._joints[1])
        if len(tree.free) or len(tree.ball):
            xp, axes, turned, world = common(axes, turned, np.eye(3))
            axes = xp.concatenate([axes, transpose(turned).reshape(-1, 3), world])
        return axes[tree.dof_axis], self.anchors[tree.dof_joint]

    def turning(self, body: np.ndarray) -> Array:
        """Rotational Jacobian of bodies in world axes, (n, nv, 3)."""
        axis = self._dofs[0]
        moves = (self.skeleton.affects[body] & self.skeleton.dof_turns)[:, :, None]
        return axis[None] * moves.astype(axis.dtype)

    def jacobian(self, body: np.ndarray, point: Array) -> Array:
        """Translational Jacobian of world points (n, 3) on bodies (n,), (n, nv, 3)."""
        xp, axis, anchor, point = common(*self._dofs, point)
        arm = point[:, None, :] - anchor[None]
        velocity = xp.where(self.skeleton.dof_turns[None, :, None], cross(axis[None], arm), axis[None])
        return velocity * self.skeleton.affects[body][:, :, None].astype(axis.dtype)

    def subtree_com(self, mass: Array, subtree_mass: Array) -> Array:
        """Centres of mass of the subtrees, (nbody, 3), m; where one weighs nothing, of its first body."""
        xp, centre, mass, total = common(self.inertial[0], mass, subtree_mass)
        moment = product(self.skeleton.contains.astype(float), mass[:, None] * centre)
        empty = (total < mujoco.mjMINVAL)[:, None]
        return xp.where(empty, centre, moment / xp.where(empty, xp.ones_like(centre), total[:, None]))


def longest(lengths: Array, groups: list[list[int]]) -> Array:
    """Largest of `lengths` (n,) in each group of indices, 0 for an empty group: (groups,)."""
    width = max((len(group) for group in groups), default=0)
    index = np.array([group + [-1] * (width - len(group)) for group in groups], int)
    xp = module(lengths)
    padded = xp.concatenate([lengths, xp.zeros(1, lengths.dtype)])
    return padded[index].max(1) if width else xp.zeros(len(groups), lengths.dtype)
