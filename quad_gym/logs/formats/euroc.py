"""Logs in the format of the EuRoC data set: folders with `mav0/imu0/data.csv`.

| file | contents used |
|---|---|
| `imu0/data.csv` | gyro and accelerometer |
| `leica0`, `vicon0`, `mocap0` or others with positions | positions in I, as of GNSS; attitudes |

A rotation `T_BS` of `sensor.yaml` is applied. EuRoC's body has x up and z forward; if the mean
specific force points along x, the axes become x forward, y left, z up: (z, -y, x). Estimated ground
truth (`state_groundtruth_estimate0`) is not read.

Source: M. Burri et al., The EuRoC micro aerial vehicle datasets, Int. J. Robotics Research 35(10),
2016.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from quad_gym.logs.formats.log import Floats, LogSource, RawLog
from quad_gym.rotations import dcm_to_quaternion, quaternion_to_dcm

_FROM_X_UP = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
_POSITION = re.compile(r"\bp_\w*x\b|\bp_\w*_x|\bpos\w*x\b|\bx\s*\[m\]")
"""Heading of the column with the first coordinate of a position."""
_QUATERNION = re.compile(r"\bq\w*_w\b|\bq\w*w\b")


def is_euroc(path: Path) -> bool:
    """Return True for a folder in this format."""
    return _root(path).joinpath("imu0", "data.csv").is_file()


def read_euroc(path: Path | str) -> RawLog:
    """Read a folder, `mav0` or the one that contains it.

    Raises:
        ValueError: If a file is not a table of numbers.
        OSError: If there are no IMU samples.
    """
    root = _root(Path(path))
    time, samples = _table(root / "imu0" / "data.csv", 7)
    R_BS = _rotation(root / "imu0")
    gyro, accel = samples[:, :3] @ R_BS.T, samples[:, 3:6] @ R_BS.T
    mean = np.nanmean(accel, axis=0) if len(accel) else np.zeros(3)
    turn = _FROM_X_UP if mean[0] == np.abs(mean).max() and mean.any() else np.eye(3)
    values = {"gyro": gyro @ turn.T, "accel": accel @ turn.T}
    imu = LogSource(sensor="imu", topic="imu0", time=time, values=values)
    return RawLog(file=Path(path).name, sources=[imu, *_places(root, turn)])


def _places(root: Path, turn: Floats) -> Iterator[LogSource]:
    """Yield positions and attitudes of motion capture."""
    for file in sorted(root.glob("*/data.csv")):
        name = file.parent.name
        with file.open(encoding="utf-8", errors="replace") as lines:
            heading = lines.readline().lower()
        known = name.rstrip("0123456789") in ("leica", "vicon", "mocap")
        if "estimate" in name or not (known or _POSITION.search(heading)):
            continue
        time, numbers = _table(file, 8 if _QUATERNION.search(heading) else 4)
        values = {"gnss_position_I": numbers[:, :3]}
        yield LogSource(sensor="gnss", topic=name, time=time, values=values)
        if numbers.shape[1] >= 7:
            known_rows = np.linalg.norm(numbers[:, 3:7], axis=1) > 0.5
            R_SI = quaternion_to_dcm(numbers[known_rows, 3:7])
            q = dcm_to_quaternion(turn @ _rotation(file.parent) @ R_SI)
            stamps = time[known_rows]
            yield LogSource(sensor="attitude", topic=name, time=stamps, values={"quaternion": q})


def _root(path: Path) -> Path:
    return path / "mav0" if (path / "mav0").is_dir() else path


def _table(file: Path, count: int) -> tuple[Floats, Floats]:
    """Return times [s] and the other numbers of the first columns."""
    try:
        rows = np.loadtxt(file, delimiter=",", comments="#", ndmin=2, usecols=range(count))
    except (ValueError, IndexError, UnicodeDecodeError) as error:
        raise ValueError(f"{file} must be a table of numbers: {error}") from None
    return 1e-9 * rows[:, 0], rows[:, 1:]


def _rotation(folder: Path) -> Floats:
    """Return the rotation from a sensor to the body."""
    file = folder / "sensor.yaml"
    text = file.read_text(encoding="utf-8") if file.is_file() else ""
    found = re.search(r"T_BS:.*?data:\s*\[([^\]]*)\]", text, re.DOTALL)
    if found is None:
        return np.eye(3)
    try:
        numbers = np.array([float(word) for word in found.group(1).replace(",", " ").split()])
    except ValueError as error:
        raise ValueError(f"{file} must have numbers in T_BS: {error}") from None
    if len(numbers) != 16:
        raise ValueError(f"{file} must have 16 numbers in T_BS, got {len(numbers)}")
    return numbers.reshape(4, 4)[:3, :3]
