"""A learner that learns nothing, quickly: what the training loop does with epochs, without waiting for them.

As a program it trains: `toy_learner.py OUT [--resume] [--kill-at STEP] [--pause SECONDS] [--poison-at STEP]`.
"""

from __future__ import annotations

import argparse
import math
import os
import signal
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from simreal.config import CheckpointConfig, RunConfig
from simreal.errors import UserError
from simreal.stopping import Interrupted
from simreal.training import train

STEPS_PER_EPOCH = 100


@struct.dataclass
class ToyState:
    """The parts of a training state that the loop knows by name, and a key."""

    params: dict[str, jax.Array]
    normalizer: jax.Array
    key: jax.Array
    steps: jax.Array


class ToyLearner:
    """Adds noise to its parameters; its success is the share of the run that is over."""

    steps_per_epoch = STEPS_PER_EPOCH

    def __init__(self, config: RunConfig, kill_at: int = -1, poison_at: int = -1, pause: float = 0.0) -> None:
        self.config = config
        self.kill_at = kill_at
        self.poison_at = poison_at
        self.pause = pause
        self.env = SimpleNamespace(
            name="toy",
            engine_name="toy",
            control_dt=0.02,
            randomizer=SimpleNamespace(randomizer=SimpleNamespace(digest="none")),
        )

    def init(self, seed: int) -> ToyState:
        return ToyState(
            {"weights": jnp.zeros((3, 2))}, jnp.ones(2), jax.random.PRNGKey(seed), jnp.zeros((), jnp.uint32)
        )

    def epoch(self, state: ToyState, watch: Any = None) -> tuple[ToyState, dict[str, float]]:
        time.sleep(self.pause)
        key, noise_key = jax.random.split(state.key)
        weights = state.params["weights"] * 0.9 + jax.random.normal(noise_key, (3, 2))
        steps = state.steps + jnp.uint32(STEPS_PER_EPOCH)
        if steps == self.poison_at:
            weights = weights * jnp.nan
        if steps == self.kill_at:
            os.kill(os.getpid(), signal.SIGKILL)
        metrics = {
            "episode_return": float(jnp.sum(weights)) if steps > STEPS_PER_EPOCH else math.nan,
            "success_rate": float(steps) / self.config.steps,
            "episodes": 4.0,
            "idle_steps": 0.0,
            "quarantined": 0.0,
        }
        return ToyState({"weights": weights}, state.normalizer, key, steps), metrics

    def export(self, state: ToyState) -> Any:
        def save(folder: Path) -> None:
            folder.mkdir()
            np.savez(folder / "weights.npz", **state.params)

        return SimpleNamespace(save=save)


def main(arguments: list[str]) -> int:
    """Trains; exit codes as the command line's."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--kill-at", type=int, default=-1)
    parser.add_argument("--poison-at", type=int, default=-1)
    parser.add_argument("--pause", type=float, default=0.0)
    given = parser.parse_args(arguments)
    config = RunConfig(environment="toy", steps=1000, checkpoint=CheckpointConfig(every_seconds=1e-6))
    try:
        train(
            config,
            given.out,
            resume=given.resume,
            build=lambda config: ToyLearner(config, given.kill_at, given.poison_at, given.pause),  # type: ignore[arg-type, return-value]
        )
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    except Interrupted as interruption:
        print(interruption, file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
