"""derived_constants against mj_setConst of MuJoCo C, on random draws of every factor that it serves."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Iterable
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np
import pytest
from mujoco import mjx

from simreal.constants import C_ONLY, derived_constants
from simreal.errors import UserError

DRAWS = 50
TOLERANCE = {jnp.float32: 1e-4, jnp.float64: 1e-8}  # relative
FLOOR = {jnp.float32: 2e-6, jnp.float64: 1e-11}  # of the largest entry of the field, for entries near zero
SWITCHES = {"jnt_actuatorid", "tendon_actuatorid"}  # not derived, see derived_constants
JAX_FIELDS = {field.name for field in dataclasses.fields(mjx.Model) if field.type is jax.Array}

CARTPOLE = """
<mujoco>
  <worldbody>
    <light pos="0 -2 2" mode="trackcom"/>
    <camera name="side" pos="0 -3 1" mode="track"/>
    <body name="cart" pos="0 0 1">
      <joint name="slider" type="slide" axis="1 0 0" armature="0.1"/>
      <geom type="box" size="0.1 0.05 0.05" mass="1"/>
      <body name="pole" pos="0 0 0.05">
        <joint name="hinge" axis="0 1 0" pos="0 0 -0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.6" size="0.02" mass="0.2" margin="0.01" gap="0.002"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="slider" gear="10"/><position joint="hinge" kp="2"/></actuator>
</mujoco>"""

FREE_BODY = """
<mujoco>
  <asset><mesh name="wedge" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1 .1 .1 .1"/></asset>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    <geom type="box" size="0.2 0.2 0.1" pos="2 0 0"/>
    <camera pos="-3 0 2" mode="targetbodycom" target="trunk"/>
    <body name="trunk" pos="0 0 0.5" simple="false">
      <freejoint/>
      <inertial pos="0.01 0 0.02" mass="4" fullinertia="0.05 0.08 0.1 0.002 0.003 0.001"/>
      <geom type="box" size="0.2 0.1 0.05"/>
      <geom type="sphere" size="0.05" pos="0.2 0 0.05" margin="0.01"/>
      <geom type="ellipsoid" size="0.05 0.08 0.1" pos="-0.2 0 0.05" euler="10 20 30"/>
      <geom type="mesh" mesh="wedge" pos="0 0.1 0.1"/>
      <camera pos="0.2 0 0.1" euler="0 80 10"/>
      <light pos="0.2 0 0.2" dir="1 0 -1"/>
      <site name="imu" pos="0.05 0 0"/>
      <body name="shoulder" pos="0.2 0.1 0" euler="0 0 20">
        <joint name="roll" axis="1 0 0" armature="0.01"/>
        <geom type="cylinder" size="0.03 0.04" pos="0 0.05 0" euler="90 0 0"/>
        <body name="leg" pos="0 0.1 0">
          <joint name="pitch" axis="0 1 0" ref="0.3" armature="0.01"/>
          <joint name="slide" type="slide" axis="0 0 1"/>
          <geom type="capsule" size="0.02 0.1" pos="0 0 -0.1"/>
          <body name="foot" pos="0 0 -0.2"><geom size="0.03"/></body>
        </body>
      </body>
      <body name="tail" pos="-0.2 0 0">
        <joint axis="0 1 1"/><geom type="box" size="0.1 0.02 0.02" pos="-0.1 0 0"/>
      </body>
    </body>
    <body name="simple" pos="3 0 1"><freejoint/><geom type="box" size="0.1 0.1 0.2"/></body>
    <body name="fixed" pos="0 3 0"><geom size="0.1"/></body>
    <body name="mocap" mocap="true" pos="0 4 0"><geom size="0.1"/></body>
  </worldbody>
  <actuator>
    <position joint="roll" kp="20"/><motor joint="pitch" gear="3" armature="0.002"/>
    <general site="imu" gear="1 0 2 0 1 0"/><adhesion body="foot" ctrlrange="0 1"/>
  </actuator>
