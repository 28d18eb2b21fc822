"""Checkpoints: bit-exact, atomic, kept within bounds, and never trusted when they are damaged."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from simreal.checkpoints import Checkpoints
from simreal.errors import UserError


class Empty(NamedTuple):
    """A node without leaves, such as optax keeps."""


def state(seed: int, hidden: int = 8) -> dict[str, Any]:
    """A tree with everything that a training state may hold."""
    rng = np.random.default_rng(seed)
    return {
        "parameters": {
            "kernel": jnp.asarray(rng.normal(size=(4, hidden)), jnp.float32),
            "bias": jnp.zeros(hidden),
        },
        "optimiser": (Empty(), (jnp.asarray(seed, jnp.int32), None)),
        "half": jnp.asarray(rng.normal(size=5), jnp.bfloat16),
        "odd": jnp.asarray([np.nan, -0.0, np.inf, 1e-42], jnp.float32),
        "done": jnp.asarray([True, False]),
        "key": jnp.asarray(rng.integers(0, 2**32, (3, 2)), jnp.uint32),
        "typed_key": jax.random.split(jax.random.key(seed), 2),
        "memory": jnp.zeros((6, 0)),
        "nothing": (),
    }


def bits(tree: Any) -> list[bytes]:
    """The bytes of every leaf."""
    leaves = jax.tree.leaves(tree)
    return [
        np.asarray(
            jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf
        ).tobytes()
        for leaf in leaves
    ]


def silent(line: str) -> None:
    raise AssertionError(f"nothing to say, but: {line}")


def test_a_state_comes_back_bit_for_bit(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    checkpoints.save(7, state(seed=1))
    found = checkpoints.restore(like=state(seed=2), say=silent)
    assert found is not None
    step, restored = found
    assert step == 7
    assert jax.tree.structure(restored) == jax.tree.structure(state(seed=1))
    assert [(leaf.dtype, leaf.shape) for leaf in jax.tree.leaves(restored)] == [
        (leaf.dtype, leaf.shape) for leaf in jax.tree.leaves(state(seed=1))
    ]
    assert bits(restored) == bits(state(seed=1))


def test_the_newest_are_kept_and_the_last_is_restored(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path, keep=2)
    for step in (9, 10, 100):
        checkpoints.save(step, state(seed=step))
    assert checkpoints.steps() == [10, 100]
    found = checkpoints.restore(like=state(seed=0), say=silent)
    assert found is not None
    assert found[0] == 100
    assert bits(found[1]) == bits(state(seed=100))


def test_no_checkpoint_at_all_is_a_fresh_start(tmp_path: Path) -> None:
    assert Checkpoints(tmp_path / "none").restore(like=state(seed=0), say=silent) is None


def largest_file(folder: Path) -> Path:
    return max((path for path in folder.rglob("*") if path.is_file()), key=lambda path: path.stat().st_size)


def truncate(folder: Path) -> None:
    path = largest_file(folder)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip_a_bit(folder: Path) -> None:
    path = largest_file(folder)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))


def lose_a_file(folder: Path) -> None:
    largest_file(folder).unlink()


def lose_the_seal(folder: Path) -> None:
    (folder / "sha256.json").unlink()


@pytest.mark.parametrize("damage", [truncate, flip_a_bit, lose_a_file, lose_the_seal])
def test_a_damaged_checkpoint_is_passed_over_in_one_line(
    damage: Any, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, state(seed=1))
    checkpoints.save(2, state(seed=2))
    damage(tmp_path / "2")
    said: list[str] = []
    found = checkpoints.restore(like=state(seed=0), say=said.append)
    assert found is not None
    assert found[0] == 1
    assert bits(found[1]) == bits(state(seed=1))
    assert len(said) == 1
    assert f"{tmp_path / '2'} is damaged" in said[0]
    assert "\n" not in said[0]
    assert capfd.readouterr() == ("", "")

    checkpoints.save(2, state(seed=3))  # the run goes on and comes by the same step
    again = checkpoints.restore(like=state(seed=0), say=silent)
    assert again is not None
    assert bits(again[1]) == bits(state(seed=3))


def test_nothing_but_damaged_checkpoints_is_an_error(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, state(seed=1))
    truncate(tmp_path / "1")
    with pytest.raises(UserError, match="no usable checkpoint"):
        checkpoints.restore(like=state(seed=0), say=lambda line: None)


def test_another_configuration_is_told_apart_from_damage(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, state(seed=1, hidden=8))
    with pytest.raises(
        UserError, match=r"another configuration: \['parameters'\]\['bias'\] is float32\[8\] there"
    ):
        checkpoints.restore(like=state(seed=1, hidden=16), say=silent)


def test_a_save_that_died_half_way_leaves_no_checkpoint(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(1, state(seed=1))
    (tmp_path / "2.unfinished" / "state").mkdir(parents=True)
    assert checkpoints.steps() == [1]
    checkpoints.save(3, state(seed=3))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1", "3"]


def test_what_is_newer_than_the_one_resumed_from_goes(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path)
    for step in (1, 2, 3):
        checkpoints.save(step, state(seed=step))
    checkpoints.discard_after(1)
    assert checkpoints.steps() == [1]


FULL_DISK = """
import resource, signal, sys
import numpy as np
from pathlib import Path
from simreal.checkpoints import Checkpoints
from simreal.errors import UserError
checkpoints = Checkpoints(Path(sys.argv[1]))
checkpoints.save(1, {"weights": np.arange(4)})
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))
try:
    checkpoints.save(2, {"weights": np.random.default_rng(0).random(1_000_000)})
except UserError as error:
    print(error)
print(checkpoints.steps(), checkpoints.restore({"weights": np.zeros(4, int)}, print)[0])
"""


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_the_last_checkpoint_stays(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    message, state_after = done.stdout.strip().splitlines()
    assert message == f"cannot save a checkpoint in {tmp_path}: File too large; the one at step 1 is intact"
    assert state_after == "[1] 1"
    assert done.stderr == ""
