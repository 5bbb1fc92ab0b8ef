"""Interface of user-defined tasks: `Task`, its `View` of the flights, and terms of rewards."""

from quad_gym.tasks import rewards
from quad_gym.tasks.task import ObservationSpec, Task, TaskError, resolve_task

__all__ = ["ObservationSpec", "Task", "TaskError", "resolve_task", "rewards"]
