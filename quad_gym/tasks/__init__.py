"""What a user writes to change a task: `Task`, its `View` of the flights, pieces of rewards."""

from quad_gym.tasks import rewards
from quad_gym.tasks.task import ObservationSpec, Task, TaskError, resolve_task

__all__ = ["ObservationSpec", "Task", "TaskError", "resolve_task", "rewards"]