</mujoco>"""

BALL = """
<mujoco>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0" pos="0 0.1 0"/>
      <joint name="ball" type="ball" pos="0.1 0.02 0" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03"/>
      <site name="tip" pos="0.4 0 0" euler="10 20 30"/>
      <body name="lower" pos="0.4 0 0">
        <joint name="ball2" type="ball"/>
        <geom type="ellipsoid" size="0.2 0.05 0.03" pos="0.2 0 0"/>
        <site name="hand" pos="0.4 0 0.1" euler="70 0 20"/>
        <body name="wheel" pos="0.4 0 0">
          <joint name="spin" axis="0 1 0"/><geom type="cylinder" size="0.1 0.02" euler="90 0 0"/>
        </body>
      </body>
    </body>
    <body name="flywheel" pos="1 0 0"><joint axis="0 0 1"/><geom type="cylinder" size="0.1 0.02"/></body>
    <body name="sliders" pos="2 0 0"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>
      <geom type="box" size="0.1 0.1 0.1"/></body>
  </worldbody>
  <actuator>
    <motor joint="ball" gear="1 2 3"/><motor jointinparent="ball2" gear="3 0 1"/>
    <general site="hand" refsite="tip" gear="1 2 0 0.5 0 1"/><motor joint="spin"/>
  </actuator>
</mujoco>"""

TENDONS = """
<mujoco>
  <worldbody>
    <site name="anchor" pos="0 0 1"/><site name="anchor2" pos="0.1 0.2 1"/>
    <geom name="drum" type="cylinder" size="0.05 0.2" pos="0.05 0 0.7" euler="90 0 0"/>
    <site name="side" pos="0.3 0 0.7"/>
    <body name="arm" pos="0 0 0.5">
      <joint name="a" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
      <site name="s1" pos="0.1 0.02 0.03"/><site name="s2" pos="0.3 0.01 0.02"/>
      <body name="fore" pos="0.3 0 0">
        <joint name="b" axis="0 1 0" armature="0.01"/>
        <joint name="c" axis="0 0 1"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
        <geom name="knuckle" type="sphere" size="0.04"/>
        <site name="s3" pos="0.2 0 0.03"/><site name="s4" pos="0.25 0.05 0"/>
      </body>
    </body>
    <body name="weight" pos="1 0 0"><joint name="d" type="slide" axis="0 0 1" ref="0.2"/><geom size="0.05"/>
      <site name="s5"/></body>
  </worldbody>
  <tendon>
    <fixed name="fixed"><joint joint="a" coef="0.5"/><joint joint="d" coef="-2"/></fixed>
    <spatial name="straight" armature="0.05"><site site="anchor"/><site site="s1"/><site site="s3"/>
      <site site="s5"/></spatial>
    <spatial name="pulley">
      <site site="anchor2"/><site site="s2"/><pulley divisor="2"/><site site="s2"/><site site="s4"/>
      <pulley divisor="3"/><site site="anchor"/><site site="s5"/>
    </spatial>
    <spatial name="outside"><site site="anchor"/><geom geom="drum" sidesite="side"/><site site="s1"/>
      <site site="s2"/><geom geom="knuckle"/><site site="s4"/></spatial>
  </tendon>
  <actuator><motor tendon="fixed" gear="2"/><motor tendon="straight" gear="3" armature="0.01"/>
    <motor tendon="outside"/><motor joint="c"/></actuator>
</mujoco>"""

INSIDE_WRAP = """
<mujoco>
  <worldbody>
    <site name="anchor" pos="0.1 0.2 0.7"/>
    <body pos="0 0 0.5">
      <joint axis="0 1 0"/>
      <geom name="ring" type="sphere" size="0.1" pos="0.15 0.05 0"/><site name="inside" pos="0.17 0.05 0.02"/>
      <body pos="0.3 0 0"><joint axis="1 1 0"/><geom size="0.1"/><site name="end" pos="0.2 0 0.03"/></body>
    </body>
  </worldbody>
  <tendon>
    <spatial name="t"><site site="anchor"/><geom geom="ring" sidesite="inside"/><site site="end"/></spatial>
  </tendon>
  <actuator><motor tendon="t"/></actuator>
