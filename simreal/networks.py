"""Brax's PPO networks, as this project sets them up."""

from __future__ import annotations

from typing import Any

import jax

from simreal.brax_parts import networks as brax_networks
from simreal.brax_parts import ppo_networks, running_statistics
from simreal.config import LearnerConfig, NetworkConfig


def make_networks(
    observation_size: int,
    privileged_size: int,
    action_size: int,
    network: NetworkConfig,
    learner: LearnerConfig,
) -> ppo_networks.PPONetworks:
    """Policy on "state", critic on "privileged_state".

    The action distribution is normal, with a learnt deviation that does not depend on the state.
    """
    sizes = {"state": (observation_size,), "privileged_state": (privileged_size,)}

    def preprocess(observation: Any, statistics: Any) -> Any:
        if not learner.normalize_observations:
            return observation
        return running_statistics.normalize(observation, statistics, max_abs_value=learner.observation_clip)

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
