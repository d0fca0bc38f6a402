"""The task queue, with ECS's events: names running tasks, cleans up after ended ones."""

from hippodrome.functions.task_changed import handler

__all__ = ["handler"]