</mujoco>"""

EQUALITY = """
<mujoco>
  <worldbody>
    <body name="crank" pos="0 0 0.2">
      <joint name="crank" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 0.2" size="0.02"/>
      <site name="pin" pos="0 0 0.2"/>
      <body name="coupler" pos="0 0 0.2">
        <joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.02"/>
        <site name="end" pos="0.5 0 0"/>
      </body>
    </body>
    <body name="rocker" pos="0.5 0 0.1">
      <joint name="rocker" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 0.3" size="0.02"/>
      <site name="top" pos="0 0 0.3"/>
    </body>
    <body name="piston" pos="0.6 0.5 0.2" simple="false"><joint name="piston" type="slide" axis="1 0 0"/>
      <geom type="box" size="0.05 0.05 0.05"/><site name="guide" euler="0 90 0"/></body>
    <body name="box" pos="0 1 1" simple="false"><freejoint/><geom type="box" size="0.1 0.2 0.3"/></body>
  </worldbody>
  <equality>
    <connect body1="coupler" body2="rocker" anchor="0.5 0.02 0"/><connect body1="box" anchor="0.1 0 0"/>
    <weld body1="box" body2="piston"/><connect site1="end" site2="top"/>
    <joint joint1="crank" joint2="rocker" polycoef="0 2 0 0 0"/>
  </equality>
  <actuator>
    <motor joint="crank"/><motor cranksite="pin" slidersite="guide" cranklength="0.9" gear="2"/>
  </actuator>
</mujoco>"""


def go2() -> mujoco.MjModel:
    """The Menagerie's Unitree Go2, from a local copy where there is one."""
    local = Path(__file__).resolve().parents[2] / "shared" / "menagerie"
    if local.is_dir():
        os.environ.setdefault("MENAGERIE_ROOT", str(local))
    menagerie = pytest.importorskip("mujoco_menagerie")
    try:
        return menagerie.load("unitree_go2", "scene_mjx")
    except (menagerie.MenagerieError, OSError) as error:
        pytest.skip(f"no model of the Unitree Go2 to be had: {error}")


MODELS: dict[str, Callable[[], mujoco.MjModel]] = {
    "cartpole": lambda: mujoco.MjModel.from_xml_string(CARTPOLE),
    "free_body": lambda: mujoco.MjModel.from_xml_string(FREE_BODY),
    "ball": lambda: mujoco.MjModel.from_xml_string(BALL),
    "tendons": lambda: mujoco.MjModel.from_xml_string(TENDONS),
    "inside_wrap": lambda: mujoco.MjModel.from_xml_string(INSIDE_WRAP),
    "equality": lambda: mujoco.MjModel.from_xml_string(EQUALITY),
    "go2": go2,
}

SCALED = ("body_mass", "body_inertia", "geom_size", "tendon_armature", "actuator_armature", "actuator_gear")
ADDED = {"dof_armature": 0.01, "geom_margin": 0.01, "geom_gap": 0.01}  # up to
POSITIONS = ("body_pos", "body_ipos", "jnt_pos", "geom_pos", "site_pos", "cam_pos", "light_pos")
QUATERNIONS = ("body_quat", "body_iquat", "geom_quat", "site_quat", "cam_quat")
SHIFTED = {  # by a standard deviation of
    **dict.fromkeys(POSITIONS, 0.02),
    **dict.fromkeys(QUATERNIONS, 0.1),
    "light_dir": 0.1,
    "jnt_axis": 0.1,
    "qpos0": 0.3,
    "eq_data": 0.02,
    "wrap_prm": 0.1,
    "actuator_cranklength": 0.01,
}
FACTORS = (*SCALED, *ADDED, *SHIFTED)


