"""Worlds that blew up, on disk: what they were, and what led to it, so that it can be run again.

A file holds the whole state of one world at a moment before it blew up, and every action from then on; an
environment steps the same physics, actuators, sensors and noise from these. Plain arrays and JSON: no pickle.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from simreal.checkpoints import flatten, unflatten
from simreal.errors import UserError

if TYPE_CHECKING:
    from simreal.environment import Environment, State
    from simreal.rollout import Flight, RolloutState

SCHEMA = 1
SECONDS = 1.0
"""How long before the end a recording begins, where the episode is that old."""
_BEGIN = "begin"
"""Before the paths of the state's leaves."""


@dataclass(frozen=True)
class Recording:
    """The end of an episode that blew up in its last step.

    `actions` (n, actions) lead from the state `begin` to the end. `age` (n,) counts control steps of the
    episode; `qpos` (n, nq) and `qvel` (n, nv) are the physics after each action, in the last row the last
    that was fine. `meta` says where this was: run, engine, environment steps of training, world.
    """

    meta: dict[str, Any]
    begin: dict[str, np.ndarray]
    actions: np.ndarray
    age: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray

    def save(self, file: Path) -> None:
        """Writes the file; a reader meets all of it or nothing."""
        file.parent.mkdir(parents=True, exist_ok=True)
        arrays = {name: getattr(self, name) for name in ("actions", "age", "qpos", "qvel")}
        arrays |= {_BEGIN + path: leaf for path, leaf in self.begin.items()}
        draft = file.with_name(f".{file.name}.{os.getpid()}")
        with draft.open("wb") as out:
            np.savez_compressed(out, meta=np.array(json.dumps(self.meta)), **arrays)
        draft.replace(file)

    @classmethod
    def load(cls, file: Path) -> Recording:
        """Reads what `save` wrote.

        Raises:
            UserError: no such file, or not one of these.
        """
        try:
            with np.load(file, allow_pickle=False) as arrays:
                held = dict(arrays)
            meta = json.loads(str(held.pop("meta")))
            if meta["schema"] != SCHEMA:
                raise UserError(f"{file}: written by another version of simreal (schema {meta['schema']})")
            rows = {name: held.pop(name) for name in ("actions", "age", "qpos", "qvel")}
        except FileNotFoundError:
            raise UserError(f"{file}: no such file; a run keeps its blown worlds in RUN/quarantine") from None
        except UserError:
            raise
        except Exception as error:
            raise UserError(f"{file}: no recording of a world, or damaged ({error})") from None
        return cls(meta, {name.removeprefix(_BEGIN): leaf for name, leaf in held.items()}, **rows)

    def state(self, env: Environment) -> State:
        """The state that the recording begins with.

        Raises:
            UserError: it is of another environment, or of one with other factors.
        """
        like = jax.eval_shape(env.reset, jax.ShapeDtypeStruct((2,), np.uint32))
        return unflatten(like, self.begin, "this recording")


class Recorder:
    """Writes a file for each world that blows up while a learner collects.

    Keeps the worlds as they were before each of the last few unrolls: references, not copies.

    Args:
        folder: where files go; made when the first world blows up.
        meta: what every file says of its run.
        control_dt: s.
        unroll_length: control steps in an unroll.
        most: files written at most.
        member: which one of a population to record; leaves then have its axis before the others.
    """

    def __init__(
        self,
        folder: Path,
        meta: Mapping[str, Any],
        control_dt: float,
        unroll_length: int,
        most: int,
        member: int | None = None,
    ) -> None:
        self.folder = folder
        self.meta = dict(meta)
        self.most = most
        self._own = () if member is None else (member,)
        self.written = len(list(folder.glob("*.npz"))) if folder.is_dir() else 0
        self._steps = math.ceil(SECONDS / control_dt)
        self._unroll_length = unroll_length
        self._past: deque[tuple[int, RolloutState, Flight]] = deque(
            maxlen=math.ceil(self._steps / unroll_length) + 1
        )
        self._unread = False

    def watch(self, steps: int, before: RolloutState, flight: Flight) -> None:
        """Called after each unroll. The one before is read now, so that nobody waits for this one."""
        self.flush()
        if self.written < self.most:
            self._past.append((steps, before, flight))
            self._unread = True

    def flush(self) -> None:
        """Reads the newest unroll."""
        if not self._unread:
            return
        self._unread = False
        _, _, flight = self._past[-1]
        quarantined = np.asarray(flight.quarantined)[self._own]
        for step, world in np.argwhere(quarantined):
            if self.written < self.most:
                recording = self._record(int(step), int(world))
                name = f"{recording.meta['training_step']:010d}-{step:03d}-{world:05d}.npz"
                if not (self.folder / name).exists():  # a resumed run comes by again, with a shorter past
                    recording.save(self.folder / name)
                    self.written += 1

    def _record(self, last: int, world: int) -> Recording:
        """What led to the blow-up of a world in step `last` of the newest unroll.

        Goes back unroll by unroll, to one that the episode was already in when it began and that is long
        enough ago; or to the start of the episode, which lay in reserve.
        """
        training_step, own = self._past[-1][0], self._own
        pieces: list[Flight] = []
        for _, before, flight in reversed(self._past):
            upto = (*own, slice(last + 1), world)
            age, origin = (np.asarray(leaf)[upto] for leaf in (flight.age, flight.origin))
            same = (np.diff(age) == 1) & (np.diff(origin) == 0)
            first = last - int(np.argmin(np.append(same[::-1], False)))
            rows, here = (*own, slice(first, last + 1), world), (*own, world)
            pieces.insert(0, jax.tree.map(lambda leaf, rows=rows: np.asarray(leaf)[rows], flight))
            went_on = int(before.env.steps[here]) == age[0] - 1 and not before.env.done[here]
            if first or not went_on:
                start = (*own, origin[first])
                begin = jax.tree.map(lambda leaf, start=start: leaf[start], before.reserve.starts)
                begin = dataclasses.replace(begin, steps=age[first] - 1)  # staggered ones begin older
                break
            begin = jax.tree.map(lambda leaf, here=here: leaf[here], before.env)
            if sum(len(piece.age) for piece in pieces) >= self._steps:
                break
            last = self._unroll_length - 1
        flight = jax.tree.map(lambda *leaves: np.concatenate(leaves), *pieces)
        return Recording(
            meta=self.meta | {"schema": SCHEMA, "training_step": training_step, "world": world},
            begin=flatten(begin),
            actions=flight.action,
            age=flight.age,
            qpos=flight.qpos,
            qvel=flight.qvel,
        )
