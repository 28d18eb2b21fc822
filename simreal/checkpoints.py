"""Checkpoints of a whole training state: saved by Orbax, sealed with digests, restored bit for bit.

A checkpoint is `checkpoints/<step>/`: Orbax's files in `state/`, and `sha256.json` with the digest of each.
The digests are checked before Orbax sees the files, because it answers damaged ones with pages of traces.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import logging
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from concurrent import futures
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from simreal.errors import UserError

Tree = TypeVar("Tree")

SEAL = "sha256.json"
SCORE = "score.json"
ROOM = 2.0
"""Free bytes asked for per byte of state, and `SPARE` more: a disk that fills up while Orbax writes ends in
pages of traces, so that is seen before."""
SPARE = 2_000_000


_WRITER = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
"""Writes the checkpoints of all runs of this process, one after the other."""


class Checkpoints:
    """The checkpoints of one run.

    Args:
        folder: made when the first one is saved.
        keep: how many of the newest stay.
        keep_every: environment steps; the first checkpoint in each stretch of as many stays for good.
        keep_best: whether the one with the best score stays.
    """

    def __init__(
        self, folder: Path, keep: int = 3, keep_every: int | None = None, keep_best: bool = False
    ) -> None:
        self.folder = folder
        self.keep = keep
        self.keep_every = keep_every
        self.keep_best = keep_best
        self._saving: Future[int] | None = None

    def steps(self) -> list[int]:
        """Steps at which there are checkpoints, sound or not, oldest first."""
        if not self.folder.is_dir():
            return []
        return sorted(int(path.name) for path in self.folder.iterdir() if path.name.isdecimal())

    def begin_save(self, step: int, state: Any, score: float | None = None) -> None:
        """`save` in the background, after a copy of the state was taken; waits for the one before.

        Raises:
            UserError: the one before could not be written.
        """
        self.finish()
        leaves = {name: np.array(leaf) for name, leaf in flatten(state).items()}
        self._saving = _WRITER.submit(self._save, step, leaves, score)

    def finished(self, wait: bool = False) -> int | None:
        """The step of the save in the background, once, as soon as it is done.

        Raises:
            UserError: it could not be written.
        """
        if self._saving is None or not (wait or self._saving.done()):
            return None
        futures.wait([self._saving])  # before it is forgotten: this may be interrupted
        saving, self._saving = self._saving, None
        return saving.result()

    def finish(self) -> int | None:
        """`finished`, waited for."""
        return self.finished(wait=True)

    def save(self, step: int, state: Any, score: float | None = None) -> None:
        """Saves a pytree of arrays; afterwards either all of it is there under this step, or nothing is.

        Args:
            step: names it.
            state: of arrays.
            score: higher is better, for `keep_best`.

        Raises:
            UserError: it cannot be written (disk full, no permission); older checkpoints are untouched.
        """
        self._save(step, flatten(state), score)

    def _save(self, step: int, state: Mapping[str, np.ndarray], score: float | None) -> int:
        import orbax.checkpoint as ocp

        # Orbax cannot hold an array of no elements; restoring takes it from the structure.
        leaves = {name: leaf for name, leaf in state.items() if leaf.size}
        final = self.folder / str(step)
        draft = self.folder / f"{step}.unfinished"
        if final.exists() and _flaw(final) is None and _score(final) == score:
            return step  # the same step of the same run is the same state, bit for bit
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            for left_over in self.folder.glob("*.unfinished*"):
                shutil.rmtree(left_over)
            _check_room(self.folder, sum(leaf.nbytes for leaf in leaves.values()))
            with _silence(), ocp.Checkpointer(ocp.StandardCheckpointHandler()) as checkpointer:
                checkpointer.save(draft.absolute() / "state", leaves)
            (draft / SCORE).write_text(json.dumps(score), encoding="utf-8")
            (draft / SEAL).write_text(json.dumps(_digests(draft), indent=1), encoding="utf-8")
            if final.exists():  # a damaged one that resuming passed over
                final.rename(self.folder / f"{step}.unfinished.old")
            draft.rename(final)
            shutil.rmtree(self.folder / f"{step}.unfinished.old", ignore_errors=True)
            self._thin_out()
        except (OSError, ValueError) as error:
            shutil.rmtree(draft, ignore_errors=True)
            reason = _disk_trouble(error)
            if reason is None:
                raise
            last = max((s for s in self.steps() if s != step), default=None)
            kept = "there is no earlier one" if last is None else f"the one at step {last} is intact"
            raise UserError(f"cannot save a checkpoint in {self.folder}: {reason}; {kept}") from error
        return step

    def _thin_out(self) -> None:
        """Removes what neither number, interval nor score keeps."""
        steps = self.steps()
        kept = set(steps[-self.keep :])
        if self.keep_every:
            stretches: dict[int, int] = {}
            for step in steps:
                stretches.setdefault(step // self.keep_every, step)
            kept |= set(stretches.values())
        best = self.best()
        if self.keep_best and best is not None:
            kept.add(best)
        for step in steps:
            if step not in kept:
                shutil.rmtree(self.folder / str(step))

    def best(self) -> int | None:
        """The step with the highest score, of equal ones the newest; None where none has a score."""
        scores = {step: _score(self.folder / str(step)) for step in self.steps()}
        known = {step: score for step, score in scores.items() if score is not None}
        return max(known, key=lambda step: (known[step], step), default=None)

    def sound_steps(self) -> list[int]:
        """Steps of the checkpoints whose files are as they were written, oldest first."""
        return [step for step in self.steps() if _flaw(self.folder / str(step)) is None]

    def restore(
        self, like: Tree, say: Callable[[str], None], partial: bool = False, newest: int | None = None
    ) -> tuple[int, Tree] | None:
        """The newest sound checkpoint.

        Args:
            like: a state of the same structure, such as a fresh one; its values do not matter.
            say: called with one line for each damaged checkpoint that is passed over.
            partial: whether `like` may lack some of what was saved.
            newest: no checkpoint after this step.

        Returns:
            Step and state, or None where nothing was ever saved.

        Raises:
            UserError: there are checkpoints but none is sound, or it belongs to another configuration.
        """
        for step in reversed(self.steps()):
            if newest is not None and step > newest:
                continue
            flaw = _flaw(self.folder / str(step))
            if flaw is None:
                return step, unflatten(like, self._read(step), f"{self.folder / str(step)}", partial)
            say(f"checkpoint {self.folder / str(step)} is damaged ({flaw}); falling back to the one before")
        if self.steps():
            raise UserError(f"no usable checkpoint in {self.folder}: all {len(self.steps())} are damaged")
        return None

    def raw(self) -> dict[str, np.ndarray]:
        """Everything that the newest checkpoint holds, by its path in the state; no structure is needed."""
        return self._read(self.steps()[-1])

    def _read(self, step: int) -> dict[str, np.ndarray]:
        import orbax.checkpoint as ocp

        with _silence(), ocp.Checkpointer(ocp.StandardCheckpointHandler()) as checkpointer:
            return checkpointer.restore(self.folder.absolute() / str(step) / "state")

    def discard_after(self, step: int) -> None:
        """Removes what is newer than the checkpoint that a run goes on from."""
        for newer in self.steps():
            if newer > step:
                shutil.rmtree(self.folder / str(newer))


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Keeps Orbax from logging an error that is raised, and told in one line, as well."""
    logger = logging.getLogger("absl")
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