def draw(model: mujoco.MjModel, names: Iterable[str], count: int) -> dict[str, np.ndarray]:
    """Random values of fields, (count, ...), that MuJoCo accepts."""
    rng = np.random.default_rng(0)
    drawn = {}
    for name in names:
        nominal = getattr(model, name)
        shape = (count, *nominal.shape)
        if name in SCALED:
            value = nominal * rng.uniform(0.7, 1.4, shape)
        elif name in ADDED:
            value = nominal + rng.uniform(0, ADDED[name], shape)
        else:
            value = nominal + rng.normal(0, SHIFTED[name], shape)
        if name in QUATERNIONS or name == "jnt_axis":
            value /= np.maximum(np.linalg.norm(value, axis=-1, keepdims=True), 1e-9)
        kept = constant_rows(model, name)
        value[:, kept] = nominal[kept]
        if name == "qpos0":
            for kind, start in ((mujoco.mjtJoint.mjJNT_FREE, 3), (mujoco.mjtJoint.mjJNT_BALL, 0)):
                for joint in np.flatnonzero(model.jnt_type == kind):
                    quat = slice(model.jnt_qposadr[joint] + start, model.jnt_qposadr[joint] + start + 4)
                    value[:, quat] /= np.linalg.norm(value[:, quat], axis=1, keepdims=True)
        elif name == "eq_data":  # only the anchor is a length
            value[:, :, 3:] = nominal[:, 3:]
        drawn[name] = value
    return drawn


