"""An unmodified Brax training function on a simreal environment.

Brax's augmented random search runs on every JAX that simreal does; Brax's PPO and SAC call an API that
JAX 0.10 removed. Run it with `python examples/brax_training.py`.
"""

import functools
from collections.abc import Mapping

import simreal
from simreal.brax_adapter import BraxEnv


def main(steps: int = 200_000) -> list[float]:
    """Trains for `steps` environment steps; returns the mean return at each evaluation."""
    from brax.training.agents.ars import train as ars

    env = simreal.make("cartpole_swingup", randomizer=simreal.Randomizer())
    history: list[float] = []

    def progress(step: int, metrics: Mapping[str, float]) -> None:
        history.append(float(metrics["eval/episode_reward"]))
        print(f"step {step:>8}  return {history[-1]:8.3f}")

    train = functools.partial(
        ars.train,
        num_timesteps=steps,
        episode_length=env.episode_steps,
        number_of_directions=16,
        top_directions=8,
        exploration_noise_std=0.1,
        step_size=0.05,
        normalize_observations=True,
        num_evals=3,
        num_eval_envs=16,
        max_devices_per_host=1,
    )
    train(environment=BraxEnv(env), progress_fn=progress)
    return history


if __name__ == "__main__":
    main()
