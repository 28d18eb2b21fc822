"""Time to a fixed return on the cart-pole: simreal's learner against Brax's own PPO, compilation included.

    make bench-brax    # sets up .venv-brax with JAX 0.9.2, for Brax's PPO runs on no newer one, and runs this

One fresh process for each side and seed, in turns, without any compilation cache on disk. The same on both
sides: the environment and its engine; the number of worlds, every hyperparameter and network of
configs/cartpole_swingup.yaml (Brax gets simreal's networks through its `network_factory`: normalised
observations clipped, the critic on the privileged observation); the seeds; and the evaluations, at the same
environment steps and in the same worlds: 128 episodes of the mean action, stepped for their full length
whether they have ended or not. A process's clock starts before its interpreter does and is read at the
first evaluation that reaches `RETURN_THRESHOLD`; then training goes on through all steps, for the final
return.

What differs is each side's own. Brax's `AutoResetWrapper` starts every later episode of a world from its
first start state, with its first World and its first noise: Brax learns from 512 worlds in all, simreal
from a fresh one in every episode; both are evaluated in fresh ones. Brax begins all episodes at once,
simreal staggers them. simreal's greedy worlds, which tell it the success rate without evaluations, are off:
here both sides evaluate.

A row for each finished process is kept in OUT/ENGINE.jsonl, and what is there already is not run again.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import math
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

RETURN_THRESHOLD = 300.0  # of at most 500; written down before the first full run
TIME_RATIO = 0.6  # what simreal's time to the threshold may be of Brax's
ENVIRONMENT = "cartpole_swingup"
EVALUATION_WORLDS = 128
NORMALIZER_FLOOR = 1e-2  # simreal's smallest standard deviation of an observation
SIDES = ("simreal", "brax")
PHASES = ("import", "environment", "set-up", "compile training", "compile evaluation")
PHASES += ("collect and learn", "evaluate", "other")


@dataclass(frozen=True)
class Plan:
    """What both sides do."""

    engine: str
    evaluations: int  # after the first, which precedes training
    iterations: int  # of collect and update between two evaluations

    def config(self, seed: int):
        """The shipped configuration, with this benchmark's changes."""
        from simreal.config_files import load_config

        changes = {
            "engine": self.engine,
            "seed": seed,
            "learner.iterations_per_epoch": self.iterations,
            "rollout.greedy_worlds": 0,
        }
        return load_config(ENVIRONMENT, changes)

    def settings(self) -> dict[str, Any]:
        """What rows of one table must have in common."""
        versions = {name: importlib.metadata.version(name) for name in ("jax", "flax", "brax", "mujoco")}
        return {"evaluations": self.evaluations, "config": self.config(0).to_dict(), "versions": versions}


@dataclass
class Record:
    """What a process writes down, in seconds since it was started."""

    began: float
    marks: dict[str, float] = field(default_factory=dict)
    evaluations: list[dict[str, float]] = field(default_factory=list)

    def now(self) -> float:
        return time.monotonic() - self.began

    def mark(self, name: str) -> None:
        """The end of a phase that comes once."""
        self.marks[name] = self.now()

    def evaluated(self, step: int, episode_return: Any, success: Any, train: float, evaluate: float) -> None:
        """An evaluation, after `train` seconds of training and `evaluate` seconds of its own."""
        outcome = {"step": step, "episode_return": float(episode_return), "success": float(success)}
        self.evaluations.append(outcome | {"seconds": self.now(), "train": train, "evaluate": evaluate})


# -- the two sides: each in a process of its own -----------------------------------------------------------


def make_environment(config):
    """The environment of a configuration."""
    from simreal import registry

    training = registry.environment_class(config.environment).training.with_ranges(config.randomizer)
    return registry.make(config.environment, engine=config.engine, randomizer=training)


def evaluation_key(seed: int):
    """The key that Brax's `train` splits off a key for each evaluation from."""
    import jax

    @jax.jit
    def derive(key):
        _, local = jax.random.split(key)
        return jax.random.split(jax.random.fold_in(local, 0), 3)[2]

    return derive(jax.random.PRNGKey(seed))