def constant_rows(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Rows of a field that must not vary, as a mask."""
    if name in ("body_ipos", "body_iquat"):
        # C refuses simple bodies; one in three of the others keeps these too, to keep its sameframe
        return (model.body_simple > 0) | (np.arange(model.nbody) % 3 == 0)
    if name == "wrap_prm":  # if not the coefficient of a joint or a divisor, the number of a site
        return model.wrap_type >= int(mujoco.mjtWrap.mjWRAP_SITE)
    if name == "eq_data":
        between_bodies = model.eq_objtype == mujoco.mjtObj.mjOBJ_BODY
        return ~between_bodies | (model.eq_type > int(mujoco.mjtEq.mjEQ_WELD))
    return np.zeros(len(getattr(model, name)), bool)


def by_c(model: mujoco.MjModel, drawn: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], set[str]]:
    """All fields after mj_setConst, (draws, ...), and the names of those that it changed in some draw."""
    parts = {"": model, "opt.": model.opt, "stat.": model.stat}
    places = {
        prefix + name: (part, name)
        for prefix, part in parts.items()
        for name in dir(part)
        if not name.startswith("_") and isinstance(getattr(part, name), (np.ndarray, float))
    }

    def snapshot() -> dict[str, np.ndarray]:
        values = {label: getattr(part, name) for label, (part, name) in places.items()}
        return {label: np.array(value[:2000] if np.ndim(value) else value) for label, value in values.items()}

    data, results, changed = mujoco.MjData(model), [], set()
    nominal = snapshot()
    before = dict(nominal)
    for row in range(len(next(iter(drawn.values())))):
        for name, value in drawn.items():
            getattr(model, name)[:] = before[name] = value[row]
        mujoco.mj_resetData(model, data)
        mujoco.mj_setConst(model, data)
        after = snapshot()
        changed |= {
            name
            for name, value in after.items()
            if value.tobytes() != before[name].tobytes()
            and not np.allclose(before[name], value, rtol=1e-9, atol=1e-12)
        }
        results.append(after)
        before = dict(after)
    for name in drawn:
        getattr(model, name)[:] = nominal[name]
    mujoco.mj_setConst(model, data)
    return {name: np.stack([result[name] for result in results]) for name in results[0]}, changed


def by_jax(model: mujoco.MjModel, drawn: dict[str, np.ndarray], dtype: jnp.dtype) -> dict[str, np.ndarray]:
    """What derived_constants makes of the draws, (draws, ...), under JAX's strictest rules for promotion."""
    with (
        jax.enable_x64(dtype == jnp.float64),
        jax.numpy_rank_promotion("raise"),
        jax.numpy_dtype_promotion("strict"),
    ):
        arrays = {name: jnp.asarray(value, dtype) for name, value in drawn.items()}
        function = jax.vmap(derived_constants(model, drawn))
        # half the time to compile; nothing in here runs for long
        compiled = jax.jit(function, compiler_options={"xla_backend_optimization_level": 0})
        return {name: np.asarray(value) for name, value in compiled(arrays).items()}


def assert_same(
    derived: dict[str, np.ndarray], expected: dict[str, np.ndarray], dtype: jnp.dtype, tolerance: float
) -> None:
    """Every derived field is what C made of it."""
    for field, value in derived.items():
        reference = expected[field]
        if field == "bvh_aabb":  # only the rows of bodies
            reference = reference[:, : value.shape[1]]
        assert value.shape == reference.shape, field
        if reference.dtype == np.uint8:
            np.testing.assert_array_equal(value, reference, err_msg=field)
            continue
        assert value.dtype == dtype
        floor = FLOOR[dtype] * np.abs(reference[np.abs(reference) < 1e9]).max(initial=0)
        np.testing.assert_allclose(value, reference, rtol=tolerance, atol=floor, err_msg=field)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("name", MODELS)
def test_agrees_with_c(name: str, dtype: jnp.dtype) -> None:
    """All factors at once: every field that mj_setConst changes, and C and MJX can take them."""
    model = MODELS[name]()
    names = [field for field in FACTORS if getattr(model, field).size]
    drawn = {field: value.astype(dtype).astype(float) for field, value in draw(model, names, DRAWS).items()}
    expected, changed = by_c(model, drawn)
    derived = by_jax(model, drawn, dtype)
    assert changed - SWITCHES <= set(derived)
    assert set(derived) <= mujoco.batch.MODEL_FIELDS
    assert set(derived) - C_ONLY <= JAX_FIELDS
    # in double precision C's own iteration for a tendon inside a ring stops at about 1e-7
    tolerance = max(TOLERANCE[dtype], 1e-6 if name == "inside_wrap" else 0)
    assert_same(derived, expected, dtype, tolerance)


INERTIA = {"dof_M0", "body_invweight0", "dof_invweight0", "actuator_acc0"}


@pytest.mark.parametrize(
    ("name", "varied", "fields"),
    [
        ("cartpole", ["dof_damping", "geom_friction", "opt.gravity", "actuator_gainprm"], set()),
        ("cartpole", ["dof_armature", "body_inertia"], INERTIA),
        ("cartpole", ["body_mass"], INERTIA | {"body_subtreemass", "cam_poscom0", "light_poscom0"}),
        ("cartpole", ["qpos0"], {"actuator_length0"}),
        ("cartpole", ["actuator_gear"], {"actuator_length0", "actuator_acc0"}),
        ("cartpole", ["geom_margin"], {"body_margin"}),
        ("cartpole", ["geom_size"], {"geom_rbound", "geom_aabb", "bvh_aabb", "dof_length"}),
        ("tendons", ["body_mass"], INERTIA | {"body_subtreemass", "tendon_invweight0"}),
        ("tendons", ["qpos0"], {"actuator_length0", "tendon_length0"}),
        ("equality", ["eq_data"], {"eq_data"}),
    ],
)
def test_only_what_depends(name: str, varied: list[str], fields: set[str]) -> None:
    """One factor alone: only the fields that C changes for it, the rest being nominal and not compiled."""
    model = MODELS[name]()
    drawn = draw(model, [field for field in varied if field in FACTORS], 3)
    for field in set(varied) - set(drawn):
        part = model.opt if field.startswith("opt.") else model
        drawn[field] = np.tile(getattr(part, field.removeprefix("opt.")), (3, 1, 1))
    derived = by_jax(model, drawn, jnp.float64)
    assert set(derived) == fields
    if fields:
        expected, changed = by_c(model, drawn)
        assert changed <= fields  # the length of a motor stays 0 where qpos0 is
        assert_same(derived, expected, jnp.float64, TOLERANCE[jnp.float64])


def test_geom_sizes_as_compiled() -> None:
    """Bounds of resized geoms are those of a model compiled with the new sizes."""
    shapes = ("sphere", "capsule", "ellipsoid", "cylinder", "box")
    geoms = [
        f'<geom type="{shape}" size="0.1 0.2 0.3" pos="{x} 0.3 0" euler="{20 * x} 30 40"/>'
        for x, shape in enumerate(shapes)
    ]
    inertial = '<inertial pos="0.1 0 0" mass="1" fullinertia="1 1.2 1.3 0.1 0.2 0.1"/>'
    body = f"<body><freejoint/>{inertial}{''.join(geoms)}</body><body pos='0 9 0'>{geoms[3]}</body>"
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{''.join(geoms)}{body}</worldbody></mujoco>")
    model = spec.compile()
    size = draw(model, ["geom_size"], 1)["geom_size"]
    for geom, new in zip(spec.geoms, size[0], strict=True):
        geom.size = new
    compiled = spec.compile()
    derived = by_jax(model, {"geom_size": size}, jnp.float64)
    np.testing.assert_allclose(derived["geom_rbound"][0], compiled.geom_rbound, rtol=1e-12)
    np.testing.assert_allclose(derived["geom_aabb"][0], compiled.geom_aabb, rtol=1e-12, atol=1e-12)
    roots = model.body_bvhadr[model.body_bvhnum > 0]
    np.testing.assert_allclose(derived["bvh_aabb"][0, roots], compiled.bvh_aabb[roots], atol=1e-12)


@pytest.mark.parametrize(
    "world",
    ["", '<geom size="1"/>', '<body><joint/><inertial pos="1 0 0" mass="1" diaginertia="1 1 1"/></body>'],
)
def test_models_with_next_to_nothing(world: str) -> None:
    """No dofs, no geoms, no actuators."""
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{world}</worldbody></mujoco>")
    drawn = draw(model, [field for field in FACTORS if getattr(model, field).size], 2)
    expected, changed = by_c(model, drawn)
    derived = by_jax(model, drawn, jnp.float64)
    assert changed <= set(derived)
    assert_same(derived, expected, jnp.float64, TOLERANCE[jnp.float64])


def test_gradients_are_finite() -> None:
    """No square root or division of a zero spoils a gradient."""
    model = MODELS["free_body"]()
    derive = derived_constants(model, ["body_mass", "body_ipos", "geom_size"])

    @jax.jit
    @jax.grad
    def slope(fields: dict[str, jax.Array]) -> jax.Array:
        return sum(value.sum() for value in derive(fields).values() if value.dtype == jnp.float32)

    given = {name: jnp.asarray(getattr(model, name)) for name in ("body_mass", "body_ipos", "geom_size")}
    for name, value in slope(given).items():
        assert np.isfinite(value).all(), name


def test_refuses_what_it_cannot_do() -> None:
    """What is not calculated is an error for the user, not a silent nominal value."""
    model = MODELS["cartpole"]()
    with pytest.raises(UserError, match="no field 'body_weight'"):
        derived_constants(model, ["body_weight"])
    with pytest.raises(UserError, match=r"no field 'opt\.wave'"):
        derived_constants(model, ["opt.wave"])
    with pytest.raises(UserError, match="geom_fluid"):
        derived_constants(model, ["geom_fluid"])
    swimmer = CARTPOLE.replace("<geom ", '<geom fluidshape="ellipsoid" ')
    with pytest.raises(UserError, match="ellipsoid"):
        derived_constants(mujoco.MjModel.from_xml_string(swimmer), ["geom_size"])
    with pytest.raises(ValueError, match="body_mass is"):
        derived_constants(model, ["body_mass"])({"body_mass": jnp.ones(2)})
