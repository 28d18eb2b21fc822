"""What `mj_setConst` does in MuJoCo C, in JAX: the fields that follow from those that vary between worlds."""

from simreal.constants.derive import C_ONLY, derived_constants

__all__ = ["C_ONLY", "derived_constants"]