def flatten(tree: Any) -> dict[str, np.ndarray]:
    """Leaves by their path in the tree, on the host; a typed key becomes its uint32 data."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path): np.asarray(_raw(leaf)) for path, leaf in leaves}


def _raw(leaf: Any) -> Any:
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def unflatten(like: Tree, saved: dict[str, np.ndarray], where: str, partial: bool = False) -> Tree:
    """What `flatten` took apart, as a tree of JAX arrays.

    Args:
        like: of the same structure, arrays or their shapes.
        saved: leaves by their path.
        where: named in the error.
        partial: whether `like` may lack some of what was saved.

    Raises:
        UserError: other leaves, or other shapes.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(like)
    expected = {jax.tree_util.keystr(path): leaf for path, leaf in leaves}
    for name in expected if partial else [*expected, *saved]:
        there = _shape(saved[name]) if name in saved else "absent"
        here = _shape(_raw(expected[name])) if name in expected else "absent"
        empty = name in expected and name not in saved and not expected[name].size
        if there != here and not empty:
            raise UserError(f"{where} belongs to another configuration: {name} is {there} there, {here} here")
    return jax.tree.unflatten(structure, [_revive(leaf, saved.get(name)) for name, leaf in expected.items()])


def _revive(like: Any, saved: np.ndarray | None) -> Any:
    if saved is None:
        return like
    array = jnp.array(saved)  # a copy: the learner may donate it
    return jax.random.wrap_key_data(array, impl=jax.random.key_impl(like)) if _is_key(like) else array


def _shape(leaf: Any) -> str:
    return f"{np.dtype(leaf.dtype).name}{list(leaf.shape)}"


def _score(folder: Path) -> float | None:
    try:
        return json.loads((folder / SCORE).read_text(encoding="utf-8"))
    except (OSError, ValueError):  # older, or damaged
        return None


def _digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != SEAL)
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files
    }


def _flaw(folder: Path) -> str | None:
    """What is wrong with the files of a checkpoint, or None."""
    try:
        sealed = json.loads((folder / SEAL).read_text(encoding="utf-8"))
        found = _digests(folder)
    except (OSError, ValueError):
        return f"{SEAL} cannot be read"
    for name, digest in sealed.items():
        if found.get(name) != digest:
            return f"{name} {'has changed' if name in found else 'is missing'}"
    return None


def _disk_trouble(error: OSError | ValueError) -> str | None:
    """What the operating system said; tensorstore wraps that in a ValueError and a page of paths."""
    if isinstance(error, OSError):
        return error.strerror or str(error)
    found = re.search(r"([^:]*) \[os_error_code", str(error))
    return found[1].strip() if found else None


def _check_room(folder: Path, size: int) -> None:
    free, needed = shutil.disk_usage(folder).free, ROOM * size + SPARE
    if free < needed:
        raise OSError(
            errno.ENOSPC, f"only {free / 1e6:.1f} MB are free on the disk, {needed / 1e6:.1f} are needed"
        )
