"""Compile for an NVIDIA GPU that is not there, and count the operations it would launch.

XLA's GPU compiler needs a description of the card, not the card: ``jax[cuda13]`` on a machine
without a driver compiles whole programs, which can then be counted but not run. Kernels are not
tuned by timing them, so their number is right and their tiles are not.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax

from twirl_mjx import files
from twirl_mjx.bench import thunks
from twirl_mjx.bench.options import CARDS
from twirl_mjx.checks import check_choice

PLUGINS = ("jax_plugins.xla_cuda13", "jax_plugins.xla_cuda12")
"""What holds XLA's GPU compiler; either will do."""

HOPPER: Mapping[str, int | float] = {
    "threads_per_block_limit": 1024,
    "threads_per_warp": 32,
    "threads_per_core_limit": 2048,
    "shared_memory_per_block": 48 << 10,
    "shared_memory_per_core": 228 << 10,
    "shared_memory_per_block_optin": 227 << 10,
    "registers_per_core_limit": 65536,
    "registers_per_block_limit": 65536,
    "core_count": 132,
    "fpus_per_core": 128,
    "block_dim_limit_x": 2**31 - 1,
    "block_dim_limit_y": 65535,
    "block_dim_limit_z": 65535,
    "thread_dim_limit_x": 1024,
    "thread_dim_limit_y": 1024,
    "thread_dim_limit_z": 64,
    "l2_cache_size": 50 << 20,
    "clock_rate_ghz": 1.98,
    "device_address_bits": 64,
}
"""Limits of compute capability 9.0 (CUDA C++ Programming Guide, technical specifications) and of
the SXM5 boards (NVIDIA H100 data sheet): what the compiler's cost model asks for."""


@dataclasses.dataclass(frozen=True)
class Compiled:
    """What the compiler says of a program for a card that is not there."""

    loops: thunks.Block
    """Operations of the program and of every loop in it."""
    compile_s: float
    temporary_mb: float
    """Memory beside arguments and results."""
    aliased_mb: float
    """Arguments that are overwritten in place."""
    argument_mb: float


def compiler_missing() -> str | None:
    """Return why nothing can be compiled for a GPU here, or None."""
    for plugin in PLUGINS:
        try:
            if importlib.util.find_spec(plugin) is not None:
                return None
        except ModuleNotFoundError:  # jax_plugins itself
            pass
    return (
        "this environment has no GPU compiler: make gpu-setup, then"
        " JAX_PLATFORMS=cpu .venv-gpu/bin/twirl bench gpu-compile"
    )


def description(card: str) -> str:
    """Return the text, a protocol buffer of XLA's, that describes a card to its compiler.

    Raises:
        ValueError: Unknown card.
    """
    check_choice("card", card, tuple(CARDS))
    values = {**HOPPER, **CARDS[card]}
    fields = "".join(
        f'  {name}: "{value}"\n' if isinstance(value, str) else f"  {name}: {value}\n"
        for name, value in values.items()
    )
    return (
        f"gpu_device_info {{\n{fields}"
        "  cuda_compute_capability { major: 9 feature_extension: ACCELERATED_FEATURES }\n"
        '  device_vendor: "NVIDIA Corporation"\n}\n'
        'platform_name: "CUDA"\n'
        "dnn_version_info { major: 9 minor: 10 }\n"
        f'device_description_str: "{values["name"]}"\n'
    )


def compile_for(
    card: str,
    function: Callable[..., Any],
    args: tuple[Any, ...],
    donate: tuple[int, ...] = (),
    options: Mapping[str, Any] | None = None,
) -> Compiled:
    """Compile a function for a card and count its operations.

    Args:
        card: Name in ``CARDS``.
        function: Pure function of ``args``.
        args: Trees of arrays or of ``jax.ShapeDtypeStruct``; only their shapes matter.
        donate: Arguments that may be overwritten.
        options: Flags of XLA by name, without dashes.

    Raises:
        ValueError: Unknown card.
        RuntimeError: There is no GPU compiler, or it left no list of operations.
    """
    import time

    from jax.experimental import topologies

    if (reason := compiler_missing()) is not None:
        raise RuntimeError(reason)
    topology = topologies.get_topology_desc(
        platform="cuda", target_config=description(card), topology="1x1x1"
    )
    place = jax.sharding.SingleDeviceSharding(topology.devices[0])
    shapes = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place), tuple(args)
    )
    device = jax.sharding.AbstractDevice(topology.devices[0].device_kind, None, "cuda")
    automatic = (jax.sharding.AxisType.Auto,)
    mesh = jax.sharding.AbstractMesh((1,), ("x",), automatic, abstract_device=device)
    with jax.sharding.use_abstract_mesh(mesh):  # Pallas asks it for what it compiles
        lowered = jax.jit(function, donate_argnums=donate).lower(*shapes)
    with tempfile.TemporaryDirectory() as folder:
        dump = {"xla_dump_to": folder, "xla_dump_hlo_as_text": True}
        began = time.perf_counter()
        compiled = lowered.compile(compiler_options={**dump, **(options or {})})
        seconds = time.perf_counter() - began
        found = sorted(Path(folder).glob("*thunk_sequence_after_thunk_passes.txt"))
        if not found:
            raise RuntimeError("XLA's GPU compiler left no list of operations (--xla_dump_to)")
        loops = thunks.parse(files.read_text(found[-1], "a list of GPU operations"))
    memory: Any = compiled.memory_analysis()
    return Compiled(
        loops,
        seconds,
        memory.temp_size_in_bytes / 1e6,
        memory.alias_size_in_bytes / 1e6,
        memory.argument_size_in_bytes / 1e6,
    )
