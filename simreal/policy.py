"""A trained policy as a robot would run it: weights and names, NumPy only."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from simreal.errors import UserError

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


class Policy:
    """Maps observations to actions. Callable as `action, memory = policy(obs, memory, key)`.

    Takes NumPy arrays, or JAX arrays inside a jitted function, with any leading axes; returns the mean
    action, so `key` is not used. `memory` is `()`: this policy has none.
    """

    def __init__(self, interface: PolicyInterface, weights: Mapping[str, np.ndarray]) -> None:
        self.interface = interface
        self.weights = {name: np.asarray(value) for name, value in weights.items()}
        self.layers = sum(name.startswith("kernel_") for name in self.weights)

    def initial_state(self) -> tuple:
        """The memory at the start of an episode."""
        return ()

    def __call__(self, obs: Any, memory: Any = (), key: Any = None) -> tuple[Any, Any]:
        xp: Any = np
        if not isinstance(obs, np.ndarray) and hasattr(obs, "aval"):
            import jax.numpy as xp
        hidden = obs
        if self.interface.observation_clip is not None:
            bound = self.interface.observation_clip
            hidden = xp.clip((obs - self.weights["mean"]) / self.weights["std"], -bound, bound)
        activate = ACTIVATIONS[self.interface.activation]
        for layer in range(self.layers):
            hidden = hidden @ self.weights[f"kernel_{layer}"] + self.weights[f"bias_{layer}"]
            if layer < self.layers - 1:
                hidden = activate(xp, hidden)
        return xp.clip(hidden, -1, 1), memory

    @classmethod
    def from_training(cls, env: Any, config: Any, policy_params: Any, normalizer: Any) -> Policy:
        """Takes the policy out of a training state."""
        from simreal.quantities import control_units  # needs MuJoCo, which a robot may not have

        tree = policy_params["params"]
        hidden = tree.get("MLP_0", {})
        layers = [hidden[f"hidden_{i}"] for i in range(len(hidden))] + [tree["Dense_0"]]
        weights = {f"kernel_{i}": np.asarray(layer["kernel"]) for i, layer in enumerate(layers)}
        weights |= {f"bias_{i}": np.asarray(layer["bias"]) for i, layer in enumerate(layers)}
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
