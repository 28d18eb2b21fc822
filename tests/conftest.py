"""What the tests share: compiled programs are the expensive part, so environments are made once."""

from __future__ import annotations

import functools
import os
from pathlib import Path

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
_LOCAL_MODELS = Path(__file__).resolve().parents[2] / "shared" / "menagerie"
if _LOCAL_MODELS.is_dir():
    os.environ.setdefault("MENAGERIE_ROOT", str(_LOCAL_MODELS))

import jax  # noqa: E402
import pytest  # noqa: E402

import simreal  # noqa: E402
from simreal.compilation import enable_cache  # noqa: E402
from simreal.environment import Environment  # noqa: E402

enable_cache()

ENVIRONMENTS = ("arm_reach", "cartpole_swingup", "go2_walk")


@functools.cache
def environment(name: str, engine: str = "mujoco") -> Environment:
    """An environment with its training ranges; skips the test where its model cannot be had."""
    return make(name, engine=engine)


def make(name: str, **arguments) -> Environment:
    """`simreal.make`, but the test is skipped where the environment's model cannot be had."""
    try:
        return simreal.make(name, **arguments)
    except simreal.UserError as error:
        if "cannot be had" in str(error):
            pytest.skip(str(error))
        raise


@functools.cache
def batched_reset(name: str, engine: str = "mujoco"):
    """jit(vmap(reset)) over keys."""
    return jax.jit(jax.vmap(environment(name, engine).reset))


@functools.cache
def batched_step(name: str, engine: str = "mujoco"):
    """jit(vmap(step)) over states and actions."""
    return jax.jit(jax.vmap(environment(name, engine).step))


def keys(n: int, seed: int = 0) -> jax.Array:
    """n keys."""
    return jax.random.split(jax.random.PRNGKey(seed), n)
