"""derived_constants against mj_setConst of MuJoCo C, on random draws of every factor that it serves."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from simreal.constants import derived_constants
from simreal.errors import UserError

DRAWS = 50
TOLERANCE = {jnp.float32: 1e-4, jnp.float64: 1e-8}  # relative
FLOOR = {jnp.float32: 2e-6, jnp.float64: 1e-11}  # of the largest entry of the field, for entries near zero
NOT_DERIVED = {"jnt_actuatorid", "tendon_actuatorid"}  # switches, see derived_constants

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
      <body name="tail" pos="-0.2 0 0"><joint axis="0 1 1"/><geom type="box" size="0.1 0.02 0.02" pos="-0.1 0 0"/></body>
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
        <body name="wheel" pos="0.4 0 0"><joint name="spin" axis="0 1 0"/><geom type="cylinder" size="0.1 0.02"
          euler="90 0 0"/></body>
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
    <spatial name="straight" armature="0.05"><site site="anchor"/><site site="s1"/><site site="s3"/></spatial>
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
        <joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.02"/><site name="end" pos="0.5 0 0"/>
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
  <actuator><motor joint="crank"/><motor cranksite="pin" slidersite="guide" cranklength="0.9" gear="2"/></actuator>
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
SHIFTED = {
    **{f"{kind}_pos": 0.02 for kind in ("body", "jnt", "geom", "site", "cam", "light")},
    **{"body_ipos": 0.02, "geom_margin": 0.01, "geom_gap": 0.01, "eq_data": 0.02, "wrap_prm": 0.1},
    **{"qpos0": 0.3, "dof_armature": 0.01, "actuator_cranklength": 0.01, "light_dir": 0.1, "jnt_axis": 0.1},
    **{f"{kind}_quat": 0.1 for kind in ("body", "geom", "site", "cam")},
    "body_iquat": 0.1,
}
FACTORS = (*SCALED, *SHIFTED)


def draw(model: mujoco.MjModel, names: tuple[str, ...], count: int) -> dict[str, np.ndarray]:
    """Random values of fields, (count, ...), that MuJoCo would accept."""
    rng = np.random.default_rng(0)
    drawn = {}
    for name in names:
        nominal = getattr(model, name)
        shape = (count, *nominal.shape)
        if name in SCALED:
            value = nominal * rng.uniform(0.7, 1.4, shape)
        elif name in ("dof_armature", "geom_margin", "geom_gap"):
            value = nominal + rng.uniform(0, SHIFTED[name], shape)
        else:
            value = nominal + rng.normal(0, SHIFTED[name], shape)
        drawn[name] = value
    for name, value in drawn.items():
        nominal = getattr(model, name)
        if name.endswith("quat") or name == "jnt_axis":
            value /= np.maximum(np.linalg.norm(value, axis=-1, keepdims=True), 1e-9)
        if name in ("body_ipos", "body_iquat"):
            # C refuses these for simple bodies; every third other body keeps them too, to keep its sameframe
            kept = (model.body_simple > 0) | (np.arange(model.nbody) % 3 == 0)
            value[:, kept] = nominal[kept]
        elif name in ("body_pos", "body_quat"):
            value[:, 0] = nominal[0]
        elif name == "qpos0":
            for joint in range(model.njnt):
                if model.jnt_type[joint] in (mujoco.mjtJoint.mjJNT_FREE, mujoco.mjtJoint.mjJNT_BALL):
                    start = model.jnt_qposadr[joint] + 3 * (model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE)
                    value[:, start : start + 4] /= np.linalg.norm(value[:, start : start + 4], axis=1, keepdims=True)
        elif name == "wrap_prm":  # what is not the coefficient of a joint or a divisor is the number of a site
            site = model.wrap_type >= int(mujoco.mjtWrap.mjWRAP_SITE)
            value[:, site] = nominal[site]
        elif name == "eq_data":  # only the anchors of connects and welds between bodies
            fixed = (model.eq_objtype != mujoco.mjtObj.mjOBJ_BODY) | (model.eq_type > int(mujoco.mjtEq.mjEQ_WELD))
            value[:, :, 3:] = nominal[:, 3:]
            value[:, fixed] = nominal[fixed]
    return drawn


def snapshot(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Every array of a model, and of its options and statistics; of large ones (meshes) the start."""
    parts = {"": model, "opt.": model.opt, "stat.": model.stat}
    named = {
        prefix + name: getattr(part, name)
        for prefix, part in parts.items()
        for name in dir(part)
        if not name.startswith("_")
    }
    return {name: np.array(value[:2000] if np.ndim(value) else value) for name, value in named.items()
            if isinstance(value, (np.ndarray, float))}


def by_c(model: mujoco.MjModel, drawn: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], set[str]]:
    """All fields after mj_setConst, (draws, ...), and the names of those that it changed in some draw."""
    data, results, changed = mujoco.MjData(model), [], set()
    nominal = {name: getattr(model, name).copy() for name in drawn}
    before = snapshot(model)
    for row in range(len(next(iter(drawn.values())))):
        for name, value in drawn.items():
            getattr(model, name)[:] = before[name] = value[row]
        mujoco.mj_resetData(model, data)
        mujoco.mj_setConst(model, data)
        after = snapshot(model)
        changed |= {name for name in after if not np.allclose(before[name], after[name], rtol=1e-9, atol=1e-12)}
        results.append(after)
        before = dict(after)
    for name, value in nominal.items():
        getattr(model, name)[:] = value
    mujoco.mj_setConst(model, data)
    return {name: np.stack([result[name] for result in results]) for name in results[0]}, changed


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("name", MODELS)
def test_agrees_with_c(name: str, dtype: jnp.dtype) -> None:
    """Every field that mj_setConst changes, within 1e-4 in single and 1e-8 in double precision."""
    model = MODELS[name]()
    names = tuple(field for field in FACTORS if getattr(model, field).size)
    drawn = {field: value.astype(dtype).astype(float) for field, value in draw(model, names, DRAWS).items()}
    expected, changed = by_c(model, drawn)
    with jax.enable_x64(dtype == jnp.float64):
        derive = jax.jit(jax.vmap(derived_constants(model, names)))
        derived = {
            field: np.asarray(value)
            for field, value in derive({field: jnp.asarray(value, dtype) for field, value in drawn.items()}).items()
        }
    assert changed - NOT_DERIVED <= set(derived)
    for field, value in derived.items():
        reference = expected[field]
        if field == "bvh_aabb":
            reference = reference[:, : value.shape[1]]
        assert value.shape == reference.shape, field
        if value.dtype == np.uint8:
            np.testing.assert_array_equal(value, reference, err_msg=field)
            continue
        assert value.dtype == dtype
        floor = FLOOR[dtype] * np.abs(reference[np.abs(reference) < 1e9]).max(initial=0)
        tolerance = max(TOLERANCE[dtype], 1e-6 if name == "inside_wrap" else 0)  # C stops its iteration there
        np.testing.assert_allclose(value, reference, rtol=tolerance, atol=floor, err_msg=field)
