"""PPO from Brax's parts: its networks, loss, advantage estimate, normaliser and action distribution.

The loop is ours. One iteration is two programs: `collect` steps the worlds (and alone contains calls to the
host, which JAX never caches on disk), `update` learns from what they did. Everything that a run is lies in
one pytree.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct

from simreal.brax_parts import losses, optimizer, running_statistics, specs, types
from simreal.config import RunConfig
from simreal.environment import Environment
from simreal.networks import make_networks
from simreal.policy import Policy
from simreal.randomizer import Ranges
from simreal.rollout import Ended, Rollout, RolloutState

Metrics = dict[str, jax.Array]

_SD_FLOOR = 1e-2
"""Observations that hardly move in training are not blown up: see the traps in the design notes."""


@struct.dataclass
class TrainingState:
    """Everything that a run is: saved whole, and a resumed run goes on bit for bit."""

    params: losses.PPONetworkParams
    optimizer: optax.OptState
    normalizer: running_statistics.RunningStatisticsState
    rollout: RolloutState
    ranges: Ranges
    last_success: jax.Array  # (greedy worlds,) outcome of each one's last episode, NaN before the first
    key: jax.Array  # (2,) uint32
    steps: jax.Array  # () uint32, environment steps learnt from


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
        nominal = None if config.randomization == "train" else (lambda key, ranges: builder.build({}))
        self.worlds = config.worlds
        self.rollout = Rollout(
            env,
            config.worlds + config.rollout.greedy_worlds,
            config.rollout.reset_capacity,
            config.rollout.stagger,
            nominal,
        )
        state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
        self._observations = {"state": state.obs, "privileged_state": state.privileged}
        self.networks = make_networks(
            state.obs.shape[0], state.privileged.shape[0], env.action_size, config.network, hyper
        )
        adam = optax.inject_hyperparams(optax.adam)(learning_rate=hyper.learning_rate)
        clip = [optax.clip_by_global_norm(hyper.max_gradient_norm)] if hyper.max_gradient_norm else []
        self.optimizer = optax.chain(*clip, adam)
        self.loss = functools.partial(
            losses.compute_ppo_loss,
            ppo_network=self.networks,
            entropy_cost=hyper.entropy_cost,
            discounting=hyper.discount,
            reward_scaling=hyper.reward_scale,
            gae_lambda=hyper.gae_lambda,
            clipping_epsilon=hyper.clip,
            clipping_epsilon_value=hyper.clip_value,
            vf_coefficient=hyper.value_cost,
        )
        self._collect = jax.jit(self.collect, donate_argnums=0)
        self._update = jax.jit(self.update, donate_argnums=(0, 1, 2))

    @property
    def steps_per_epoch(self) -> int:
        """Environment steps that one epoch learns from."""
        return self.worlds * self.config.learner.unroll_length * self.config.learner.iterations_per_epoch

    def init(self, seed: int) -> TrainingState:
        """The run before its first step."""
        key, policy_key, value_key, world_key = jax.random.split(jax.random.PRNGKey(seed), 4)
        params = losses.PPONetworkParams(
            policy=self.networks.policy_network.init(policy_key),
            value=self.networks.value_network.init(value_key),
        )
        sizes = jax.tree.map(lambda o: specs.Array(o.shape, o.dtype), self._observations)
        state = TrainingState(
            params=params,
            optimizer=self.optimizer.init(params),
            normalizer=running_statistics.init_state(sizes),
            rollout=self.rollout.start(world_key),
            ranges=self.env.randomizer.ranges,
            last_success=jnp.full(self.config.rollout.greedy_worlds, jnp.nan),
            key=key,
            steps=jnp.zeros((), jnp.uint32),
        )
        # A copy of each leaf: `epoch` donates them, and a buffer that two leaves share can only be given
        # once. The explicit type takes away weak types, for which the first epoch would compile a program of
        # its own.
        return jax.tree.map(lambda x: jnp.array(x, dtype=jnp.result_type(x)), state)

    def epoch(self, state: TrainingState) -> tuple[TrainingState, Metrics]:
        """`iterations_per_epoch` times collect and update. The state passed in is used up."""
        rows = []
        for _ in range(self.config.learner.iterations_per_epoch):
            key, collect_key, update_key = jax.random.split(state.key, 3)
            rollout, data, ended = self._collect(
                state.rollout, state.params.policy, state.normalizer, state.ranges, collect_key
            )
            params, optimizer_state, normalizer, row = self._update(
                state.params, state.optimizer, state.normalizer, data, update_key
            )
            row |= self._episodes(ended)
            last_success = _latest(state.last_success, ended, self.worlds)
            rows.append(row)
            state = dataclasses.replace(
                state,
                params=params,
                optimizer=optimizer_state,
                normalizer=normalizer,
                rollout=rollout,
                last_success=last_success,
                key=key,
                steps=state.steps + jnp.uint32(self.worlds * self.config.learner.unroll_length),
            )
        return state, self._summarise(rows, state)

    # -- collect -------------------------------------------------------------------------------------------

    def collect(
        self, rollout: RolloutState, policy: Any, normalizer: Any, ranges: Ranges, key: jax.Array
    ) -> tuple[RolloutState, types.Transition, Ended]:
        """`unroll_length` control steps of all worlds; the learning worlds' data has leaves (T, B, ...)."""
        distribution = self.networks.parametric_action_distribution
        learning = self.worlds

        def one_step(
            state: RolloutState, key: jax.Array
        ) -> tuple[RolloutState, tuple[types.Transition, Ended]]:
            state = self.rollout.renew(state, ranges)
            seen = {"state": state.env.obs, "privileged_state": state.env.privileged}
            logits = self.networks.policy_network.apply(normalizer, policy, seen)
            raw = distribution.sample_no_postprocessing(logits, key)
            greedy = jnp.arange(self.rollout.worlds)[:, None] >= learning
            action = distribution.postprocess(jnp.where(greedy, distribution.create_dist(logits).mode(), raw))
            state, ended = self.rollout.step(state, action)
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
            return state, (jax.tree.map(lambda x: x[:learning], step), ended)

        keys = jax.random.split(key, self.config.learner.unroll_length)
        rollout, (data, ended) = jax.lax.scan(one_step, rollout, keys)
        final = {"state": rollout.env.obs, "privileged_state": rollout.env.privileged}
        # The loss reads only the last next observation, to bootstrap from.
        data = data._replace(next_observation=jax.tree.map(lambda x: x[None, :learning], final))
        return rollout, data, ended

    # -- update --------------------------------------------------------------------------------------------

    def update(
        self, params: Any, optimizer_state: Any, normalizer: Any, data: types.Transition, key: jax.Array
    ) -> tuple[Any, Any, Any, Metrics]:
        """`epochs` passes of minibatch gradient steps over the collected data."""
        hyper = self.config.learner
        old_values = self.networks.value_network.apply(normalizer, params.value, data.observation)
        data.extras["policy_extras"]["value"] = old_values
        observation = data.observation
        # To (B, T, ...): a minibatch is some worlds over the whole unroll, for the advantage estimate.
        data = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), data)

        def gradient_step(
            carry: tuple[Any, Any], batch: tuple[types.Transition, jax.Array]
        ) -> tuple[tuple[Any, Any], Metrics]:
            params, optimizer_state = carry
            minibatch, key = batch
            gradient_of = jax.value_and_grad(self.loss, has_aux=True)
            (_, metrics), gradient = gradient_of(params, normalizer, minibatch, key)
            rate = jnp.asarray(hyper.learning_rate)
            if hyper.adaptive_kl is not None:
                optimizer_state, rate = optimizer.adaptive_kl_learning_rate(
                    optimizer_state,
                    metrics["kl_mean"],
                    hyper.adaptive_kl,
                    hyper.min_learning_rate,
                    hyper.max_learning_rate,
                )
            change, new_optimizer_state = self.optimizer.update(gradient, optimizer_state)
            new_params = optax.apply_updates(params, change)
            # A gradient that is not finite is skipped and counted: it would be in the parameters for ever.
            fine = jnp.isfinite(optax.tree.norm(gradient))
            kept = jax.tree.map(
                lambda new, old: jnp.where(fine, new, old),
                (new_params, new_optimizer_state),
                (params, optimizer_state),
            )
            return kept, {**metrics, "learning_rate": rate, "skipped_updates": 1.0 - fine}

        def one_pass(carry: tuple[Any, Any], key: jax.Array) -> tuple[tuple[Any, Any], Metrics]:
            order_key, loss_key = jax.random.split(key)
            order = jax.random.permutation(order_key, self.worlds)

            def split(x: jax.Array) -> jax.Array:
                return x[order].reshape(hyper.minibatches, -1, *x.shape[1:])

            keys = jax.random.split(loss_key, hyper.minibatches)
            return jax.lax.scan(gradient_step, carry, (jax.tree.map(split, data), keys))

        learnt, metrics = jax.lax.scan(
            one_pass, (params, optimizer_state), jax.random.split(key, hyper.epochs)
        )
        params, optimizer_state = learnt
        # After the passes: the old distribution parameters stay comparable for the divergence.
        normalizer = running_statistics.update(normalizer, observation, std_min_value=_SD_FLOOR)
        skipped = jnp.sum(metrics.pop("skipped_updates"))
        summary = {name: jnp.mean(metrics[name]) for name in _REPORTED.values()}
        return params, optimizer_state, normalizer, summary | {"skipped_updates": skipped}

    # -- metrics -------------------------------------------------------------------------------------------

    def _episodes(self, ended: Ended) -> Metrics:
        return _count_episodes(ended, self.worlds)

    def _summarise(self, rows: list[Mapping[str, jax.Array]], state: TrainingState) -> Metrics:
        total = {name: jnp.sum(jnp.stack([row[name] for row in rows])) for name in rows[0]}
        episodes = total["episodes"]
        metrics = {name: total[source] / len(rows) for name, source in _REPORTED.items()}
        return metrics | {
            "episode_return": total["returns"] / episodes,
            "success_rate": jnp.nanmean(state.last_success),
            "exploring_success_rate": total["successes"] / episodes,
            "episodes": episodes,
            "diverged": total["diverged"],
            "skipped_updates": total["skipped_updates"],
        }

    def export(self, state: TrainingState) -> Policy:
        """The policy as it would run on a robot: NumPy only."""
        return Policy.from_training(self.env, self.config, state.params.policy, state.normalizer)


_REPORTED = {
    "policy_loss": "policy_loss",
    "value_loss": "v_loss",
    "kl": "kl_mean",
    "action_noise": "policy_dist_mean_std",
    "learning_rate": "learning_rate",
}
"""Name in metrics.jsonl -> name in Brax's loss."""


@functools.partial(jax.jit, static_argnums=1)
def _count_episodes(ended: Ended, learning: int) -> Metrics:
    """Sums over the episodes that ended in learning worlds."""
    done = ended.done[:, :learning]
    return {
        "episodes": jnp.sum(done, dtype=float),
        "returns": jnp.sum(jnp.where(done, ended.episode_return[:, :learning], 0)),
        "successes": jnp.sum(jnp.where(done, ended.success[:, :learning], 0)),
        "diverged": jnp.sum(ended.diverged),
    }


@functools.partial(jax.jit, static_argnums=2)
def _latest(last_success: jax.Array, ended: Ended, learning: int) -> jax.Array:
    """The outcome of each greedy world's latest episode."""

    def later(last: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        done, success = step
        return jnp.where(done, success, last), None

    return jax.lax.scan(later, last_success, (ended.done[:, learning:], ended.success[:, learning:]))[0]
