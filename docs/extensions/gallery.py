"""Order and figure style of the tutorials."""

from pathlib import Path
from typing import Any

LESSONS = (
    "circle.py",
    "outage.py",
    "pretrained.py",
    "training.py",
    "sensor_suite.py",
    "faults.py",
    "wind.py",
    "own_trajectory.py",
    "moving_target.py",
    "landing.py",
    "slalom.py",
    "look_at_markers.py",
    "filter_alone.py",
    "replay.py",
    "foreign_policy.py",
    "deploy.py",
)
"""Tutorials in reading order; others follow by name."""


class LessonOrder:
    """Sort key of tutorials."""

    def __init__(self, folder: str) -> None:
        self.folder = folder

    def __repr__(self) -> str:
        return f"<{type(self).__name__}>"

    def __call__(self, file: str) -> tuple[int, str]:
        """The place of a file."""
        name = Path(file).name
        return (LESSONS.index(name) if name in LESSONS else len(LESSONS)), name


def reset(settings: dict[str, Any], file: str) -> None:
    """Reset the style of figures before each tutorial."""
    import matplotlib.pyplot as plt

    plt.rcParams.update(
        {
            "figure.figsize": (7.0, 4.0),
            "figure.constrained_layout.use": True,
            "savefig.dpi": 110,
            "axes.grid": True,
            "grid.alpha": 0.3,
            "axes.spines.top": False,
            "axes.spines.right": False,
        }
    )
