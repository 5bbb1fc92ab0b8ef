"""Keywords of environments that have no effect with the others, and are refused."""

from collections.abc import Collection, Mapping
from typing import Any

from quad_gym.envs.keywords import FILTER_KEYWORDS
from quad_gym.faults.presets import felt_without_sensors
from quad_gym.params.suites import sensor_suite

ONE_TASK_KEYWORDS = {
    "max_speed": "random_trajectory",
    "max_acceleration": "random_trajectory",
    "gate_count": "waypoints",
    "gate_radius": "waypoints",
    "trajectory": "trajectory",
}
"""Keywords that have an effect with a single task, and that task."""

KEYWORDS_WITHOUT_EFFECT = {
    "hover": ("period",),
    "waypoints": ("period", "preview"),
    "trajectory": ("radius", "period", "height"),
}
"""Keywords that have an effect with most tasks, by the tasks with which they have none."""


def require_own_task(given: Collection[str], name: str, kind: str, *, own_reward: bool) -> None:
    """Refuse fields of `TaskParams` that belong to other tasks, or have no effect."""
    if own_reward and "reward_params" in given:
        raise ValueError(
            f"reward_params has no effect on the task {name}, and must not be given: its class has "
            "weights of its own"
        )
    for keyword in given:
        if ONE_TASK_KEYWORDS.get(keyword, kind) != kind:
            raise ValueError(
                f"{keyword} belongs to the task {ONE_TASK_KEYWORDS[keyword]}, and must not be "
                f"given for {name}"
            )
        if keyword in KEYWORDS_WITHOUT_EFFECT.get(kind, ()):
            raise ValueError(f"{keyword} has no effect on the task {name}, and must not be given")


def require_effect(asked: Collection[str], keywords: Mapping[str, Any]) -> None:
    """Refuse keywords that were asked for and have no effect with the others."""
    observation = keywords["observation"]
    if "layout" in asked and observation == "measurements":
        raise ValueError(
            'layout must not be given with observation="measurements", which has its own layout, '
            f"got {keywords['layout']!r}"
        )
    for name in FILTER_KEYWORDS:
        if name in asked and keywords[name] is not None and runs_no_sensor(keywords):
            raise ValueError(
                f'{name} must not be given with observation="{observation}", where no filter runs '
                f"unless include_std or innovations ask for it, got {keywords[name]!r}"
            )


def runs_no_sensor(keywords: Mapping[str, Any]) -> bool:
    """Return True if an environment with these keywords simulates no sensor."""
    asked = any(keywords.get(name) is True for name in ("include_std", "innovations"))
    return keywords.get("observation") in ("truth", "noisy") and not asked


def with_effect(keywords: Mapping[str, Any]) -> dict[str, Any]:
    """Remove keywords of a filter that does not run, and faults of sensors that are not used.

    Comparisons use the same keywords for several observations, but environments reject keywords
    that have no effect.
    """
    idle = FILTER_KEYWORDS if runs_no_sensor(keywords) else ()
    kept = {name: value for name, value in keywords.items() if name not in idle}
    if keywords.get("observation") in ("truth", "noisy") and {"faults", "sensors"} <= set(kept):
        kept["faults"] = felt_without_sensors(kept["faults"], sensor_suite(kept["sensors"]))
    return kept
