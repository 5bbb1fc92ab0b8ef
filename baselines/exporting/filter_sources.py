"""The C sources of an exported filter: numbers of its records and suite, in the templates.

Records must have one lane, see `filter_library`.
"""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

import quad_gym
from baselines.exporting.filter_inputs import LAST_RANK, inputs_of
from baselines.exporting.filter_library import HEADER, TARGETS
from quad_gym.estimation import first_motion
from quad_gym.estimation.engine import Engine
from quad_gym.estimation.filters import LONGEST_STEP
from quad_gym.estimation.first_fix import FARTHEST_FIX, LEAST_COURSE
from quad_gym.estimation.starts import LEVEL_SIGMA, state_at_rest
from quad_gym.kernels.entries import FILTER_STAGES
from quad_gym.kernels.library import core_symbol
from quad_gym.kernels.stages import Stage, needed_stages
from quad_gym.packing.aids import slow_states
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import (
    FLIGHT_BLOCK,
    KEPT,
    MAX_STATES,
    MEASUREMENT,
    NOISE_FIELDS,
    PARAMS_BLOCK,
    PARTS,
    SAMPLE,
    START,
    STEP_BLOCK,
    WORK_BLOCK,
    Aid,
    offset_of,
    room_of,
)

_TEMPLATES = Path(__file__).parent / "templates"
_ENTRIES = tuple(f"quad_gym.kernels.exported:{n}" for n in ("predict", "update", "start", "keep"))
_LEVEL = "quad_gym.kernels.exported:start_level"
_WINDOW = 0.5
"""Longest delay of measurements beyond the suite's `log_delays` [s], as in a replay."""


