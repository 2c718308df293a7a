"""Every kernel that can be asked for by name, with its parameter and the default of that."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from factors.m_estimators import CauchyKernel, DcsKernel, GemanMcClureKernel, HuberKernel
from factors.similarity import ExpKernel, GaussianKernel, Kernel, LogKernel, SqrtKernel


@dataclass(frozen=True, slots=True)
class KernelChoice:
    """A kernel with at most one parameter."""

    make: Callable[..., Kernel]
    """Takes the parameter by its name, or nothing."""
    parameter: str = ""
    """``dof``, ``width`` (sigmas) or ``phi`` (squared sigmas); empty where there is none."""

    @property
    def default(self) -> float | None:
        """The parameter where none is given."""
        return float(getattr(self.make(), self.parameter)) if self.parameter else None

    def kernel(self, value: float | None = None) -> Kernel:
        """Return the kernel; a parameter that it does not have is a ValueError."""
        if value is None:
            return self.make()
        if not self.parameter:
            raise ValueError(f"expected no parameter, got {value:g}")
        return self.make(**{self.parameter: value})


KERNELS: Final[Mapping[str, KernelChoice]] = {
    "log": KernelChoice(LogKernel, "dof"),
    "sqrt": KernelChoice(SqrtKernel, "dof"),
    "exp": KernelChoice(ExpKernel, "width"),
    "gaussian": KernelChoice(GaussianKernel),
    "huber": KernelChoice(HuberKernel, "width"),
    "cauchy": KernelChoice(CauchyKernel, "width"),
    "dcs": KernelChoice(DcsKernel, "phi"),
    "geman-mcclure": KernelChoice(GemanMcClureKernel, "width"),
}
"""Names as on the command line."""


def parse_kernel(text: str) -> Kernel:
    """Return the kernel named, for example, ``log``, ``log:7`` or ``huber:1.5``.

    Raises
    ------
    ValueError
        The name is not known, or the number behind the colon cannot be used.
    """
    name, colon, number = text.partition(":")
    if name not in KERNELS:
        raise ValueError(f"there is no kernel {name!r}; known: {', '.join(KERNELS)}")
    choice = KERNELS[name]
    try:
        return choice.kernel(float(number) if colon else None)
    except ValueError as error:
        wanted = f"{choice.parameter} after the colon" if choice.parameter else "the name alone"
        raise ValueError(f"kernel {text!r}: expected {wanted} ({error}); try log:5") from error
