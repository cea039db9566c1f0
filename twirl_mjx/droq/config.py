"""Settings of the learner."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Literal

from twirl_mjx.checks import check_choice, check_range

FORM_NAMES = ("plain", "fast", "accelerator", "kernels")
"""Names of the forms of the update, see ``droq.forms``."""


@dataclasses.dataclass(frozen=True)
class DroqConfig:
    """The learner (paper Table 4; Hiraoka et al. 2021)."""

    hidden_sizes: tuple[int, ...] = (256, 256)
    """Units of the hidden layers of actor and critics."""
    num_critics: int = 2
    """Independent critics in the ensemble."""
    dropout_rate: float = 0.01
    """Share of hidden units dropped, in online and target critics alike."""
    batch_size: int = 256
    """Rows of one minibatch."""
    discount: float = 0.99
    """Discount per control step."""
    learning_rate: float = 3e-4
    """Adam step size of actor, critics and temperature."""
    tau: float = 0.005
    """Polyak rate of the target critic, after every critic step."""
    utd: float = 20.0
    """Critic updates per environment transition; may be below 1."""
    updates_per_block: int = 20
    """Critic updates between two updates of actor and temperature (20 = the paper's at UTD 20)."""
    target_entropy: float | None = None
    """nats; -A/2 when not given."""
    initial_temperature: float = 1.0
    """Entropy temperature at the start."""
    matmul_dtype: Literal["float32", "bfloat16"] = "float32"
    """Precision of matrix products; parameters and sums stay float32."""
    fast: bool = True
    """Use the fast form of the update; False is the plain flax/optax form of the same maths."""
    form: Literal["auto", "fast", "accelerator", "kernels"] = "auto"
    """Which fast form: fast is laid out for CPUs, accelerator for GPUs and TPUs, kernels are for
    NVIDIA GPUs (sizes in powers of two); auto is the fastest for what is used."""

    def __post_init__(self) -> None:
        """Check every number.

        Raises:
            ValueError: A value is out of range; the message has the numbers.
        """
        check_range("droq.num_critics", self.num_critics, 1, 100)
        check_range("droq.dropout_rate", self.dropout_rate, 0.0, 0.9)
        check_range("droq.batch_size", self.batch_size, 1, 1_000_000)
        check_range("droq.discount", self.discount, 0.0, 1.0)
        check_range("droq.learning_rate", self.learning_rate, 1e-8, 1.0)
        check_range("droq.tau", self.tau, 0.0, 1.0)
        check_range("droq.utd", self.utd, 1e-6, 1000.0)
        check_range("droq.updates_per_block", self.updates_per_block, 1, 100_000)
        check_range("droq.initial_temperature", self.initial_temperature, 1e-6, 100.0)
        if self.target_entropy is not None:
            check_range("droq.target_entropy", self.target_entropy, -1e4, 1e4)
        check_choice("droq.matmul_dtype", self.matmul_dtype, ("float32", "bfloat16"))
        check_choice("droq.form", self.form, ("auto", *FORM_NAMES[1:]))
        if not self.hidden_sizes or min(self.hidden_sizes) < 1:
            nearest = tuple(max(1, size) for size in self.hidden_sizes or (128, 128))
            raise ValueError(
                f"droq.hidden_sizes = {self.hidden_sizes} needs sizes >= 1 (nearest: {nearest})"
            )
        if self.form == "kernels" and (reason := self.kernels_refuse()):
            raise ValueError(f"droq.form kernels needs {reason}")

    def kernels_refuse(self) -> str | None:
        """Return which size hand-written kernels cannot cut into blocks, or None."""
        for size in self.hidden_sizes:
            if not 16 <= size <= 512 or size & (size - 1):
                nearest = min(max(16, 1 << round(math.log2(size))), 512)
                return (
                    f"hidden sizes that are powers of two from 16 to 512, not {size}"
                    f" (nearest: {nearest})"
                )
        if self.batch_size % 16:
            nearest = max(16, round(self.batch_size / 16) * 16)
            return (
                f"a batch size that is a multiple of 16, not {self.batch_size} (nearest: {nearest})"
            )
        return None


def settings_of(form: str) -> dict[str, Any]:
    """Return the settings of ``DroqConfig`` that mean a form wherever jax runs."""
    return {"fast": False} if form == "plain" else {"fast": True, "form": form}
