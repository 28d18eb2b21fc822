"""A trained policy as a robot would run it: weights and names, NumPy only."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simreal.errors import UserError
from simreal.memory import Memory, Recollection, gru

ACTIVATIONS: dict[str, Callable[[Any, Any], Any]] = {
    "elu": lambda xp, x: xp.where(x > 0, x, xp.expm1(xp.minimum(x, 0))),
    "relu": lambda xp, x: xp.maximum(x, 0),
    "swish": lambda xp, x: x / (1 + xp.exp(-x)),
    "tanh": lambda xp, x: xp.tanh(x),
}


@dataclass(frozen=True)
class PolicyInterface:
    """What whoever deploys the policy must know."""

    environment: str
    control_dt: float
    """s between two actions."""
    observations: Sequence[Sequence[str]]
    """(name, unit) of each number, in order."""
    actions: Sequence[str]
    """Actuator of each number, in order."""
    action_units: Sequence[str]
    """Unit of each actuator's control."""
    control_limits: Sequence[Sequence[float]]
    """(lowest, highest) control of each actuator."""
    control_offset: Sequence[float]
    """Actuator control of action 0."""
    control_scale: Sequence[float]
    """Actuator control = offset + scale * action, action in [-1, 1]."""
    activation: str
    observation_clip: float | None
    """Bound of a normalised observation; None: observations are not normalised."""
    history: int = 1
    """Observations that the network sees at a time, the newest first."""
    hidden: int = 0
    """Units of the recurrent layer before the others; 0: there is none."""


class Policy:
    """Maps observations to actions. Callable as `action, memory = policy(obs, memory, key)`.

    Takes NumPy arrays, or JAX arrays inside a jitted function, with any leading axes, the same for `obs` and
    `memory`; returns the mean action, so `key` is not used. An episode begins with `initial_state()`, which
    is `()` for a policy without memory.
    """

    def __init__(self, interface: PolicyInterface, weights: Mapping[str, np.ndarray]) -> None:
        self.interface = interface
        self.weights = {name: np.asarray(value) for name, value in weights.items()}
        self.layers = sum(name.startswith("kernel_") for name in self.weights)
        self.recollection = Recollection(len(interface.observations), interface.history, interface.hidden)

    def initial_state(self) -> Memory:
        """The memory at the start of an episode."""
        return self.recollection.empty(np)

    def __call__(self, obs: Any, memory: Memory = (), key: Any = None) -> tuple[Any, Memory]:
        xp: Any = np
        if not isinstance(obs, np.ndarray) and hasattr(obs, "aval"):
            import jax.numpy as xp
        if not memory and self.recollection.empty(np):
            raise ValueError("this policy remembers: begin an episode with policy.initial_state()")
        shown, memory = self.recollection.see(xp, memory, obs)
        if self.interface.observation_clip is not None:
            bound = self.interface.observation_clip
            shown = xp.clip((shown - self.weights["mean"]) / self.weights["std"], -bound, bound)
        if self.interface.hidden:
            memory = memory | {"hidden": gru(xp, self.weights, memory["hidden"], shown)}
            shown = xp.concatenate([memory["hidden"], shown], axis=-1)
        activate = ACTIVATIONS[self.interface.activation]
        for layer in range(self.layers):
            shown = shown @ self.weights[f"kernel_{layer}"] + self.weights[f"bias_{layer}"]
            if layer < self.layers - 1:
                shown = activate(xp, shown)
        return xp.clip(shown, -1, 1), memory

    @classmethod
    def from_training(cls, env: Any, config: Any, policy_params: Any, normalizer: Any) -> Policy:
        """Takes the policy out of a training state."""
        from simreal.quantities import control_units  # needs MuJoCo, which a robot may not have

        head = policy_params["head"] if config.network.recurrent else policy_params
        tree = head["params"]
        hidden = tree.get("MLP_0", {})
        layers = [hidden[f"hidden_{i}"] for i in range(len(hidden))] + [tree["Dense_0"]]
        weights = {f"kernel_{i}": np.asarray(layer["kernel"]) for i, layer in enumerate(layers)}
        weights |= {f"bias_{i}": np.asarray(layer["bias"]) for i, layer in enumerate(layers)}
        if config.network.recurrent:
            cell = policy_params["gru"].items()
            weights |= {
                f"gru_{name}_{kind}": np.asarray(w) for name, leaf in cell for kind, w in leaf.items()
            }
        weights["mean"] = np.asarray(normalizer.mean["state"])
        weights["std"] = np.asarray(normalizer.std["state"])
        zero = np.zeros(env.action_size, np.float32)
        offset = np.asarray(env.control(zero))
        learner = config.learner
        interface = PolicyInterface(
            environment=env.name,
            control_dt=env.control_dt,
            observations=[list(o) for o in env.observations],
            actions=list(env.actuators.names),
            action_units=control_units(env.mj_model),
            control_limits=[[float(low), float(high)] for low, high in env.mj_model.actuator_ctrlrange],
            control_offset=offset.tolist(),
            control_scale=(np.asarray(env.control(zero + 1)) - offset).tolist(),
            activation=config.network.activation,
            observation_clip=learner.observation_clip if learner.normalize_observations else None,
            history=config.network.history,
            hidden=config.network.recurrent,
        )
        return cls(interface, weights)

    def save(self, folder: Path) -> None:
        """Writes `policy.json` and `weights.npz` (no pickle) into `folder`."""
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(folder / "weights.npz", **self.weights)  # type: ignore[arg-type]
        (folder / "policy.json").write_text(json.dumps(asdict(self.interface), indent=2) + "\n")

    @classmethod
    def load(cls, folder: Path) -> Policy:
        """Reads what `save` wrote.

        Raises:
            UserError: files missing or damaged.
        """
        try:
            interface = PolicyInterface(**json.loads((folder / "policy.json").read_text()))
            with np.load(folder / "weights.npz", allow_pickle=False) as weights:
                return cls(interface, dict(weights))
        except FileNotFoundError as error:
            raise UserError(f"{folder}: no policy there ({error.filename} is missing)") from None
        except Exception as error:
            raise UserError(f"{folder}: the policy is damaged ({error})") from None


def load_policy(run: str | Path) -> Policy:
    """The policy of a run folder, or of a `policy/` folder copied out of one.

    Raises:
        UserError: there is none, or it is damaged.
    """
    path = Path(run)
    return Policy.load(path / "policy" if (path / "policy").is_dir() else path)
