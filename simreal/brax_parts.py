"""What simreal takes from Brax, imported in one place: Brax imports MJX, which would print about Warp."""

from __future__ import annotations

from simreal.quiet import import_mjx

import_mjx()

# ruff: noqa: E402
from brax.training import networks, types
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import losses, optimizer
from brax.training.agents.ppo import networks as ppo_networks

__all__ = ["losses", "networks", "optimizer", "ppo_networks", "running_statistics", "specs", "types"]
