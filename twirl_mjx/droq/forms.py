"""The forms of the update: one mathematics, arranged for different machines."""

from __future__ import annotations

from types import ModuleType

import jax

from twirl_mjx.droq import accelerator, fast, kernels, plain
from twirl_mjx.droq.config import FORM_NAMES, DroqConfig

_MODULES = (plain, fast, accelerator, kernels)
FORMS: dict[str, ModuleType] = dict(zip(FORM_NAMES, _MODULES, strict=True))
"""Name -> module with ``critic_q`` and ``critic_block``."""


def name_of(config: DroqConfig) -> str:
    """Return the name of the form that a config means on the machine that jax uses."""
    if not config.fast:
        return "plain"
    if config.form != "auto":
        return config.form
    return "fast" if jax.default_backend() == "cpu" else "accelerator"


def form_of(config: DroqConfig) -> ModuleType:
    """Return the module of the form that a config means on the machine that jax uses."""
    return FORMS[name_of(config)]
