"""PPO from Brax's parts: its networks, loss, advantage estimate, normaliser and action distribution.

The loop is ours. One iteration is three programs: `refill` makes fresh starts, `collect` steps the worlds,
`update` learns from what they did. The first two contain calls to the host where the engine does, and are
then never cached on disk by JAX. Everything that a run is lies in one pytree.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jax.flatten_util import ravel_pytree

from simreal.brax_parts import losses, optimizer, running_statistics, specs, types
from simreal.compilation import SideBySide, for_rare_use
from simreal.config import LearnerConfig, RunConfig
from simreal.environment import Environment
from simreal.memory import Recollection
from simreal.networks import SEEN, RecurrentNetwork, make_networks
from simreal.policy import Policy
from simreal.randomizer import Ranges
from simreal.rollout import Ended, Flight, Reserve, Rollout, RolloutState

Metrics = dict[str, jax.Array]
Watch = Callable[[int, RolloutState, Flight], None]
"""Called after each unroll with the environment steps before it, all worlds as they were then, and what
they did, leaves (T, B, ...)."""

_COLLECT, _UPDATE, _NEXT = range(3)  # folded into a run's key: what its randomness is for

_SD_FLOOR = 1e-2
"""Observations that hardly move in training are not blown up: see the traps in the design notes."""


@struct.dataclass
class TrainingState:
    """Everything that a run is: saved whole, and a resumed run goes on bit for bit."""

    params: losses.PPONetworkParams
    optimizer: optax.OptState
    normalizer: running_statistics.RunningStatisticsState
    rollout: RolloutState | tuple[()]  # () inside `update`, which does not touch it
    ranges: Ranges
    last_success: jax.Array  # (greedy worlds,) outcome of each one's last episode, NaN before the first
    key: jax.Array  # (2,) uint32
    steps: jax.Array  # () uint32, environment steps learnt from


@struct.dataclass
class Hyper:
    """The numbers of `LearnerConfig` that the members of a population may have their own of."""

    learning_rate: Any
    adaptive_kl: Any
    min_learning_rate: Any
    max_learning_rate: Any
    decay_steps: Any
    discount: Any
    gae_lambda: Any
    clip: Any
    clip_value: Any
    entropy_cost: Any
    value_cost: Any
    max_gradient_norm: Any
    reward_scale: Any

    @classmethod
    def of(cls, config: LearnerConfig) -> Hyper:
        """The numbers of one run, which its programs are compiled with."""
        return cls(**{f.name: getattr(config, f.name) for f in dataclasses.fields(cls)})

    def highest_rate(self, steps: jax.Array) -> tuple[Any, Any]:
        """The learning rate without steering, and the highest with it, after as many environment steps."""
        if self.decay_steps is None:
            return self.learning_rate, self.max_learning_rate
        left = jnp.maximum(0.0, 1.0 - steps / self.decay_steps)
        lowest = self.min_learning_rate
        return tuple(lowest + left * (rate - lowest) for rate in (self.learning_rate, self.max_learning_rate))

    def optimizer(self) -> optax.GradientTransformation:
        """Adam, after the gradient's norm was clipped."""
        adam = optax.inject_hyperparams(optax.adam)(learning_rate=self.learning_rate)
        norm = self.max_gradient_norm
        return optax.chain(*([] if norm is None else [optax.clip_by_global_norm(norm)]), adam)


class Programs(NamedTuple):
    """What an epoch calls."""

    start: Callable[..., TrainingState]
    refill: Callable[[Reserve, Ranges], Reserve]
    collect: Callable[..., tuple[RolloutState, types.Transition, Ended, Flight]]
    update: Callable[..., tuple[TrainingState, Metrics]]


