"""The engines that find an orientation, by name."""

from __future__ import annotations

from enum import StrEnum

from speckle3d.core.errors import InvalidInputError


class Method(StrEnum):
    """Engine of an orientation; `smoother` and `vqf` use the readings after each sample as well."""

    smoother = "smoother"
    filter = "filter"
    vqf = "vqf"
    vqf_online = "vqf-online"

    @property
    def offline(self) -> bool:
        """Whether readings after a sample tell of its orientation."""
        return self in (Method.smoother, Method.vqf)

    @property
    def is_vqf(self) -> bool:
        """Whether VQF finds the orientation, not this package's filter."""
        return self in (Method.vqf, Method.vqf_online)


DEFAULT_METHOD = Method.smoother
"""The engine of those who name none."""


def method_of(name: Method | str) -> Method:
    """Return the method by name; raise `InvalidInputError` if there is none of that name."""
    try:
        return Method(name)
    except ValueError:
        raise InvalidInputError(f"method: expected {', '.join(Method)}, got {name!r}") from None