def evaluation(learner, worlds: int = EVALUATION_WORLDS):
    """Programs key -> (key, starts), and (policy, normalizer, starts) -> returns and success, (worlds,) each.

    Of the mean action, in the worlds that Brax's `Evaluator` draws from the same key, as much work as its:
    all worlds are stepped to the time limit.
    """
    import jax
    import jax.numpy as jnp

    env, networks = learner.env, learner.networks

    def begin(key):
        key, now = jax.random.split(key)
        return key, jax.vmap(env.reset)(jax.random.split(now, worlds))

    def run(policy, normalizer, state):
        zero = jnp.zeros_like(state.reward)

        def step(carry, _):
            state, total, success, active = carry
            seen = {"state": state.obs, "privileged_state": state.privileged}
            logits = networks.policy_network.apply(normalizer, policy, seen)
            state = jax.vmap(env.step)(state, networks.parametric_action_distribution.mode(logits))
            total = total + jnp.where(active, state.reward, 0)
            success = success + jnp.where(active, state.info["success"], 0)
            return (state, total, success, active & (state.done == 0)), None

        carry = (state, zero, zero, jnp.ones(worlds, bool))
        _, total, success, _ = jax.lax.scan(step, carry, length=env.episode_steps)[0]
        return total, success

    return begin, run


def run_simreal(plan: Plan, seed: int, record: Record) -> None:
    """simreal's learner."""
    import jax

    from simreal.compilation import SideBySide, for_rare_use, for_short_use
    from simreal.learner import Learner

    config = plan.config(seed)
    record.mark("import")
    env = make_environment(config)
    record.mark("environment")
    learner = Learner(env, config)
    shape, (begin, run) = learner.state_shape, evaluation(learner)
    with SideBySide() as compile_:
        started, (_, starts) = compile_(begin, shape.key, compiler_options=for_rare_use())
        ran, _ = compile_(
            run,
            *(shape.params.policy, shape.normalizer, starts),
            compiler_options=for_short_use(env.engine_name),
        )
        state = jax.block_until_ready(learner.init(seed))
    begin, run, key = started.result(), ran.result(), evaluation_key(seed)
    record.mark("set-up")
    for done in range(plan.evaluations + 1):
        before = time.monotonic()
        if done:
            state, _ = jax.block_until_ready(learner.epoch(state))
        trained = time.monotonic()
        key, starts = begin(key)
        total, success = jax.device_get(run(state.params.policy, state.normalizer, starts))
        seconds = {"train": trained - before, "evaluate": time.monotonic() - trained}
        record.evaluated(int(state.steps), total.mean(), success.mean(), **seconds)


def run_brax(plan: Plan, seed: int, record: Record) -> None:
    """`brax.training.agents.ppo.train` as it is."""
    from simreal.brax_adapter import BraxEnv  # first: it imports MJX without its two lines about Warp
    from simreal.networks import make_networks

    # isort: split
    from brax.training.agents.ppo import train as ppo

    config = plan.config(seed)
    hyper = config.learner
    record.mark("import")
    env = make_environment(config)
    record.mark("environment")

    def networks(observation_size, action_size, preprocess_observations_fn):
        sizes = (observation_size[name][0] for name in ("state", "privileged_state"))
        return make_networks(*sizes, action_size, config.network, hyper)

    trained = 0.0

    def progress(step: int, metrics: dict[str, Any]) -> None:
        nonlocal trained
        walltime = float(metrics.get("training/walltime", 0.0))
        seconds = {"train": walltime - trained, "evaluate": float(metrics["eval/epoch_eval_time"])}
        trained = walltime
        if not record.evaluations:
            record.marks["set-up"] = record.now() - seconds["evaluate"]
        record.evaluated(step, metrics["eval/episode_reward"], metrics["eval/episode_success"], **seconds)

    ppo.train(
        environment=BraxEnv(env, privileged=True),
        num_timesteps=plan.evaluations * plan.iterations * config.worlds * hyper.unroll_length,
        num_envs=config.worlds,
        episode_length=env.episode_steps,
        unroll_length=hyper.unroll_length,
        batch_size=config.worlds // hyper.minibatches,
        num_minibatches=hyper.minibatches,
        num_updates_per_batch=hyper.epochs,
        learning_rate=_rate(config),
        learning_rate_schedule=None if hyper.adaptive_kl is None else "ADAPTIVE_KL",
        desired_kl=hyper.adaptive_kl or 0.0,
        learning_rate_schedule_min_lr=hyper.min_learning_rate,
        learning_rate_schedule_max_lr=hyper.max_learning_rate,
        discounting=hyper.discount,
        gae_lambda=hyper.gae_lambda,
        clipping_epsilon=hyper.clip,
        clipping_epsilon_value=hyper.clip_value,
        entropy_cost=hyper.entropy_cost,
        vf_loss_coefficient=hyper.value_cost,
        max_grad_norm=hyper.max_gradient_norm,
        reward_scaling=hyper.reward_scale,
        normalize_observations=hyper.normalize_observations,
        normalize_observations_std_eps=NORMALIZER_FLOOR**2,  # Brax adds it to the variance
        network_factory=networks,
        seed=seed,
        num_evals=plan.evaluations + 1,
        num_eval_envs=EVALUATION_WORLDS,
        deterministic_eval=True,
        progress_fn=progress,
        max_devices_per_host=1,
    )


