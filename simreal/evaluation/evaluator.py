"""Runs a policy through sets of worlds, one episode in each, and writes down what happened.

Worlds and keys depend on the set, the world's index and the seed, never on the policy: two policies evaluated
with the same seed met the same worlds and the same noise, so that their differences are paired.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from simreal.compilation import for_rare_use, for_short_use
from simreal.environment import Environment, State
from simreal.errors import UserError, nearest
from simreal.evaluation.ranges import sweep_values
from simreal.evaluation.results import ENDINGS, FactorCurve, HeatMap, SetResult
from simreal.worldsets import TRAIN, WorldSet, digest

Draws = Mapping[str, np.ndarray]
Note = Callable[[str], None]

HARDWARE = ("peak_torque", "saturated_share", "power", "action_rate")
HEAT_MAP_POINTS = 5
POLICY_KEY = 0x706F6C
"""Folded into a world's key for the policy; small numbers give keys that the environment's split uses."""


class PolicyLike(Protocol):
    """Anything that maps an observation to an action: learnt, classical, or written by hand."""

    def initial_state(self) -> Any:
        """The memory at the start of an episode; () for none."""

    def __call__(self, obs: Any, memory: Any, key: Any) -> tuple[Any, Any]:
        """The action for one observation, and the new memory. Runs inside a jitted program."""


class Evaluator:
    """Evaluates one policy on one environment.

    Args:
        env: the environment.
        policy: any policy that JAX can trace.
        seed: of worlds, start states and noise.
        batch: worlds in one call of the compiled program, which is compiled once for all that is evaluated.
    """

    def __init__(self, env: Environment, policy: PolicyLike, seed: int = 0, batch: int = 256) -> None:
        self.env = env
        self.policy = policy
        self.seed = seed
        self.batch = batch
        self._build = jax.jit(jax.vmap(env.randomizer.build), compiler_options=for_rare_use())
        self._episodes = jax.jit(self._run_episodes, compiler_options=for_short_use(env.engine_name))

    # -- what can be asked ---------------------------------------------------------------------------------

    def run_set(self, worldset: WorldSet, worlds: int) -> SetResult:
        """One episode in each world of a named set."""
        draws = worldset.draws(self.env.randomizer, worlds, self.seed)
        self._check_delays(worldset.name, draws)
        outcome = self.run(draws)
        return SetResult(
            name=worldset.name,
            description=worldset.description,
            claims_outside=worldset.claims_outside,
            digest=digest(worldset, draws, self.seed),
            draws=draws,
            **{k: outcome[k] for k in ("episode_return", "success", "steps", "ended_by")},
            hardware={name: outcome[name] for name in HARDWARE},
        )

    def run_factor(self, factor: str, values: np.ndarray, worlds: int) -> FactorCurve:
        """Success as one factor takes each of `values` (m,) and the rest is as in training.

        Raises:
            UserError: an unknown factor.
        """
        builder = self.env.randomizer
        if factor not in builder.bound:
            raise UserError(f"unknown factor {factor!r}; {nearest(factor, builder.bound)}")
        base = TRAIN.draws(builder, worlds, self.seed)
        outcome = self.run(_cross(base, {factor: values}), np.tile(np.arange(worlds), len(values)))
        low, high = builder.bound[factor].factor.distribution.range()
        shape = (len(values), worlds)
        return FactorCurve(
            factor=factor,
            unit=builder.bound[factor].unit,
            values=values,
            episode_return=outcome["episode_return"].reshape(shape),
            success=outcome["success"].reshape(shape),
            train_low=low,
            train_high=high,
        )

    def run_factors(self, points: int, worlds: int, note: Note = lambda text: None) -> dict[str, FactorCurve]:
        """A curve for every factor, across and beyond its training range."""
        curves = {}
        for i, name in enumerate(self.env.randomizer.bound):
            note(f"factor {i + 1} of {len(self.env.randomizer.bound)}: {name}")
            curves[name] = self.run_factor(name, sweep_values(self.env, name, points), worlds)
        return curves

    def run_heat_map(self, curves: Mapping[str, FactorCurve], worlds: int) -> HeatMap | None:
        """A grid over the two factors whose curves move success most; None with fewer than two factors."""
        if len(curves) < 2:
            return None
        ordered = sorted(curves, key=lambda n: float(np.ptp(curves[n].success.mean(axis=1))), reverse=True)
        x, y = ordered[:2]
        values = {n: sweep_values(self.env, n, HEAT_MAP_POINTS) for n in (x, y)}
        crossed = _cross(TRAIN.draws(self.env.randomizer, worlds, self.seed), values)
        index = np.tile(np.arange(worlds), len(values[x]) * len(values[y]))
        outcome = self.run(crossed, index)
        success = outcome["success"].reshape(len(values[x]), len(values[y]), worlds)
        return HeatMap(x, y, values[x], values[y], success)

    def run(self, draws: Draws, index: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """One episode in each of n worlds given by their draws, factor -> (n, ...). All results are (n,).

        Worlds with the same `index` (n,) share start state and noise; default: each has its own.
        """
        worlds = len(next(iter(draws.values()))) if draws else self.batch
        index = np.arange(worlds) if index is None else index
        parts = []
        for begin in range(0, worlds, self.batch):
            rows = np.minimum(np.arange(begin, begin + self.batch), worlds - 1)
            built = self._build({name: jnp.asarray(value[rows]) for name, value in draws.items()})
            parts.append(self._episodes(built, jnp.asarray(index[rows])))
        joined = jax.tree.map(lambda *x: np.concatenate([np.asarray(p) for p in x])[:worlds], *parts)
        joined["success"] = joined["success"] > 0
        return joined

    def _check_delays(self, where: str, draws: Draws) -> None:
        for name, bound in self.env.randomizer.bound.items():
            if bound.factor.target.quantity == "delay":
                self.env.check_delay(f"set {where!r}: {name}", float(np.max(draws[name])))

    # -- the compiled program ------------------------------------------------------------------------------

    def _run_episodes(self, worlds: Any, index: jax.Array) -> dict[str, jax.Array]:
        n = index.shape[0]
        keys = jax.vmap(jax.random.fold_in, in_axes=(None, 0))(jax.random.PRNGKey(self.seed), index)
        state = jax.vmap(lambda key, world: self.env.reset(key, world=world))(keys, worlds)
        memory = jax.tree.map(
            lambda x: jnp.repeat(jnp.asarray(x)[None], n, axis=0), self.policy.initial_state()
        )
        zero = jnp.zeros_like(state.reward)
        sums = dict.fromkeys(
            ("episode_return", "success", "steps", "saturated", "power", "action_rate"), zero
        )
        totals = {**sums, "peak_torque": zero, "ended_by": zero.astype(jnp.int32)}

        def unfinished(carry: tuple) -> jax.Array:
            return jnp.any(carry[3]) & (carry[4] < self.env.episode_steps)

        def one_step(carry: tuple) -> tuple:
            state, memory, totals, alive, count = carry
            policy_keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(state.key, POLICY_KEY)
            action, memory = jax.vmap(self.policy)(state.obs, memory, policy_keys)
            state = jax.vmap(self.env.step)(state, action)
            return state, memory, _accumulate(totals, state, alive), alive & (state.done == 0), count + 1

        carry = (state, memory, totals, jnp.ones(n, bool), jnp.zeros((), jnp.int32))
        totals = jax.lax.while_loop(unfinished, one_step, carry)[2]
        steps = totals["steps"]
        return {
            "episode_return": totals["episode_return"],
            "success": totals["success"],
            "steps": steps.astype(jnp.int32),
            "ended_by": totals["ended_by"],
            "peak_torque": totals["peak_torque"],
            "saturated_share": totals["saturated"] / steps,
            "power": totals["power"] / steps,
            "action_rate": totals["action_rate"] / steps,
        }


def _accumulate(totals: dict[str, jax.Array], state: State, alive: jax.Array) -> dict[str, jax.Array]:
    """Adds one step to what is known of the episodes that were still going on."""

    def add(name: str, value: jax.Array) -> jax.Array:
        return totals[name] + jnp.where(alive, value, 0)

    ending = jnp.where(
        state.info["diverged"] > 0,
        ENDINGS.index("diverged"),
        jnp.where(state.info["failed"] > 0, ENDINGS.index("failed"), ENDINGS.index("time_limit")),
    )
    return {
        "episode_return": add("episode_return", state.reward),
        "success": add("success", state.info["success"]),
        "steps": add("steps", jnp.ones_like(state.reward)),
        "saturated": add("saturated", state.metrics["saturated"]),
        "power": add("power", state.metrics["power"]),
        "action_rate": add("action_rate", state.metrics["action_rate"]),
        "peak_torque": jnp.maximum(totals["peak_torque"], jnp.where(alive, state.metrics["peak_torque"], 0)),
        "ended_by": jnp.where(alive & (state.done > 0), ending, totals["ended_by"]).astype(jnp.int32),
    }


def _cross(base: Draws, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The base worlds once for every combination of values; worlds run fastest, then the last factor."""
    worlds = len(next(iter(base.values())))
    grid = np.meshgrid(*values.values(), indexing="ij")
    combinations = math.prod(len(v) for v in values.values())
    draws = {name: np.tile(value, (combinations,) + (1,) * (value.ndim - 1)) for name, value in base.items()}
    for name, points in zip(values, grid, strict=True):
        repeated = np.repeat(points.reshape(-1), worlds)
        shape = (-1,) + (1,) * (draws[name].ndim - 1)
        draws[name] = np.broadcast_to(repeated.reshape(shape), draws[name].shape).astype(np.float32)
    return draws


def choose_sets(env: Environment, names: Sequence[str] | None) -> tuple[WorldSet, ...]:
    """The environment's sets by name, all without names.

    Raises:
        UserError: a name that does not exist.
    """
    known = {s.name: s for s in env.world_sets}
    for name in names or ():
        if name not in known:
            raise UserError(f"--sets: {env.name} has no set {name!r}; {nearest(name, known)}")
    return tuple(known[name] for name in (names or known))
