"""Logs in the format of the EuRoC data set: folders with `mav0/imu0/data.csv`.

| file | contents used |
|---|---|
| `imu0/data.csv` | gyro and accelerometer |
| `leica0/data.csv`, else `vicon0/data.csv` | position in the room, as a GNSS position in I |

A rotation `T_BS` of `imu0/sensor.yaml` is applied. EuRoC's body has x up and z forward; if the mean
specific force points along x, the axes become x forward, y left, z up: (z, -y, x). The estimated
ground truth (`state_groundtruth_estimate0`) is not read.

Source: M. Burri et al., The EuRoC micro aerial vehicle datasets, Int. J. Robotics Research 35(10),
2016.
"""

import re
from pathlib import Path

import numpy as np

from quad_gym.estimation.logs.log import Floats, Log, Stream

_FROM_X_UP = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])


def is_euroc(path: Path) -> bool:
    """Return True for a folder in this format."""
    return _root(path).joinpath("imu0", "data.csv").is_file()


def read_euroc(path: Path | str) -> Log:
    """Read a folder, `mav0` or the one that contains it.

    Raises:
        ValueError: If a file is not a table of numbers.
        OSError: If there are no IMU samples.
    """
    root = _root(Path(path))
    time, samples = _table(root / "imu0" / "data.csv", 6)
    gyro, accel = samples[:, :3] @ (R_BS := _rotation(root)).T, samples[:, 3:] @ R_BS.T
    mean = accel.mean(axis=0)
    if mean[0] == np.abs(mean).max():
        gyro, accel = gyro @ _FROM_X_UP.T, accel @ _FROM_X_UP.T
    gnss = None
    for name in ("leica0", "vicon0"):
        if gnss is None and (root / name / "data.csv").is_file():
            stamps, places = _table(root / name / "data.csv", 3)
            gnss = Stream(stamps, stamps, {"position_I": places})
    return Log(
        imu=Stream(time, time, {"gyro": gyro, "accel": accel}),
        gnss=gnss,
        about={"file": Path(path).name},
    )


def _root(path: Path) -> Path:
    return path / "mav0" if (path / "mav0").is_dir() else path


def _table(file: Path, count: int) -> tuple[Floats, Floats]:
    """Return times [s] and the first numbers of each row."""
    try:
        rows = np.loadtxt(file, delimiter=",", comments="#", ndmin=2, usecols=range(1 + count))
    except (ValueError, UnicodeDecodeError) as error:
        raise ValueError(f"{file} must be a table of numbers: {error}") from None
    return 1e-9 * rows[:, 0], rows[:, 1:]


def _rotation(root: Path) -> Floats:
    """Return the rotation from the IMU to the body."""
    file = root / "imu0" / "sensor.yaml"
    text = file.read_text(encoding="utf-8") if file.is_file() else ""
    found = re.search(r"T_BS:.*?data:\s*\[([^\]]*)\]", text, re.DOTALL)
    if found is None:
        return np.eye(3)
    numbers = np.array([float(word) for word in found.group(1).replace(",", " ").split()])
    if len(numbers) != 16:
        raise ValueError(f"{file} must have 16 numbers in T_BS, got {len(numbers)}")
    return numbers.reshape(4, 4)[:3, :3]