class Learner:
    """Trains one policy on one environment.

    Args:
        env: the environment, bound to the training ranges.
        config: the run's configuration.
    """

    def __init__(self, env: Environment, config: RunConfig) -> None:
        self.env = env
        self.config = config
        hyper = config.learner
        builder = env.randomizer
        self.recollection = Recollection(
            env.observation_size, config.network.history, config.network.recurrent
        )
        nominal = None if config.randomization == "train" else (lambda key, ranges: builder.build({}))
        self.worlds = config.worlds
        self.rollout = Rollout(
            env,
            config.worlds + config.rollout.greedy_worlds,
            config.rollout.reset_capacity,
            config.rollout.reserve,
            config.rollout.stagger,
            nominal,
            self.recollection.empty(np),
        )
        state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
        shown = jax.ShapeDtypeStruct((self.recollection.size,), state.obs.dtype)
        self._observations = {"state": shown, "privileged_state": state.privileged}
        self.networks = make_networks(
            shown.shape[0], state.privileged.shape[0], env.action_size, config.network, hyper
        )
        self.hyper = Hyper.of(hyper)

    @property
    def steps_per_epoch(self) -> int:
        """Environment steps that one epoch learns from."""
        return self.worlds * self.config.learner.unroll_length * self.config.learner.iterations_per_epoch

    @functools.cached_property
    def state_shape(self) -> TrainingState:
        """Shapes and types of everything that a run is."""
        return jax.eval_shape(self._start, jax.ShapeDtypeStruct((), jnp.uint32))

    @functools.cached_property
    def _programs(self) -> Programs:
        """Compiled at first use, the longest first, each while the next one is traced."""
        state = self.state_shape
        assert isinstance(state.rollout, RolloutState)
        with SideBySide() as compile_:
            # Collect and refill donate nothing: whoever watches keeps the worlds as they were before.
            collect, (_, data, ended, _) = compile_(
                self.collect, *(state.rollout, state.params.policy, state.normalizer, state.key)
            )
            update, _ = compile_(
                self.update, dataclasses.replace(state, rollout=()), data, ended, donate_argnums=0
            )
            refill, _ = compile_(
                self.rollout.refill,
                *(state.rollout.reserve, state.ranges),
                compiler_options=for_rare_use(),
            )
            seed = jax.ShapeDtypeStruct((), jnp.uint32)
            start, _ = compile_(self._start, seed, compiler_options=for_rare_use())
        return Programs(start.result(), refill.result(), collect.result(), update.result())

    def init(self, seed: int) -> TrainingState:
        """The run before its first step."""
        return self._programs.start(np.uint32(seed))

    def _start(
        self, seed: jax.Array, hyper: Hyper | None = None, ranges: Ranges | None = None
    ) -> TrainingState:
        hyper = hyper or self.hyper
        key, policy_key, value_key, world_key = jax.random.split(jax.random.PRNGKey(seed), 4)
        params = losses.PPONetworkParams(
            policy=self.networks.policy_network.init(policy_key),
            value=self.networks.value_network.init(value_key),
        )
        sizes = jax.tree.map(lambda o: specs.Array(o.shape, o.dtype), self._observations)
        state = TrainingState(
            params=params,
            optimizer=hyper.optimizer().init(ravel_pytree(params)[0]),
            normalizer=running_statistics.init_state(sizes),
            rollout=self.rollout.start(world_key),
            ranges=self.env.randomizer.ranges if ranges is None else ranges,
            last_success=jnp.full(self.config.rollout.greedy_worlds, jnp.nan),
            key=key,
            steps=jnp.zeros((), jnp.uint32),
        )
        # The explicit type takes away weak types, for which the first epoch would compile a second program.
        return jax.tree.map(lambda x: jax.lax.convert_element_type(x, jnp.result_type(x)), state)

    def epoch(
        self, state: TrainingState, watch: Watch = lambda steps, before, flight: None
    ) -> tuple[TrainingState, dict[str, float]]:
        """`iterations_per_epoch` times refill, collect and update. The state passed in is used up."""
        state, rows = iterate(self._programs, state, self.config, watch)
        return state, summarise(*jax.device_get((rows, state.last_success)))

    # -- collect -------------------------------------------------------------------------------------------

    def collect(
        self, rollout: RolloutState, policy: Any, normalizer: Any, key: jax.Array
    ) -> tuple[RolloutState, types.Transition, Ended, Flight]:
        """`unroll_length` control steps of all worlds; the learning worlds' data has leaves (T, B, ...)."""
        distribution = self.networks.parametric_action_distribution
        learning = self.worlds

        def one_step(
            state: RolloutState, key: jax.Array
        ) -> tuple[RolloutState, tuple[types.Transition, Ended, Flight]]:
            state = self.rollout.renew(state)
            seen, logits, memory = self._look(state, policy, normalizer)
            state = dataclasses.replace(state, memory=memory)
            raw = distribution.sample_no_postprocessing(logits, key)
            greedy = jnp.arange(self.rollout.worlds)[:, None] >= learning
            action = distribution.postprocess(jnp.where(greedy, distribution.create_dist(logits).mode(), raw))
            state, ended, flight = self.rollout.step(state, action)
            env = state.env
            extras = {
                "policy_extras": {
                    "raw_action": raw,
                    "log_prob": distribution.log_prob(logits, raw),
                    "distribution_params": logits,
                },
                "state_extras": {"truncation": env.info["truncation"]},
            }
            step = types.Transition(
                observation=seen,
                action=raw,
                reward=env.reward,
                discount=1 - env.done,
                next_observation=(),
                extras=extras,
            )
            return state, (jax.tree.map(lambda x: x[:learning], step), ended, flight)

        keys = jax.random.split(jax.random.fold_in(key, _COLLECT), self.config.learner.unroll_length)
        rollout, (data, ended, flight) = jax.lax.scan(one_step, rollout, keys)
        shown, _ = self.recollection.see(jnp, rollout.memory, rollout.env.obs)
        final = {"state": shown, "privileged_state": rollout.env.privileged}
        # The loss reads only the last next observation, to bootstrap from.
        data = data._replace(next_observation=jax.tree.map(lambda x: x[None, :learning], final))
        return rollout, data, ended, flight

    def _look(self, state: RolloutState, policy: Any, normalizer: Any) -> tuple[Any, jax.Array, Any]:
        """What the networks see of all worlds, the policy's logits, and its memory after that."""
        shown, memory = self.recollection.see(jnp, state.memory, state.env.obs)
        seen = {"state": shown, "privileged_state": state.env.privileged}
        network = self.networks.policy_network
        if not isinstance(network, RecurrentNetwork):
            return seen, network.apply(normalizer, policy, seen), memory
        hidden = state.memory["hidden"]
        logits, after = network.step(normalizer, policy, seen, hidden)
        seen |= {"hidden": hidden, "fresh": 1 - state.memory["used"]}
        return seen, logits, memory | {"hidden": after}

    # -- update --------------------------------------------------------------------------------------------

    def update(
        self, state: TrainingState, data: types.Transition, ended: Ended, hyper: Hyper | None = None
    ) -> tuple[TrainingState, Metrics]:
        """`epochs` passes of minibatch gradient steps over the data; `state` comes without its rollout."""
        hyper = hyper or self.hyper
        adam = hyper.optimizer()
        usual_rate, highest_rate = hyper.highest_rate(state.steps)
        normalizer = state.normalizer
        # One flat array of all parameters compiles and steps faster than one for each layer.
        weights, as_params = ravel_pytree(state.params)
        config = self.config.learner
        old_values = self.networks.value_network.apply(normalizer, state.params.value, data.observation)
        data.extras["policy_extras"]["value"] = old_values
        observation = {name: data.observation[name] for name in SEEN}
        # To (B, T, ...): a minibatch is some worlds over the whole unroll, for the advantage estimate.
        data = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), data)

        def gradient_step(
            carry: tuple[Any, Any], batch: tuple[types.Transition, jax.Array]
        ) -> tuple[tuple[Any, Any], Metrics]:
            weights, optimizer_state = carry
            minibatch, key = batch

            def loss(weights: jax.Array) -> tuple[jax.Array, Metrics]:
                return losses.compute_ppo_loss(
                    as_params(weights),
                    *(normalizer, minibatch, key),
                    ppo_network=self.networks,
                    entropy_cost=hyper.entropy_cost,
                    discounting=hyper.discount,
                    reward_scaling=hyper.reward_scale,
                    gae_lambda=hyper.gae_lambda,
                    clipping_epsilon=hyper.clip,
                    clipping_epsilon_value=hyper.clip_value,
                    vf_coefficient=hyper.value_cost,
                )

            (_, metrics), gradient = jax.value_and_grad(loss, has_aux=True)(weights)
            rate = jnp.asarray(usual_rate, weights.dtype)
            if hyper.adaptive_kl is not None:
                optimizer_state, rate = optimizer.adaptive_kl_learning_rate(
                    optimizer_state,
                    metrics["kl_mean"],
                    hyper.adaptive_kl,
                    hyper.min_learning_rate,
                    highest_rate,
                )
                rate = jnp.minimum(rate, highest_rate)
            optimizer_state[-1].hyperparams["learning_rate"] = rate
            change, new_optimizer_state = adam.update(gradient, optimizer_state)
            new_weights = weights + change
            # A gradient that is not finite is skipped and counted: it would be in the parameters for ever.
            fine = jnp.all(jnp.isfinite(gradient))
            kept = jax.tree.map(
                lambda new, old: jnp.where(fine, new, old),
                (new_weights, new_optimizer_state),
                (weights, optimizer_state),
            )
            return kept, {**metrics, "learning_rate": rate, "skipped_updates": 1.0 - fine}

        def one_pass(carry: tuple[Any, Any], key: jax.Array) -> tuple[tuple[Any, Any], Metrics]:
            order_key, loss_key = jax.random.split(key)
            order = jax.random.permutation(order_key, self.worlds)

            def split(x: jax.Array) -> jax.Array:
                return x[order].reshape(config.minibatches, -1, *x.shape[1:])

            keys = jax.random.split(loss_key, config.minibatches)
            return jax.lax.scan(gradient_step, carry, (jax.tree.map(split, data), keys))

        pass_keys = jax.random.split(jax.random.fold_in(state.key, _UPDATE), config.epochs)
        (weights, optimizer_state), metrics = jax.lax.scan(one_pass, (weights, state.optimizer), pass_keys)
        learnt = dataclasses.replace(
            state,
            params=as_params(weights),
            optimizer=optimizer_state,
            # After the passes: the old distribution parameters stay comparable for the divergence.
            normalizer=running_statistics.update(normalizer, observation, std_min_value=_SD_FLOOR),
            last_success=_latest(state.last_success, ended, self.worlds),
            key=jax.random.fold_in(state.key, _NEXT),
            steps=state.steps + jnp.uint32(self.worlds * config.unroll_length),
        )
        row = {name: jnp.mean(metrics[source]) for name, source in _REPORTED.items()}
        row["skipped_updates"] = jnp.sum(metrics["skipped_updates"])
        return learnt, row | _count_episodes(ended, self.worlds)

    def export(self, state: TrainingState) -> Policy:
        """The policy as it would run on a robot: NumPy only."""
        return Policy.from_training(self.env, self.config, state.params.policy, state.normalizer)