class FallingRate:
    """A learning rate that falls linearly, for Brax: optax calls it, `ppo.train` reports it as an array."""

    def __init__(self, first: float, last: float, updates: float) -> None:
        self.first, self.last, self.updates = first, last, updates

    def __call__(self, count):
        import jax.numpy as jnp

        return self.last + (self.first - self.last) * jnp.maximum(0.0, 1.0 - count / self.updates)

    def __jax_array__(self):
        import jax.numpy as jnp

        return jnp.asarray(self.first)


def _rate(config) -> float | FallingRate:
    """The learning rate that Brax gets: simreal's, which falls from update to update not step to step."""
    hyper = config.learner
    if hyper.decay_steps is None:
        return hyper.learning_rate
    assert hyper.adaptive_kl is None, "Brax cannot steer a rate that falls"
    updates = hyper.decay_steps / (config.worlds * hyper.unroll_length) * hyper.epochs * hyper.minibatches
    return FallingRate(hyper.learning_rate, hyper.min_learning_rate, updates)


def run_side(side: str, plan: Plan, seed: int, began: float, file: Path) -> None:
    """One process: trains, and adds its row to the file."""
    import jax

    compiled: dict[str, float] = {}

    def note(event: str, seconds: float, fun_name: str = "", **_: Any) -> None:
        if event.endswith(("jaxpr_to_mlir_module_duration", "backend_compile_duration")):
            compiled[fun_name] = compiled.get(fun_name, 0.0) + seconds

    jax.monitoring.register_event_duration_secs_listener(note)
    record = Record(began)
    {"simreal": run_simreal, "brax": run_brax}[side](plan, seed, record)

    from timing import machine

    from simreal.runs import describe

    manifest = describe(plan.config(seed), plan.engine, "")
    row = {
        "side": side,
        "seed": seed,
        "settings": plan.settings(),
        "commit": manifest["commit"],
        "started": manifest["started"],
        "machine": machine(),
        "marks": record.marks,
        "evaluations": record.evaluations,
        "compiled": {name: round(s, 3) for name, s in sorted(compiled.items(), key=lambda item: -item[1])},
    }
    with file.open("a", encoding="utf-8") as out:
        out.write(json.dumps(row) + "\n")


# -- rows into a table -------------------------------------------------------------------------------------


def reached(row: dict[str, Any]) -> int | None:
    """Index of the first evaluation at the threshold."""
    returns = [e["episode_return"] for e in row["evaluations"]]
    return next((i for i, value in enumerate(returns) if value >= RETURN_THRESHOLD), None)


def seconds_to_threshold(row: dict[str, Any]) -> float:
    """Wall time from the start of the process; infinite where the threshold was not reached."""
    last = reached(row)
    return math.inf if last is None else row["evaluations"][last]["seconds"]


def phases(row: dict[str, Any]) -> dict[str, float]:
    """Seconds of each phase up to the threshold, or to the end where it was not reached.

    A program compiles in its first call, and Brax's again in their second, on arguments that are placed
    differently: how much longer these calls take than the median of the later ones is called compilation.
    """
    evaluations, marks, last = row["evaluations"], row["marks"], reached(row)
    upto = evaluations if last is None else evaluations[: last + 1]
    training = [e["train"] for e in evaluations[1:]]
    evaluating = [e["evaluate"] for e in evaluations]
    compile_training = _compilation(training, len(upto) - 1)
    compile_evaluation = _compilation(evaluating, len(upto))
    seconds = {
        "import": marks["import"],
        "environment": marks["environment"] - marks["import"],
        "set-up": marks["set-up"] - marks["environment"],
        "compile training": compile_training,
        "compile evaluation": compile_evaluation,
        "collect and learn": sum(e["train"] for e in upto[1:]) - compile_training,
        "evaluate": sum(e["evaluate"] for e in upto) - compile_evaluation,
    }
    return seconds | {"other": upto[-1]["seconds"] - sum(seconds.values())}


