"""Does memory help where it must? A cart-pole without velocities, whose sensors are 60 ms late.

Three policies, five seeds each, the same worlds for all: without memory, with the last observations, with a
recurrent layer. Each run is a folder under `runs/memory`; what is finished is not done again.

    python benchmarks/memory_study.py      # prints a table, in Markdown
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import ClassVar

from simreal import registry
from simreal.compilation import enable_cache
from simreal.config_files import load_config
from simreal.distributions import Choice
from simreal.envs.cartpole_swingup import CartpoleSwingup
from simreal.evaluation.statistics import seed_interval
from simreal.randomizers import cartpole, sensor
from simreal.runs import Run
from simreal.worldsets import TRAIN

SEEDS = range(5)
STEPS = 2_500_000
WORLDS = 256
FOLDER = Path("runs/memory")
POLICIES = {
    "no memory": {},
    "history of 8": {"network.history": 8},
    "GRU of 32": {"network.recurrent": 32},
}


class LateCartpole(CartpoleSwingup):
    """The cart-pole of which only positions are seen, 60 ms late."""

    name = "late_cartpole"
    readings: ClassVar = {"cart_position": (1, "m"), "pole_angle": (1, "rad")}
    observations = (
        ("cart_position", "m"),
        ("pole_angle_cos", "1"),
        ("pole_angle_sin", "1"),
        ("last_action", "1"),
    )
    training = cartpole.TRAIN.replace(velocity_noise=None, sensor_delay=sensor.delay("*").set(Choice([0.06])))

    def read(self, data, task):
        return {"cart_position": data.qpos[0], "pole_angle": data.qpos[1]}

    def observe(self, reading, task):
        return super().observe(reading | {"cart_velocity": 0.0, "pole_velocity": 0.0}, task)[[0, 1, 2, 5]]


def measure(name: str, seed: int) -> dict:
    """Success and return in fresh worlds of the training ranges, of a run, trained if it is not yet."""
    from simreal.evaluation.evaluator import Evaluator
    from simreal.policy import load_policy
    from simreal.training import make_environment, train

    out = FOLDER / f"{name.replace(' ', '_')}-{seed}"
    result = out / "result.json"
    if not result.exists():
        changes = {"environment": LateCartpole.name, "steps": STEPS, "seed": seed}
        config = load_config("cartpole_swingup", changes | POLICIES[name])
        train(config, out, resume=(out / "config.yaml").exists())
        env = make_environment(config)
        outcome = Evaluator(env, load_policy(out)).run(TRAIN.draws(env.randomizer, WORLDS, seed=0))
        measured = {key: float(outcome[key].mean()) for key in ("success", "episode_return")}
        measured["seconds"] = Run(out).metrics()[-1]["wall_seconds"]
        result.write_text(json.dumps(measured))
    return json.loads(result.read_text())


def main() -> None:
    enable_cache()
    registry.register(LateCartpole.name, f"{__name__}:LateCartpole")
    lines = ["| policy | success of each seed, % | mean (95 %) | return (95 %) |", "|---|---|---|---|"]
    for name in POLICIES:
        rows = [measure(name, seed) for seed in SEEDS]
        rates = [100 * row["success"] for row in rows]
        success, value = seed_interval(rates), seed_interval([row["episode_return"] for row in rows])
        lines.append(
            f"| {name} | {' '.join(f'{rate:.1f}' for rate in rates)} "
            f"| {success.value:.1f} [{success.low:.1f}, {success.high:.1f}] "
            f"| {value.value:.0f} [{value.low:.0f}, {value.high:.0f}] |"
        )
    text = "\n".join(lines) + "\n"
    print(text)
    (FOLDER / "memory.md").write_text(text)


if __name__ == "__main__":
    main()
