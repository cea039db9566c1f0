"""The forms of the update: one mathematics, arranged for different machines."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import jax

from twirl_mjx.droq import accelerator, fast, kernels, plain
from twirl_mjx.droq.config import DroqConfig

FORMS: dict[str, ModuleType] = {
    "plain": plain,
    "fast": fast,
    "accelerator": accelerator,
    "kernels": kernels,
}
"""Name -> module with ``critic_q`` and ``critic_block``."""


def name_of(config: DroqConfig) -> str:
    """Return the name of the form that a config means on the machine that jax uses."""
    if not config.fast:
        return "plain"
    if config.form != "auto":
        return config.form
    return "fast" if jax.default_backend() == "cpu" else "accelerator"


def settings_of(form: str) -> dict[str, Any]:
    """Return the settings of ``DroqConfig`` that mean a form wherever jax runs."""
    return {"fast": False} if form == "plain" else {"fast": True, "form": form}


def form_of(config: DroqConfig) -> ModuleType:
    """Return the module of the form that a config means on the machine that jax uses."""
    return FORMS[name_of(config)]
