"""The forms of the update: one mathematics, arranged for different machines."""

from __future__ import annotations

import re
from types import ModuleType

import jax

from twirl_mjx.droq import accelerator, fast, kernels, plain
from twirl_mjx.droq.config import FORM_NAMES, DroqConfig

_MODULES = (plain, fast, accelerator, kernels)
FORMS: dict[str, ModuleType] = dict(zip(FORM_NAMES, _MODULES, strict=True))
"""Name -> module with ``critic_q`` and ``critic_block``."""


KERNELS_BATCH, KERNELS_UNITS = 512, 256
"""Most rows and units for which kernels are chosen: they are for many small updates, and were timed
at 256 rows (docs/accelerators.md); the tiles of wider layers do not fit every card."""


def name_of(config: DroqConfig) -> str:
    """Return the name of the form that a config means on the machine that jax uses."""
    if not config.fast:
        return "plain"
    if config.form != "auto":
        return config.form
    if jax.default_backend() == "cpu":
        return "fast"
    small = config.batch_size <= KERNELS_BATCH and max(config.hidden_sizes) <= KERNELS_UNITS
    return "kernels" if small and not config.kernels_refuse() and _one_nvidia() else "accelerator"


def _one_nvidia() -> bool:
    """Return whether jax has one NVIDIA GPU, Ampere or newer: no kernel is split over devices."""
    devices = jax.devices()
    capability = str(getattr(devices[0], "compute_capability", ""))  # "9.0"; AMD: "gfx90a"
    return len(devices) == 1 and bool(re.fullmatch(r"([89]|\d\d+)\.\d+", capability))


def form_of(config: DroqConfig) -> ModuleType:
    """Return the module of the form that a config means on the machine that jax uses."""
    return FORMS[name_of(config)]
