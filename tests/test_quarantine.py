"""Worlds that blow up: their episodes end, they count for nothing, and they can be run again."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from simreal import cli, registry
from simreal.config_files import load_config
from simreal.distributions import Choice, Uniform
from simreal.envs.cartpole_swingup import CartpoleSwingup
from simreal.errors import UserError
from simreal.quarantine import Recording
from simreal.randomizers import cartpole, physics
from simreal.replaying import environment_of, replay
from simreal.runs import Run
from simreal.training import train

SHARE = 0.3
OPTIONS = {
    "worlds": 32,
    "steps": 32 * 20 * 30,
    "rollout.greedy_worlds": 8,
    "learner.unroll_length": 20,
    "learner.iterations_per_epoch": 15,
    "learner.epochs": 1,
    "network.policy_layers": [16],
    "network.value_layers": [16],
}


class FragileCartpole(CartpoleSwingup):
    """A cart-pole of which some get a spring, in mid-episode, that no time step can follow."""

    name = "fragile_cartpole"
    training = cartpole.TRAIN.replace(
        spring=physics.stiffness("hinge").set(Choice([0, 1e9], [1 - SHARE, SHARE])).at(Uniform(0.2, 3.0))
    )


@pytest.fixture(scope="module")
def fragile_run(tmp_path_factory):
    registry.register("fragile_cartpole", f"{__name__}:FragileCartpole")
    out = tmp_path_factory.mktemp("fragile") / "run"
    train(load_config("cartpole_swingup", OPTIONS | {"environment": "fragile_cartpole"}), out)
    yield Run(out)
    del registry.ENVIRONMENTS["fragile_cartpole"]


def test_blown_worlds_are_counted_and_written_down(fragile_run):
    rows, files = fragile_run.metrics(), sorted(fragile_run.quarantine.iterdir())
    assert sum(row["quarantined"] for row in rows) == len(files) >= 4
    for row in rows:
        assert all(np.isfinite(v) for v in row.values() if v is not None)
        assert row["skipped_updates"] == 0
    for file in files:
        recording = Recording.load(file)
        stretch = np.diff(recording.age)
        assert (stretch == 1).all(), "steps of one episode, without a gap"
        began = recording.begin[".physics.time"]
        assert len(recording.actions) >= 50 or began == 0, "the last second, or the whole episode"
        assert np.isfinite(recording.qpos).all()
        assert recording.begin[".world.draws['spring']"] == 1e9
        assert recording.begin[".world.draws['spring_time']"] <= 0.02 * recording.age[-1]


def test_a_recording_replays_on_either_engine(fragile_run):
    file = max(fragile_run.quarantine.iterdir())
    recording = Recording.load(file)
    last = len(recording.actions) - 1
    again = replay(environment_of(recording, file), recording)
    assert again.blew_up == last
    np.testing.assert_allclose(again.qpos[1 : last + 1], recording.qpos[:last], atol=1e-3)
    assert replay(environment_of(recording, file, "mjx"), recording).blew_up == last


def test_replay_tells_and_films(fragile_run, capsys, tmp_path):
    file = min(fragile_run.quarantine.iterdir())
    assert cli.main(["replay", str(file), "--out", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    assert "blew up again" in told
    assert "spring 1e+09" in told
    assert "no pictures" in told or list(tmp_path.glob("*.webp"))


def test_what_is_no_recording_is_refused_in_one_line(fragile_run, capsys, tmp_path):
    file = min(fragile_run.quarantine.iterdir())
    cut = tmp_path / "cut.npz"
    cut.write_bytes(file.read_bytes()[:500])
    for wrong, reason in ((tmp_path / "none.npz", "no such file"), (cut, "damaged")):
        assert cli.main(["replay", str(wrong)]) == 2
        assert reason in capsys.readouterr().err


def test_a_recording_of_other_ranges_is_refused(fragile_run):
    file = min(fragile_run.quarantine.iterdir())
    recording = Recording.load(file)
    recording.meta["randomizer"] = "another"
    with pytest.raises(UserError, match="training ranges"):
        environment_of(recording, file)


def test_a_world_too_fast_or_with_too_much_energy_is_not_believed():
    env = CartpoleSwingup(engine="mujoco")
    state = env.reset(jax.random.PRNGKey(0))
    for speed, fine in ((10.0, True), (60.0, False), (2e3, False)):
        physics_state = state.physics.replace(qvel=state.physics.qvel.at[0].set(speed))
        assert bool(env._is_fine(physics_state)) == fine
