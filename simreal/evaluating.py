"""`simreal evaluate`: a run's policy on named sets of worlds, its numbers, its plots and its report."""

from __future__ import annotations

import dataclasses
import json
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Console

from simreal.errors import UserError
from simreal.evaluation import requirements
from simreal.evaluation.requirements import Requirement
from simreal.runs import Run

if TYPE_CHECKING:
    from simreal.config import RunConfig
    from simreal.environment import Environment
    from simreal.evaluation.evaluator import Evaluator, Note
    from simreal.evaluation.results import Evaluation, SetResult
    from simreal.worldsets import WorldSet

RANGE = "range"
"""Name of the set that `--range` asks for."""


@dataclass(frozen=True)
class Request:
    """What is to be evaluated; whatever can be checked without JAX has been."""

    run: Run
    sets: tuple[str, ...] | None
    """Only these, without factor curves and heat map; None: everything."""
    ranges: dict[str, tuple[float, float]]
    """factor -> low, high: one more set, in which these are drawn from here and the rest as in training."""
    worlds: int | None
    engine: str | None
    requirements: tuple[Requirement, ...]
    against: Run | None = None
    """Another run of the same environment, whose policy meets the same worlds."""
    best: bool = False
    """The policy that did best in training, instead of the last one."""

    @property
    def policy(self) -> Path:
        """Where the policy lies."""
        return self.run.best_policy if self.best else self.run.folder

    @classmethod
    def parse(
        cls,
        run: Path,
        sets: str | None = None,
        ranges: Sequence[str] = (),
        worlds: int | None = None,
        engine: str | None = None,
        require: Sequence[str] = (),
        against: Path | None = None,
        best: bool = False,
    ) -> Request:
        """Reads the arguments of the command line.

        Raises:
            UserError: no such run, or an argument that cannot be read.
        """
        if worlds is not None and worlds < 1:
            raise UserError(f"--worlds: must be at least 1, got {worlds}")
        names = None if sets is None else tuple(name.strip() for name in sets.split(",") if name.strip())
        if names == ():
            raise UserError("--sets: names no set")
        opened, rival = Run.open(run), Run.open(against) if against is not None else None
        if rival is not None and rival.config().environment != opened.config().environment:
            raise UserError(
                f"--against {against}: a run of {rival.config().environment}; "
                f"{run} is one of {opened.config().environment}"
            )
        if best and not opened.best_policy.is_dir():
            raise UserError(
                f"--best: {opened.best_policy} is not there; without it the last policy is measured"
            )
        return cls(
            opened,
            names,
            dict(_parse_range(text) for text in ranges),
            worlds,
            engine,
            tuple(requirements.parse_requirement(text) for text in require),
            rival,
            best,
        )


def evaluate(request: Request, as_json: bool = False) -> list[str]:
    """Evaluates, writes `transfer.json`, `plots/` and `report.html` into the run, and prints the table.

    Returns:
        A line for each requirement that does not hold.

    Raises:
        UserError: no policy in the run, an unknown set or factor, a range that the factor cannot have.
    """
    from simreal.evaluation.report import write_report
    from simreal.evaluation.transfer import terminal_table, transfer, write_transfer

    console = Console(stderr=True, highlight=False)
    with console.status("compiling") as status:
        evaluation = evaluate_run(request, note=status.update)
        run = request.run
        content = transfer(evaluation)
        write_transfer(content, run.folder / "transfer.json")
        comparison = _compare(request, evaluation, status.update)
        video = _film(request, evaluation, status.update)
        status.update("writing the report")
        page = write_report(
            run.folder,
            evaluation,
            content,
            run.metrics(),
            run.manifest(),
            run.config_file.read_text(encoding="utf-8"),
            shlex.join(["simreal", *sys.argv[1:]]),
            video,
            comparison,
        )
    print(json.dumps(content, indent=2) if as_json else f"{terminal_table(content)}\n\nreport: {page}")
    return requirements.check(request.requirements, content)


def evaluate_run(request: Request, note: Note = lambda text: None) -> Evaluation:
    """The measurements alone, world by world."""
    from simreal import quiet

    quiet.import_mjx()
    from simreal.evaluation.evaluator import Evaluator, choose_sets
    from simreal.evaluation.results import Evaluation
    from simreal.policy import load_policy
    from simreal.training import make_environment

    config = request.run.config()
    engine = request.engine or request.run.manifest().get("engine", config.engine)
    policy = load_policy(request.policy)
    env = make_environment(config, engine)
    sets = choose_sets(env, request.sets)
    known = [*(worldset.name for worldset in sets), *([RANGE] if request.ranges else [])]
    for requirement in request.requirements:
        requirements.parse_requirement(requirement.text, known)
    settings = config.evaluation
    worlds = request.worlds or settings.worlds
    ranged = _ranged_environment(config, engine, request.ranges) if request.ranges else None
    evaluator = Evaluator(env, policy, settings.seed)
    results: dict[str, SetResult] = {}
    for worldset in sets:
        note(f"set {worldset.name}")
        results[worldset.name] = _run_set(evaluator, worldset, worlds)
    if ranged is not None:
        note(f"set {RANGE}")
        results[RANGE] = _run_range(evaluator, ranged, request.ranges, worlds)
    curves, heat_map = {}, None
    if request.sets is None and settings.factor_points > 0:
        curves = evaluator.run_factors(settings.factor_points, settings.factor_worlds, note)
        if settings.heat_map:
            note("heat map")
            heat_map = evaluator.run_heat_map(curves, settings.factor_worlds)
    return Evaluation(
        environment=config.environment,
        engine=env.engine_name,
        seed=settings.seed,
        run=str(request.run.folder),
        sets=results,
        factors=curves,
        heat_map=heat_map,
    )


