"""Arguments of a batch of flights that have no effect with the others, and are refused."""

from collections.abc import Collection
from typing import Any

from quad_gym.records import Control

_UNUSED = {
    "gains": tuple(control for control in Control if control is not Control.PD),
    "action_params": (Control.PD, Control.MOTOR, Control.WRENCH),
}
"""Arguments of controllers, and the meanings of an action with which they have no effect."""


def require_effect(control: Control, given: Collection[str]) -> None:
    """Refuse arguments of other controllers.

    Args:
        control: The meaning of an action.
        given: Names of the arguments that were given.

    Raises:
        ValueError: If one has no effect.
    """
    for name in sorted(given):
        if control in _UNUSED[name]:
            raise ValueError(f"{name} must not be given with Control.{control.name}: it uses none")


def require_no_filter(**arguments: Any) -> None:
    """Refuse arguments that need a filter, where none runs.

    Args:
        arguments: Such arguments; False and "cold" ask for nothing.

    Raises:
        ValueError: If one asks for something.
    """
    for name, value in arguments.items():
        if value not in (False, "cold"):
            raise ValueError(f"{name} needs a filter, and none runs here, got {value!r}")