def iterate(
    programs: Programs, state: TrainingState, config: RunConfig, watch: Watch
) -> tuple[TrainingState, list[Metrics]]:
    """`iterations_per_epoch` times refill, collect and update, of one run or of a population."""
    rows, steps = [], int(np.asarray(state.steps).flat[0])
    for _ in range(config.learner.iterations_per_epoch):
        rollout = state.rollout
        assert isinstance(rollout, RolloutState)  # () only inside `update`
        before = dataclasses.replace(rollout, reserve=programs.refill(rollout.reserve, state.ranges))
        rollout, data, ended, flight = programs.collect(
            before, state.params.policy, state.normalizer, state.key
        )
        learnt, row = programs.update(dataclasses.replace(state, rollout=()), data, ended)
        state = dataclasses.replace(learnt, rollout=rollout)
        rows.append(row)
        watch(steps, before, flight)
        steps += config.worlds * config.learner.unroll_length
    return state, rows


_REPORTED = {
    "policy_loss": "policy_loss",
    "value_loss": "v_loss",
    "kl": "kl_mean",
    "action_noise": "policy_dist_mean_std",
    "learning_rate": "learning_rate",
}
"""Name in metrics.jsonl -> name in Brax's loss."""


def summarise(rows: list[dict[str, np.ndarray]], last_success: np.ndarray) -> dict[str, float]:
    """One row for an epoch: means over its updates, sums and rates over its episodes; NaN where none."""
    total = {name: float(np.sum([row[name] for row in rows])) for name in rows[0]}
    episodes = total.pop("episodes")
    returns, successes = total.pop("returns"), total.pop("successes")
    known = last_success[~np.isnan(last_success)]
    return (
        total
        | {name: total[name] / len(rows) for name in _REPORTED}
        | {
            "episode_return": returns / episodes if episodes else math.nan,
            "success_rate": float(known.mean()) if known.size else math.nan,
            "exploring_success_rate": successes / episodes if episodes else math.nan,
            "episodes": episodes,
        }
    )


def _count_episodes(ended: Ended, learning: int) -> Metrics:
    """Sums over the episodes that ended in learning worlds."""
    done = ended.done[:, :learning]
    return {
        "episodes": jnp.sum(done, dtype=float),
        "returns": jnp.sum(jnp.where(done, ended.episode_return[:, :learning], 0)),
        "successes": jnp.sum(jnp.where(done, ended.success[:, :learning], 0)),
        "quarantined": jnp.sum(ended.quarantined, dtype=float),
        "idle_steps": jnp.sum(ended.idle, dtype=float),
    }


def _latest(last_success: jax.Array, ended: Ended, learning: int) -> jax.Array:
    """The outcome of each greedy world's latest episode."""

    def later(last: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        done, success = step
        return jnp.where(done, success, last), None

    # One whose physics blew up did not succeed: a policy that breaks the simulator shall not look good.
    over = ended.done | ended.quarantined
    return jax.lax.scan(later, last_success, (over[:, learning:], ended.success[:, learning:]))[0]