def _compare(request: Request, evaluation: Evaluation, note: Note) -> dict[str, Any] | None:
    """The other run's policy on the same sets, set by set; None without another run."""
    if request.against is None:
        return None
    from simreal.evaluation.evaluator import Evaluator, choose_sets
    from simreal.evaluation.transfer import compare
    from simreal.policy import load_policy
    from simreal.training import make_environment

    env = make_environment(request.run.config(), evaluation.engine)
    rival = Evaluator(env, load_policy(request.against.folder), evaluation.seed)
    results = {}
    for worldset in choose_sets(env, [name for name in evaluation.sets if name != RANGE]):
        note(f"{request.against.folder.name} on {worldset.name}")
        results[worldset.name] = rival.run_set(worldset, len(evaluation.sets[worldset.name].success))
    other = dataclasses.replace(evaluation, run=str(request.against.folder), sets=results, factors={})
    labels = [f"{run.folder.name} ({run.config().randomization})" for run in (request.run, request.against)]
    return compare(evaluation, other, (labels[0], labels[1]))


def _film(request: Request, evaluation: Evaluation, note: Note) -> Path | None:
    """An episode in a world of the `train` set, as an animation for the report; None where there can be none.

    The episode is the one whose return is the median of the set: typical, not the best.
    """
    if not request.run.config().evaluation.video or "train" not in evaluation.sets:
        return None
    from simreal.evaluation.film import film, record
    from simreal.policy import load_policy
    from simreal.training import make_environment
    from simreal.video import RenderingUnavailable

    note("filming")
    env = make_environment(request.run.config(), evaluation.engine)
    shown = evaluation.sets["train"]
    median = int(np.argsort(shown.episode_return)[len(shown.episode_return) // 2])
    episode = record(env, load_policy(request.policy), shown.draws, median, evaluation.seed)
    try:
        return film(env, episode, request.run.folder / "plots", "train_median")
    except RenderingUnavailable as error:
        Console(stderr=True, highlight=False).print(f"no pictures: {error}")
        return None


def _run_set(evaluator: Evaluator, worldset: WorldSet, worlds: int) -> SetResult:
    """A named set. Where the run trained on wider ranges than the environment's, it may not be held out."""
    result = evaluator.run_set(worldset, worlds)
    try:
        worldset.check(evaluator.env.randomizer)
    except UserError as error:
        words = f"{worldset.description}; NOT outside what this run trained on ({error})"
        return dataclasses.replace(result, claims_outside=False, description=words)
    return result


def _ranged_environment(
    config: RunConfig, engine: str, ranges: dict[str, tuple[float, float]]
) -> Environment:
    """The environment with other ranges: it refuses factors and ranges that cannot be."""
    from simreal.training import make_environment

    return make_environment(dataclasses.replace(config, randomizer={**config.randomizer, **ranges}), engine)


def _run_range(
    evaluator: Evaluator, ranged: Environment, ranges: dict[str, tuple[float, float]], worlds: int
) -> SetResult:
    from simreal.evaluation.evaluator import HARDWARE
    from simreal.evaluation.results import SetResult
    from simreal.worldsets import WorldSet, digest

    words = ", ".join(f"{name} in [{low:g}, {high:g}]" for name, (low, high) in ranges.items())
    worldset = WorldSet(RANGE, f"{words}, the rest as in training", "train")
    draws = worldset.draws(ranged.randomizer, worlds, evaluator.seed)
    outcome = evaluator.run(draws)
    return SetResult(
        name=RANGE,
        description=worldset.description,
        claims_outside=False,
        digest=digest(worldset, draws, evaluator.seed),
        draws=draws,
        **{name: outcome[name] for name in ("episode_return", "success", "steps", "ended_by")},
        hardware={name: outcome[name] for name in HARDWARE},
    )


def _parse_range(text: str) -> tuple[str, tuple[float, float]]:
    factor, equals, limits = text.partition("=")
    low, colon, high = limits.partition(":")
    try:
        if not (factor and equals and colon):
            raise ValueError
        pair = float(low), float(high)
    except ValueError:
        raise UserError(f"--range '{text}': expected FACTOR=LOW:HIGH, as in 'pole_mass=0.5:2'") from None
    if not pair[0] <= pair[1]:
        raise UserError(f"--range '{text}': low {pair[0]:g} is above high {pair[1]:g}")
    return factor, pair