def _compilation(seconds: Sequence[float], calls: int) -> float:
    """What the first two calls, of those that were made, take beyond the later ones."""
    usual = statistics.median(seconds[2:] or seconds[-1:])
    return sum(max(0.0, s - usual) for s in seconds[: min(2, calls)])


def summary(row: dict[str, Any]) -> str:
    """One line on one process."""
    seconds, last = seconds_to_threshold(row), row["evaluations"][-1]
    when = "threshold not reached" if math.isinf(seconds) else f"threshold after {seconds:.1f} s"
    return (
        f"{row['side']:8s} seed {row['seed']}: {when}; return {last['episode_return']:.1f}, success "
        f"{last['success']:.0%} after {last['step']:,} steps and {last['seconds']:.1f} s"
    )


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown over the seeds that both sides have finished."""
    from simreal.evaluation.statistics import paired_seed_interval, seed_interval

    by_key = {(row["side"], row["seed"]): row for row in rows}
    seeds = sorted({s for _, s in by_key if all((side, s) in by_key for side in SIDES)})
    if not seeds:
        return "no seed is finished on both sides"
    ours, theirs = ([by_key[side, s] for s in seeds] for side in SIDES)
    times = [[seconds_to_threshold(row) for row in side] for side in (ours, theirs)]
    medians = [statistics.median(side) for side in times]
    final = [[row["evaluations"][-1]["episode_return"] for row in side] for side in (ours, theirs)]
    spread = [[phases(row) for row in side] for side in (ours, theirs)]
    everyone = all(math.isfinite(t) for side in times for t in side)
    upto = f"up to a return of {RETURN_THRESHOLD:g}" if everyone else "up to the threshold, or the end"

    lines = [f"median seconds {upto} (seeds: {len(seeds)}) | simreal | Brax | simreal / Brax"]
    lines += ["--- | ---: | ---: | ---:"]
    for phase in PHASES:
        a, b = (statistics.median(row[phase] for row in side) for side in spread)
        lines.append(f"{phase} | {a:.1f} | {b:.1f} | {_ratio(a, b)}")
    lines.append(f"**time to a return of {RETURN_THRESHOLD:g}** | {_cells(*medians, '.1f')}")
    steps = [statistics.median(_steps(row) for row in side) for side in (ours, theirs)]
    lines += [f"environment steps to it | {_cells(*steps, ',.0f')}", ""]

    lines += ["seed | simreal, s | Brax, s | simreal / Brax | simreal, final return | Brax, final return"]
    lines += ["---: | ---: | ---: | ---: | ---: | ---:"]
    for i, seed in enumerate(seeds):
        cells = _cells(times[0][i], times[1][i], ".1f")
        lines.append(f"{seed} | {cells} | {final[0][i]:.1f} | {final[1][i]:.1f}")
    budget = ours[0]["evaluations"][-1]["step"]
    estimates = [seed_interval(values) for values in final]
    difference = paired_seed_interval(*final)
    lines += ["", f"final returns, after {budget:,} steps, mean over seeds and 95 % t interval:"]
    for name, estimate in (("simreal", estimates[0]), ("Brax", estimates[1]), ("simreal - Brax", difference)):
        lines.append(f"  {name}: {_interval(estimate)}")
    lines += ["", "lowering and XLA, median seconds of the programs that take 0.2 s or more:"]
    for name, side in zip(("simreal", "Brax"), (ours, theirs), strict=True):
        lines.append(f"  {name}: {_programs(side)}")
    commits = ", ".join(sorted({str(row["commit"]) for row in rows}))
    machines = ", ".join(sorted({row["machine"] for row in rows}))
    fast = all(map(math.isfinite, medians)) and medians[0] <= TIME_RATIO * medians[1]
    within = estimates[1].low is not None and estimates[1].low <= estimates[0].value
    lines += [
        "",
        f"time: {_ratio(*medians)} of Brax's, at most {TIME_RATIO:g} wanted: {_yes(fast)}",
        f"final return within Brax's interval, or above it: {_yes(within)}",
        f"{machines}; commit {commits}",
    ]
    return "\n".join(lines)


def _steps(row: dict[str, Any]) -> float:
    last = reached(row)
    return math.inf if last is None else row["evaluations"][last]["step"]


def _cells(a: float, b: float, form: str) -> str:
    return " | ".join([*("not reached" if math.isinf(x) else format(x, form) for x in (a, b)), _ratio(a, b)])


def _ratio(a: float, b: float) -> str:
    return f"{a / b:.2f}" if math.isfinite(a) and math.isfinite(b) and b > 0.05 else "-"


def _interval(estimate) -> str:
    if estimate.value is None:
        return "none: a return is not finite"
    limits = "" if estimate.low is None else f" [{estimate.low:.1f}, {estimate.high:.1f}]"
    return f"{estimate.value:.1f}{limits}"


def _programs(rows: Sequence[dict[str, Any]]) -> str:
    names = {name for row in rows for name in row["compiled"]}
    seconds = {name: statistics.median(row["compiled"].get(name, 0.0) for row in rows) for name in names}
    total = statistics.median(sum(row["compiled"].values()) for row in rows)
    long = [f"{name} {s:.1f}" for name, s in sorted(seconds.items(), key=lambda item: -item[1]) if s >= 0.2]
    return f"{', '.join(long)}; all {len(names)}: {total:.1f}"


def _yes(holds: bool) -> str:
    return "yes" if holds else "NO"


# -- all processes, one after the other --------------------------------------------------------------------


def read_rows(file: Path, plan: Plan) -> list[dict[str, Any]]:
    """Rows of earlier calls; ends the program where they were made with other settings."""
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    rows = [json.loads(line) for line in lines]
    settings = json.loads(json.dumps(plan.settings()))
    if any(row["settings"] != settings for row in rows):
        sys.exit(f"{file} was made with other settings or versions; remove it, or choose another --out")
    return rows


def run_all(plan: Plan, seeds: int, file: Path) -> None:
    """Every side and seed that is not in the file yet, sides in turns."""
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    environment |= {"SIMREAL_CACHE": "off", "JAX_ENABLE_COMPILATION_CACHE": "false"}
    finished = {(row["side"], row["seed"]) for row in read_rows(file, plan)}
    file.parent.mkdir(parents=True, exist_ok=True)
    # Once unmeasured, so that the first process does not pay for reading libraries from the disk.
    warm = "import simreal.brax_adapter, simreal.learner, brax.training.agents.ppo.train"
    subprocess.run([sys.executable, "-c", warm], env=environment, check=True)
    for seed in range(seeds):
        for side in SIDES if seed % 2 == 0 else reversed(SIDES):
            if (side, seed) in finished:
                continue
            command = [sys.executable, __file__, "--engine", plan.engine, "--out", str(file.parent)]
            command += ["--evaluations", str(plan.evaluations), "--iterations", str(plan.iterations)]
            command += ["--side", side, "--seed", str(seed), "--began", repr(time.monotonic())]
            subprocess.run(command, env=environment, check=True)
            print(summary(read_rows(file, plan)[-1]), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--engine", choices=("mujoco", "mjx"), default="mujoco")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--evaluations", type=int, default=12, help="after the one before training")
    parser.add_argument("--iterations", type=int, default=20, help="updates between two evaluations")
    parser.add_argument("--out", type=Path, default=Path("runs/against_brax"))
    for internal, kind in (("--side", str), ("--seed", int), ("--began", float)):
        parser.add_argument(internal, type=kind, help=argparse.SUPPRESS)
    options = parser.parse_args()
    jax_version = importlib.metadata.version("jax")
    if tuple(int(part) for part in jax_version.split(".")[:2]) >= (0, 10):
        print(f"Brax's PPO does not run on JAX {jax_version}; `make bench-brax` runs this where it does")
        return
    plan = Plan(options.engine, options.evaluations, options.iterations)
    file = options.out / f"{plan.engine}.jsonl"
    if options.side:
        run_side(options.side, plan, options.seed, options.began, file)
        return
    try:
        run_all(plan, options.seeds, file)
    except KeyboardInterrupt:
        sys.exit(130)
    print("\n" + table(read_rows(file, plan)))


if __name__ == "__main__":
    main()