class Sources:
    """Contents of the files of an exported filter.

    Args:
        suite: Sensor suite with its filter.
        label: Name of the suite.
        target: One of TARGETS.
        policy: `PolicySources` of a policy.
    """

    def __init__(
        self, suite: SensorSuite, label: str, target: str, policy: tuple[str, ...]
    ) -> None:
        self.suite, self.label, self.target, self.policy = suite, label, target, policy
        self.engine = Engine(suite, suite.estimator.kind)
        needed = needed_stages(self.engine.settings[0])
        self.stages = {stage: needed[stage] for stage in FILTER_STAGES if stage in needed}
        self.slow = slow_states(suite)
        self.first = self._first()
        used = {"core", "filter", "watch"}
        used |= ({"slow"} if self.engine.slow_states else set()) | (
            {"aids"} if suite.aids else set()
        )
        self.room = room_of(frozenset(used))
        self.copied = self._copied(used)

    @property
    def functions(self) -> tuple[str, ...]:
        """Names of the compiled functions in the library."""
        level = (_LEVEL,) if self.suite.gnss is not None else ()
        return (*self.stages.values(), *_ENTRIES, *level)

    @property
    def constants(self) -> dict[str, bytes]:
        """Records that do not change, by their symbols in the library."""
        engine = self.engine
        return {
            "qg_core_params": engine.params.tobytes(),
            "qg_core_steps": engine.steps.tobytes(),
            "qg_core_settings": engine.settings.tobytes(),
            "qg_core_first": self.first.tobytes(),
        }

    def texts(self, flash: int) -> dict[str, bytes]:
        """Return header, example, CMake file and README, by name.

        Args:
            flash: Size of the library [bytes].
        """
        values = {**self._suite_values(), **self._record_values(), **self._sensor_values()}
        names = ("POLICY_API", "POLICY_NETWORK", "POLICY_ACTION")
        values |= dict(zip(names, self.policy, strict=True))
        values["IMPLEMENTATION"] = _filled("implementation.c", values)
        values["FLASH"] = f"{flash:,}"
        files = {HEADER: "quad_gym_filter.h"} | {
            name: name for name in ("main.c", "CMakeLists.txt", "README.md")
        }
        return {name: _filled(source, values).encode() for name, source in files.items()}

    # ---- numbers ------------------------------------------------------------------------------

    def _first(self) -> Any:
        """Return a START record with the numbers of the suite."""
        suite, slow = self.suite, self.slow.first_sigmas
        record = np.zeros(1, START)
        record["T"] = np.eye(3)
        record["tilt_sigma"] = suite.estimator.initial_tilt_sigma or LEVEL_SIGMA
        record["heading_sigma"] = suite.initial_pose.heading_sigma
        record["velocity_sigma"] = math.sqrt(suite.estimator.initial_velocity_variance)
        record["accel_bias_sigma"] = suite.imu.accel_bias_sigma
        record["gyro_bias_sigma"] = suite.imu.gyro_bias_sigma
        record["slow_sigma"][0, : len(slow)], record["slow_states"] = slow, len(slow)
        if suite.gnss is not None:
            record["lever_B"] = suite.gnss.primary_antenna_B
        return record

    def _copied(self, used: set[str]) -> list[tuple[int, int]]:
        """Return places and lengths of the used parts in memory, in doubles."""
        found: list[tuple[int, int]] = []
        for name, fields in PARTS:
            if name not in used:
                continue
            place = (offset_of(FLIGHT_BLOCK, fields[0].name) - self.room.skipped) // 8
            length = sum(math.prod(field.shape) for field in fields)
            if found and sum(found[-1]) == place:
                found[-1] = (found[-1][0], found[-1][1] + length)
            else:
                found.append((place, length))
        return found

    def _record_values(self) -> dict[str, Any]:
        values: dict[str, Any] = {
            "FLIGHT_WORDS": self.room.dtype.itemsize // 8,
            "PARAMS_WORDS": PARAMS_BLOCK.itemsize // 8,
            "WORK_WORDS": WORK_BLOCK.itemsize // 8,
            "STEPS_WORDS": STEP_BLOCK.itemsize // 8,
            "COPY_WORDS": sum(length for _, length in self.copied),
            "COPIED": ", ".join(f"{{{place}, {length}}}" for place, length in self.copied),
            "SKIPPED": self.room.skipped,
            "STAGES": len(Stage),
            "KEPT": KEPT,
            "L_SLOW_PITCH": MAX_STATES,
            "OF_MASK": offset_of(WORK_BLOCK, "mask"),
            "OF_POSITION_SIGMA": offset_of(PARAMS_BLOCK, "position_sigma_I"),
            "OF_TILT_SIGMA": offset_of(PARAMS_BLOCK, "initial_tilt_sigma"),
            "OF_VELOCITY_VARIANCE": offset_of(PARAMS_BLOCK, "initial_velocity_variance"),
        }
        fields = {
            "POSITION": "r_hat",
            "VELOCITY": "v_hat",
            "R_HAT": "R_hat",
            "ACCEL_BIAS": "b_a_hat",
            "GYRO_BIAS": "b_g_hat",
            "STATUS": "filter_status",
        }
        for name in ("L", "L_slow", "w_before", "gnss_position", "gnss_baseline"):
            fields[name.upper()] = name
        values |= {f"OF_{key}": offset_of(FLIGHT_BLOCK, name) for key, name in fields.items()}
        values["STRUCTS"] = "\n".join(
            _struct(f"qg_{name}_record", kind)
            for name, kind in (("sample", SAMPLE), ("measurement", MEASUREMENT), ("start", START))
        )
        values["STAGE_DECLARATIONS"] = "\n".join(
            f"QGI_STAGE({core_symbol(name)});" for name in self.stages.values()
        )
        values["FILL_TABLE"] = "\n".join(
            f"    f->table[{int(s)}] = (uint64_t)(uintptr_t){core_symbol(name)};"
            for s, name in self.stages.items()
        )
        noise = [f"    r.{name} = NAN;" for name in NOISE_FIELDS[1:]]
        noise += [f"    r.position_sigma_I[{i}] = NAN;" for i in range(3)]
        noise += [f"    r.aid_sigma[{int(aid)}] = NAN;" for aid in Aid]
        values["BLANK"] = "\n".join(noise)
        return values

    def _suite_values(self) -> dict[str, Any]:
        suite, engine = self.suite, self.engine
        sensors = [s for s in (suite.gnss, suite.camera, *suite.aids.values()) if s is not None]
        delays = vars(suite.log_delays)
        window = _WINDOW + max(0.0, *delays.values())
        rate = sum(sensor.rate for sensor in sensors)
        events = math.ceil(1.25 * window * (suite.imu.rate + rate)) + 24
        measurements = math.ceil(1.25 * window * rate) + 16
        copies = events // 8 + 2
        words = sum(
            (
                self.room.dtype.itemsize + PARAMS_BLOCK.itemsize + WORK_BLOCK.itemsize,
                STEP_BLOCK.itemsize + 8 * len(Stage) + START.itemsize + 64,
                events * (24 + SAMPLE.itemsize) + 16 * (MEASUREMENT.itemsize + 16),
                measurements * (MEASUREMENT.itemsize + 1),
                copies * (1 + 8 * sum(length for _, length in self.copied)),
            )
        )
        rest = state_at_rest(suite, (0.0, 0.0, 0.0), 0.0, 0.0)["covariance"]
        return {
            **self._motion_values(),
            "TITLE": f"State estimator: {suite.estimator.kind.upper()} of the sensor suite "
            f'"{self.label}", quad_gym {quad_gym.__version__}.',
            "SUITE": self.label,
            "ESTIMATOR": suite.estimator.kind,
            "TARGET": TARGETS[self.target].words,
            "BUILD": TARGETS[self.target].build,
            "TICK": repr(suite.imu.dt),
            "AVERAGES": int(suite.imu.samples == "average"),
            "LONGEST": repr(max(LONGEST_STEP, suite.imu.dt)),
            "WINDOW": repr(window),
            "EVENTS": events,
            "MEASUREMENTS": measurements,
            "RAM": f"{words:,}",
            "REST_SIGMA": _numbers(np.sqrt(np.diag(rest))),
            "REFERENCE": _numbers(suite.gnss.reference_antenna_G if suite.gnss else (0, 0, 0)),
            "R_IG": _numbers(engine.params["R_IG"].ravel()),
            **{f"DELAY_{name.upper()}": repr(float(delay)) for name, delay in delays.items()},
        }

    def _sensor_values(self) -> dict[str, Any]:
        suite = self.suite
        found = inputs_of(suite)
        ranks = [f"{given.measured} ? {given.rank}" for given in found if given.rank < LAST_RANK]
        functions = [function for given in found for function in given.functions]
        values = {
            "SENSOR_MACROS": "".join(f"{line}\n" for given in found for line in given.macros),
            "MEASUREMENT_FIELDS": "".join(
                f"    {line}\n" for given in found for line in given.fields
            ),
            "UPDATE_API": "".join(function.declaration for function in functions),
            "UPDATE_SOURCE": "\n".join(function.definition for function in functions),
            "TAKE": "".join(given.take for given in found)
            + f"    rank = {' : '.join([*ranks, str(LAST_RANK)])};",
            "START_API": "",
            "START_SOURCE": "",
        }
        if suite.gnss is not None:
            values["START_API"] = (_TEMPLATES / "start.h").read_text(encoding="utf-8")
            values["START_SOURCE"] = _filled("start.c", self._start_values())
        return values

    def _motion_values(self) -> dict[str, str]:
        """Return the numbers with which the example recognizes a start in motion."""
        gnss, form = self.suite.gnss, self.suite.estimator
        tilt = form.initial_tilt_sigma
        return {
            "MOTION_SPAN": repr(first_motion.SPAN),
            "MOTION_TURNING": repr(first_motion.TURNING),
            "MOTION_FAST": repr(first_motion.FAST),
            "MOTION_CERTAIN": repr(first_motion.CERTAIN),
            "MOTION_TILT": repr(0.0 if tilt is None else max(tilt, first_motion.TILT)),
            "MOST_POSITION_SIGMA": repr(float(max(gnss.position_sigma_I))) if gnss else "0.0",
            "SUITE_SPEED_SIGMA": repr(math.sqrt(form.initial_velocity_variance)),
        }

    def _start_values(self) -> dict[str, Any]:
        suite, compass = self.suite, self.suite.magnetometer
        assert suite.gnss is not None
        values = {
            **self._record_values(),
            **self._suite_values(),
            "VELOCITY_SIGMA": repr(float(suite.gnss.velocity_sigma or 0.0)),
            "LEAST_COURSE": repr(LEAST_COURSE),
            "FARTHEST": repr(FARTHEST_FIX),
            "HAS_BASELINE": int(suite.gnss.has_baseline),
            "ROOT_SCALE": repr(math.sqrt(suite.estimator.initial_covariance_scale)),
        }
        zeros = ("FIELD_I", "STRENGTH", "FIELD_SIGMA", "IRON", "DECLINATION")
        values |= dict.fromkeys(zeros, "0")
        if compass is not None:
            values |= {
                "FIELD_I": _numbers(compass.field_I),
                "STRENGTH": repr(float(compass.strength)),
                "FIELD_SIGMA": repr(float(compass.noise_sigma)),
                "IRON": self.slow.vectors[Aid.MAGNETOMETER],
                "DECLINATION": self.slow.scalars[Aid.MAGNETOMETER],
            }
        return values


def _numbers(values: Any) -> str:
    """Format numbers so that C reads the same bits."""
    return ", ".join(repr(float(value)) for value in values)


def _struct(name: str, dtype: np.dtype) -> str:
    """Return the C type of a record whose fields are all eight bytes long."""
    assert dtype.fields is not None
    lines = []
    for field, (kind, *_) in dtype.fields.items():
        base, shape = kind.subdtype or (kind, ())
        word = "double" if base.kind == "f" else "int64_t"
        lines.append(f"    {word} {field}{''.join(f'[{n}]' for n in shape)};")
    return "\n".join(["typedef struct {", *lines, f"}} {name};", ""])


def _filled(name: str, values: dict[str, Any]) -> str:
    """Return a template with the values of its @NAMES@."""
    text = (_TEMPLATES / name).read_text(encoding="utf-8")
    return re.sub(r"@([A-Z_]+)@", lambda found: str(values[found[1]]), text)
