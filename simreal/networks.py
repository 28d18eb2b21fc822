"""Brax's PPO networks, as this project sets them up; and a recurrent layer before the policy's."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen

from simreal.brax_parts import networks as brax_networks
from simreal.brax_parts import ppo_networks, running_statistics
from simreal.config import LearnerConfig, NetworkConfig

SEEN = ("state", "privileged_state")
"""What the networks see and the normaliser knows: of the policy and of the critic."""


def make_networks(
    observation_size: int,
    privileged_size: int,
    action_size: int,
    network: NetworkConfig,
    learner: LearnerConfig,
) -> ppo_networks.PPONetworks:
    """Policy on "state", critic on "privileged_state".

    The action distribution is normal, with a learnt deviation that does not depend on the state. With
    `network.recurrent` units, `policy_network` is a `RecurrentNetwork`.
    """
    sizes = {"state": (observation_size,), "privileged_state": (privileged_size,)}

    def preprocess(observation: Any, statistics: Any) -> Any:
        if not learner.normalize_observations:
            return observation
        return running_statistics.normalize(observation, statistics, max_abs_value=learner.observation_clip)

    def build(sizes: Any, preprocess: Any) -> ppo_networks.PPONetworks:
        return ppo_networks.make_ppo_networks(
            sizes,
            action_size,
            preprocess_observations_fn=preprocess,
            policy_hidden_layer_sizes=network.policy_layers,
            value_hidden_layer_sizes=network.value_layers,
            activation=brax_networks.ACTIVATION[network.activation],
            policy_obs_key="state",
            value_obs_key="privileged_state",
            distribution_type="normal",
            noise_std_type="log",
            init_noise_std=network.initial_noise,
            mean_kernel_init_fn=jax.nn.initializers.variance_scaling,
            mean_kernel_init_kwargs={
                "scale": network.output_scale**2,
                "mode": "fan_in",
                "distribution": "uniform",
            },
        )

    networks = build(sizes, preprocess)
    if not network.recurrent:
        return networks
    wider = sizes | {"state": (observation_size + network.recurrent,)}
    head = build(wider, lambda features, statistics: features).policy_network
    recurrent = RecurrentNetwork(head, preprocess, observation_size, network.recurrent)
    return dataclasses.replace(networks, policy_network=recurrent)


@dataclasses.dataclass(frozen=True)
class RecurrentNetwork:
    """A GRU, whose state and input go into the layers of `head`; `init` and `apply` as Brax's networks have.

    Args:
        head: what maps (..., hidden + size) to logits.
        preprocess: (observation, its statistics) -> normalised observation.
        size: of an observation.
        hidden: units.
    """

    head: brax_networks.FeedForwardNetwork
    preprocess: Any
    size: int
    hidden: int

    @property
    def cell(self) -> linen.GRUCell:
        """The recurrent layer."""
        return linen.GRUCell(self.hidden)

    def _input(self, seen: Any, statistics: Any) -> jax.Array:
        return self.preprocess(seen["state"], brax_networks.normalizer_select(statistics, "state"))

    def init(self, key: jax.Array) -> Any:
        """Parameters."""
        cell_key, head_key = jax.random.split(key)
        cell = self.cell.init(cell_key, jnp.zeros((1, self.hidden)), jnp.zeros((1, self.size)))
        return {"gru": cell["params"], "head": self.head.init(head_key)}

    def step(self, statistics: Any, params: Any, seen: Any, hidden: jax.Array) -> tuple[Any, jax.Array]:
        """Logits of one step, and the hidden state (..., hidden) after it."""
        x = self._input(seen, statistics)
        hidden, _ = self.cell.apply({"params": params["gru"]}, hidden, x)
        return self.head.apply(None, params["head"], jnp.concatenate([hidden, x], -1)), hidden

    def apply(self, statistics: Any, params: Any, seen: Any) -> Any:
        """Logits of T steps. Leaves of `seen` are (T, ...); besides observations it holds "hidden", the state
        before each step, of which the first is taken, and "fresh", 1.0 where an episode begins."""
        x = self._input(seen, statistics)

        def one(hidden: jax.Array, row: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            x, fresh = row
            hidden, _ = self.cell.apply({"params": params["gru"]}, hidden * (1 - fresh[..., None]), x)
            return hidden, hidden

        _, hidden = jax.lax.scan(one, seen["hidden"][0], (x, seen["fresh"]))
        return self.head.apply(None, params["head"], jnp.concatenate([hidden, x], -1))
