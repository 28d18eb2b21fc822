"""Sizes of geoms and bodies: geom_rbound, geom_aabb, bvh_aabb, body_margin, dof_length, and *_sameframe."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import mujoco
import numpy as np

from simreal.constants.arrays import (
    Array,
    common,
    conjugate,
    matrix,
    module,
    multiply,
    norm,
    normalize,
    product,
    rotate,
    transpose,
)
from simreal.constants.pose import Pose, Skeleton, longest

_SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX = (
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
    for name in ("SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX")
)
_NONE, _BODY, _INERTIA, _BODYROT, _INERTIAROT = (
    int(getattr(mujoco.mjtSameFrame, f"mjSAMEFRAME_{name}"))
    for name in ("NONE", "BODY", "INERTIA", "BODYROT", "INERTIAROT")
)
_SAME = 1e-6  # below it, MuJoCo takes two frames for one


class Shapes:
    """Which geom has what shape and hangs on which body, and the tree of bounding boxes. Static, NumPy."""

    def __init__(self, model: mujoco.MjModel, skeleton: Skeleton):
        self.geom_body, self.site_body = model.geom_bodyid.copy(), model.site_bodyid.copy()
        kinds = (_SPHERE, _CAPSULE, _ELLIPSOID, _CYLINDER, _BOX)
        self.primitive = np.isin(model.geom_type, kinds)
        self.formula = np.array([kinds.index(kind) if kind in kinds else 0 for kind in model.geom_type], int)
        self.nominal_radius, self.nominal_box = model.geom_rbound.copy(), model.geom_aabb.copy()
        self.geoms_of = [np.flatnonzero(self.geom_body == body).tolist() for body in range(model.nbody)]
        # a joint bears on the size of its body and of that one's parent
        self.joint_ends = np.concatenate([model.jnt_bodyid, skeleton.parent[model.jnt_bodyid]])
        self.joints_of = [np.flatnonzero(self.joint_ends == body).tolist() for body in range(model.nbody)]

        # The rows of bvh_aabb that belong to bodies, and the leaves (rows of geoms) below each of them.
        rows = int(model.body_bvhnum.sum())
        self.leaf_geom = np.array([geom for geom in model.bvh_nodeid[:rows] if geom >= 0], int)
        leaf_of_row = np.full(rows, -1)
        leaf_of_row[model.bvh_nodeid[:rows] >= 0] = np.arange(len(self.leaf_geom))
        self.leaves: list[list[int]] = [[] for _ in range(rows)]
        for body in range(model.nbody):
            start, number = model.body_bvhadr[body], model.body_bvhnum[body]
            for row in sorted(range(start, start + number), key=lambda row: -model.bvh_depth[row]):
                if leaf_of_row[row] >= 0:
                    self.leaves[row] = [int(leaf_of_row[row])]
                else:
                    left, right = (start + child for child in model.bvh_child[row])
                    self.leaves[row] = self.leaves[left] + self.leaves[right]


class Bounds:
    """Bounding volumes and length scales of one world."""

    def __init__(self, shapes: Shapes, skeleton: Skeleton, field: Callable[[str], Array], pose: Pose):
        self.shapes = shapes
        self.skeleton = skeleton
        self.field = field
        self.pose = pose

    @cached_property
    def geom_radius(self) -> Array:
        """geom_rbound, (ngeom,), m: radius of the sphere around a geom; nominal for planes and meshes."""
        size = self.field("geom_size")
        xp, size, nominal = common(size, self.shapes.nominal_radius)
        x, y, z = (size[:, i] for i in range(3))
        by_kind = xp.stack([x, x + y, xp.maximum(xp.maximum(x, y), z), xp.sqrt(x * x + y * y), norm(size)])
        return xp.where(self.shapes.primitive, by_kind[self.shapes.formula, np.arange(len(x))], nominal)

    @cached_property
    def geom_box(self) -> Array:
        """geom_aabb, (ngeom, 6), m: centre and half size in the geom's frame."""
        xp, size, nominal = common(self.field("geom_size"), self.shapes.nominal_box)
        x, y = size[:, 0], size[:, 1]
        sphere, capsule, cylinder = (xp.stack([x, x, z], axis=1) for z in (x, x + y, y))
        by_kind = xp.stack([sphere, capsule, size, cylinder, size])
        half = by_kind[self.shapes.formula, np.arange(len(x))]
        box = xp.concatenate([xp.zeros_like(half), half], axis=1)
        return xp.where(self.shapes.primitive[:, None], box, nominal)

    @cached_property
    def body_boxes(self) -> Array:
        """The bodies' rows of bvh_aabb, (rows, 6), m: centre and half size in axes of inertia."""
        geom = self.shapes.leaf_geom
        body, box = self.shapes.geom_body[geom], self.geom_box[geom]
        back = transpose(matrix(normalize(self.field("body_iquat"))))[body]
        axes = product(back, matrix(normalize(self.field("geom_quat")))[geom])
        _, pos, origin = common(self.field("geom_pos")[geom], self.field("body_ipos")[body])
        _, offset, centre = common(rotate(back, pos - origin), rotate(axes, box[:, :3]))
        xp, centre, axes, half = common(offset + centre, axes, box[:, 3:])
        half = (xp.abs(axes) * half[:, None, :]).sum(2)
        if not len(geom):
            return np.zeros((0, 6))
        width = max(len(leaves) for leaves in self.shapes.leaves)
        below = np.array([leaves + leaves[:1] * (width - len(leaves)) for leaves in self.shapes.leaves], int)
        low, high = (centre - half)[below].min(1), (centre + half)[below].max(1)
        alone = np.array([len(leaves) == 1 for leaves in self.shapes.leaves])[:, None]
        union = xp.concatenate([(low + high) / 2, (high - low) / 2], axis=1)
        return xp.where(alone, xp.concatenate([centre, half], axis=1)[below[:, 0]], union)

    @cached_property
    def body_margin(self) -> Array:
        """body_margin, (nbody,), m: the largest margin plus gap of a body's geoms."""
        _, margin, gap = common(self.field("geom_margin"), self.field("geom_gap"))
        return longest(margin + gap, self.shapes.geoms_of)

    @cached_property
    def dof_length(self) -> Array:
        """dof_length, (nv,): 1 for a translation; for a rotation the size of the body, m."""
        tree = self.skeleton
        centre, anchors = self.pose.inertial[0], self.pose.anchors
        ends, joints = self.shapes.joint_ends, np.arange(len(tree.joint_body))
        _, near, far = common(centre[ends], anchors[np.concatenate([joints, joints])])
        reach = longest(norm(near - far), self.shapes.joints_of)
        geoms = self.pose.points(self.shapes.geom_body, self.field("geom_pos"))
        _, near, far, radius = common(centre[self.shapes.geom_body], geoms, self.geom_radius)
        outer = module(radius).where(radius > 0, radius + norm(near - far), radius * 0)
        xp, reach, outer = common(reach, longest(outer, self.shapes.geoms_of))
        size = xp.maximum(xp.maximum(reach, outer), 1e-5)[tree.joint_body[tree.dof_joint]]
        return xp.where(tree.dof_turns, size, xp.ones_like(size))

    @cached_property
    def body_sameframe(self) -> Array:
        """body_sameframe, (nbody,) uint8: whether the axes of inertia are the body's frame (mjtSameFrame)."""
        origin, unturned = _near_zero(self.field("body_ipos")), _near_identity(self.field("body_iquat"))
        xp = module(origin, unturned)
        return xp.where(unturned, xp.where(origin, _BODY, _BODYROT), _NONE).astype(np.uint8)

    def sameframe(self, kind: str) -> Array:
        """geom_sameframe or site_sameframe, (n,) uint8: whether a frame is the body's or its inertia's."""
        body = getattr(self.shapes, f"{kind}_body")
        pos, quat = self.field(f"{kind}_pos"), self.field(f"{kind}_quat")
        _, offset, centre = common(pos, self.field("body_ipos")[body])
        _, turn, back = common(quat, conjugate(self.field("body_iquat"))[body])
        origin, unturned = _near_zero(pos), _near_identity(quat)
        at_centre, as_inertia = _near_zero(offset - centre), _near_identity(multiply(back, turn))
        xp = module(origin, unturned, at_centre, as_inertia)
        other = xp.where(as_inertia, xp.where(at_centre, _INERTIA, _INERTIAROT), _NONE)
        return xp.where(unturned, xp.where(origin, _BODY, _BODYROT), other).astype(np.uint8)


def _near_zero(pos: Array) -> Array:
    return (module(pos).abs(pos) < _SAME).all(-1)


def _near_identity(quat: Array) -> Array:
    xp, quat, identity = common(quat, np.array([[1.0, 0.0, 0.0, 0.0]]))
    return (xp.abs(quat - identity) < _SAME).all(-1) | (xp.abs(quat + identity) < _SAME).all(-1)
