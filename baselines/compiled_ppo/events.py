"""Files for TensorBoard, written without torch."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any


class Events:
    """Writer of scalars over steps for TensorBoard, which must be installed, into a folder."""

    def __init__(self, folder: Path) -> None:
        from tensorboard.compat.proto import event_pb2, summary_pb2
        from tensorboard.summary.writer.event_file_writer import EventFileWriter

        self._event, self._summary = event_pb2.Event, summary_pb2.Summary
        self._writer: Any = EventFileWriter(str(folder))

    def add(self, step: int, scalars: Mapping[str, float]) -> None:
        """Write scalars at a step, by tag."""
        values = [
            self._summary.Value(tag=tag, simple_value=value) for tag, value in scalars.items()
        ]
        summary = self._summary(value=values)
        self._writer.add_event(self._event(wall_time=time.time(), step=step, summary=summary))
        self._writer.flush()

    def close(self) -> None:
        """Close the file."""
        self._writer.close()
