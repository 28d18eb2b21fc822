"""Several runs in one compiled program: other seeds, other numbers of the learner, other ranges.

Each member is what it would be alone: its own worlds, networks, optimiser and key, and nothing that passes
from one to another. What they share is the programs, which are compiled once, and the physics, which steps
the worlds of all members in one call.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from simreal.compilation import SideBySide, for_rare_use
from simreal.config import RunConfig
from simreal.environment import Environment
from simreal.errors import UserError
from simreal.learner import Hyper, Learner, Programs, TrainingState, Watch, iterate, summarise
from simreal.policy import Policy
from simreal.resuming import flat
from simreal.rollout import RolloutState

MAY_DIFFER = ("seed", "randomizer", *(f"learner.{f.name}" for f in dataclasses.fields(Hyper)))
"""Settings that each member may have its own of; null everywhere or nowhere."""


class Population:
    """Trains one policy for each of `configs` on one environment. Arrays of a state are (members, ...).

    Args:
        env: the environment, bound to the training ranges of the first member.
        configs: of the members.
        ranges: training ranges of each member, as `env.randomizer.ranges`; default: those of `env`.

    Raises:
        UserError: no members, or members that differ in what is compiled into the program.
    """

    def __init__(
        self, env: Environment, configs: Sequence[RunConfig], ranges: Sequence[Any] | None = None
    ) -> None:
        check_members(configs)
        self.env = env
        self.configs = tuple(configs)
        self.single = Learner(env, configs[0])
        hypers = [Hyper.of(config.learner) for config in configs]
        self.hyper: Hyper = jax.tree.map(lambda *numbers: np.asarray(numbers, np.float32), *hypers)
        each = ranges or [env.randomizer.ranges] * len(configs)
        if len({jax.tree.structure(one) for one in each}) > 1:
            raise UserError(
                "members of a population may not differ in the kind of a distribution, only in its numbers: "
                "give `randomizer` the same factors in all"
            )
        self.ranges = jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)

    @property
    def members(self) -> int:
        """How many runs these are."""
        return len(self.configs)

    @property
    def steps_per_epoch(self) -> int:
        """Environment steps that one epoch of one member learns from."""
        return self.single.steps_per_epoch

    @functools.cached_property
    def _programs(self) -> Programs:
        """The programs of one run, for all members at once."""
        single = self.single
        collect, refill = jax.vmap(single.collect), jax.vmap(single.rollout.refill)
        update = _each(single.update)
        start = jax.vmap(single._start)
        seeds = jax.ShapeDtypeStruct((self.members,), jnp.uint32)
        state = jax.eval_shape(start, seeds, self.hyper, self.ranges)
        assert isinstance(state.rollout, RolloutState)
        with SideBySide() as compile_:
            collected, (_, data, ended, _) = compile_(
                collect, *(state.rollout, state.params.policy, state.normalizer, state.key)
            )
            updated, _ = compile_(
                update, dataclasses.replace(state, rollout=()), data, ended, self.hyper, donate_argnums=0
            )
            refilled, _ = compile_(
                refill, *(state.rollout.reserve, state.ranges), compiler_options=for_rare_use()
            )
            started, _ = compile_(start, seeds, self.hyper, self.ranges, compiler_options=for_rare_use())
        learn = updated.result()
        return Programs(
            start=lambda seeds: started.result()(seeds, self.hyper, self.ranges),
            refill=refilled.result(),
            collect=collected.result(),
            update=lambda state, data, ended: learn(state, data, ended, self.hyper),
        )

    def init(self) -> TrainingState:
        """All members before their first step."""
        return self._programs.start(np.array([config.seed for config in self.configs], np.uint32))

    def epoch(
        self, state: TrainingState, watch: Watch = lambda steps, before, flight: None
    ) -> tuple[TrainingState, list[dict[str, float]]]:
        """An epoch of every member, and a row of metrics for each. The state passed in is used up."""
        state, rows = iterate(self._programs, state, self.configs[0], watch)
        rows, last_success = jax.device_get((rows, state.last_success))
        each = [
            [{name: value[i] for name, value in row.items()} for row in rows] for i in range(self.members)
        ]
        return state, [summarise(row, last_success[i]) for i, row in enumerate(each)]

    def export(self, member: TrainingState, index: int) -> Policy:
        """The policy of one member, from its own state."""
        return Policy.from_training(self.env, self.configs[index], member.params.policy, member.normalizer)


def check_members(configs: Sequence[RunConfig]) -> None:
    """Raises UserError where configurations cannot be members of one population."""
    if not configs:
        raise UserError("a population needs at least one member")
    first = flat(configs[0].to_dict(), MAY_DIFFER)
    for config in configs[1:]:
        other = flat(config.to_dict(), MAY_DIFFER)
        for place in first | other:
            one, two = first.get(place), other.get(place)
            may = place in MAY_DIFFER and (one is None) == (two is None)
            if one != two and not may:
                raise UserError(
                    f"members of a population may not differ in {place} ({one} and {two}); "
                    f"they may in {', '.join(MAY_DIFFER)}"
                )


def _each(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` of every member: side by side on an accelerator; one after the other on a CPU, so that the
    matrix products are those of a single run."""
    if jax.default_backend() != "cpu":
        return jax.vmap(function)
    return lambda *members: jax.lax.map(lambda one: function(*one), members)
