"""The C sources of an exported filter: numbers of its records and suite, in the templates.

Records must have one lane, see `filter_process`.
"""

import math
from typing import Any

import numpy as np

import quad_gym
from baselines.exporting.filter_library import HEADER, TARGETS
from baselines.exporting.source import filled
from quad_gym.estimation.engine import Engine
from quad_gym.estimation.filters import LONGEST_STEP
from quad_gym.estimation.first_fix import FARTHEST_FIX, MIN_COURSE
from quad_gym.estimation.starts import LEVEL_SIGMA, state_at_rest
from quad_gym.kernels.entries import FILTER_STAGES
from quad_gym.kernels.library import core_symbol
from quad_gym.kernels.stages import Stage, needed_stages
from quad_gym.packing.aids import slow_states
from quad_gym.params.sensors import SensorSuite
from quad_gym.records import (
    AID_BLOCKS,
    AID_FREEDOMS,
    BASELINE_BLOCK,
    FEATURE_BLOCKS,
    FLIGHT_BLOCK,
    KEPT,
    MAX_STATES,
    MEASUREMENT,
    NOISE_FIELDS,
    OPERATION,
    PARAMS_BLOCK,
    PARTS,
    POSITION_BLOCK,
    SAMPLE,
    START,
    STEP_BLOCK,
    VELOCITY_BLOCK,
    WORK_BLOCK,
    Aid,
    Operation,
    offset_of,
    room_of,
)
from quad_gym.records.inputs import EVENT, INPUT, PENDING, WINDOW, Kept

_ENTRIES = tuple(
    f"quad_gym.kernels.exported:{name}" for name in ("take", "predict", "update", "start", "keep")
)
_LEVEL = "quad_gym.kernels.exported:start_level"
_RECORDS = {
    **{"sample": SAMPLE, "measurement": MEASUREMENT, "start": START, "operation": OPERATION},
    **{"input": INPUT, "event": EVENT, "pending": PENDING, "window": WINDOW},
}
"""Records in the memory of an exported filter, by their names there."""
_AID_NOTES = {
    Aid.BAROMETER: "height in I from static pressure [m]",
    Aid.MAGNETOMETER: "magnetic field in B [T]",
    Aid.OPTICAL_FLOW: "optical flow [rad/s], see quad_gym.OpticalFlowParams",
    Aid.RANGE_FINDER: "range to the ground [m]",
}
_WINDOW = 0.5  #: longest delay of measurements beyond the suite's `log_delays` [s], as in a replay


class Sources:
    """Contents of the files of an exported filter of a suite, for one of TARGETS.

    `policy` are the values of a policy for the templates (`policy_values`), or none. The memory for
    late measurements suffices for the suite's IMU rate, or `imu_rate` [Hz] if that is higher.
    """

    def __init__(
        self,
        suite: SensorSuite,
        label: str,
        target: str,
        policy: dict[str, Any],
        imu_rate: float = 0.0,
    ) -> None:
        self.suite, self.label, self.target, self.policy = suite, label, target, policy
        self.imu_rate = imu_rate
        self.engine = Engine(suite, suite.estimator.kind)
        needed = needed_stages(self.engine.settings[0])
        self.stages = {stage: needed[stage] for stage in FILTER_STAGES if stage in needed}
        self.slow = slow_states(suite)
        self.first = self._first()
        used = {"core", "filter", "watch"}
        if self.engine.slow_states:
            used.add("slow")
        if suite.aids:
            used.add("aids")
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
        """Return header, example, CMake file and README by name, for a library's size [bytes]."""
        values = {**self._suite_values(), **self._record_values(), **self._sensor_values()}
        values |= {"POLICY": False, **self.policy, "FLASH": f"{flash:,}"}
        values["IMPLEMENTATION"] = filled("implementation.c", values)
        files = {HEADER: "quad_gym_filter.h"} | {
            name: name for name in ("main.c", "CMakeLists.txt", "README.md")
        }
        return {name: filled(source, values).encode() for name, source in files.items()}

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
            "OF_LEVEL": offset_of(STEP_BLOCK, "level"),
            "OF_VELOCITY_VARIANCE": offset_of(PARAMS_BLOCK, "initial_velocity_variance"),
        }
        fields = {"POSITION": "r_hat", "VELOCITY": "v_hat", "STATUS": "filter_status"}
        fields |= {"ACCEL_BIAS": "b_a_hat", "GYRO_BIAS": "b_g_hat"}
        for name in ("R_hat", "L", "L_slow", "w_before", "gnss_position", "gnss_baseline"):
            fields[name.upper()] = name
        values |= {f"OF_{key}": offset_of(FLIGHT_BLOCK, name) for key, name in fields.items()}
        values["STRUCTS"] = "\n".join(
            _struct(f"qg_{name}_record", kind) for name, kind in _RECORDS.items()
        )
        values["STAGE_DECLARATIONS"] = "\n".join(
            f"QGI_STAGE({core_symbol(name)});" for name in self.stages.values()
        )
        values["FILL_TABLE"] = "\n".join(
            f"    f->table[{int(s)}] = (uint64_t)(uintptr_t){core_symbol(name)};"
            for s, name in self.stages.items()
        )
        values |= {f"A_{kind.name}": int(kind) for kind in Kept}
        values |= {operation.name: int(operation) for operation in Operation}
        noise = [f"    r.{name} = NAN;" for name in NOISE_FIELDS[1:]]
        noise += [f"    r.position_sigma_I[{i}] = NAN;" for i in range(3)]
        noise += [f"    r.aid_sigma[{int(aid)}] = NAN;" for aid in Aid]
        values["BLANK"] = "\n".join(noise)
        return values

    def _suite_values(self) -> dict[str, Any]:
        suite, engine = self.suite, self.engine
        sensors = [s for s in (suite.gnss, suite.camera, *suite.aids.values()) if s is not None]
        window = _WINDOW + max(0.0, *vars(suite.log_delays).values())
        rate = sum(sensor.rate for sensor in sensors)
        events = math.ceil(1.25 * window * (max(suite.imu.rate, self.imu_rate) + rate)) + 24
        measurements = math.ceil(1.25 * window * rate) + 16
        copies = events // 8 + 2
        words = sum(
            (
                self.room.dtype.itemsize + PARAMS_BLOCK.itemsize + WORK_BLOCK.itemsize,
                STEP_BLOCK.itemsize + 8 * len(Stage) + START.itemsize + WINDOW.itemsize + 24,
                (events + copies + 72) * OPERATION.itemsize + 16 * PENDING.itemsize,
                events * EVENT.itemsize + (events + 36) * SAMPLE.itemsize,
                (measurements + 16) * MEASUREMENT.itemsize,
                copies * 8 * sum(length for _, length in self.copied),
            )
        )
        rest = state_at_rest(suite, (0.0, 0.0, 0.0), 0.0, 0.0)["covariance"]
        return {
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
        }

    def _sensor_values(self) -> dict[str, Any]:
        suite, gnss = self.suite, self.suite.gnss
        texts = dict.fromkeys(
            ("AID_MACROS", "AID_FIELDS", "AID_TAKE", "AID_API", "AID_SOURCE", "AID_ROWS"), ""
        )
        for aid in suite.aids:
            name, count, note = aid.name.lower(), AID_FREEDOMS[aid], _AID_NOTES[aid]
            value = f"double {name}" if count == 1 else f"const double {name}[{count}]"
            call = f"int qg_update_{name}(qg_filter *f, {value}, double time)"
            given = {
                **{"NAME": name, "COUNT": count, "BLOCK": AID_BLOCKS + aid, "INDEX": int(aid)},
                **{"CALL": call, "ADDRESS": f"&{name}" if count == 1 else name},
            }
            texts["AID_MACROS"] += f"#define QG_{aid.name} 1\n"
            texts["AID_FIELDS"] += f"    const double *{name}; /* {count}: {note} */\n"
            texts["AID_FIELDS"] += f"    double {name}_sigma;\n"
            texts["AID_API"] += f"{call}; /* {note} */\n"
            texts["AID_ROWS"] += (
                f'    if (!strcmp(name, "{name}"))\n        m.{name} = x + 1;\n    else\n'
            )
            texts["AID_TAKE"] += filled("aid_take.c", given)
            texts["AID_SOURCE"] += filled("aid_update.c", given)
        has = {
            "CAMERA": suite.camera is not None,
            "GNSS": gnss is not None,
            "BASELINE": gnss is not None and gnss.has_baseline,
            "VELOCITY": gnss is not None and gnss.velocity_sigma is not None,
        }
        names = {aid.name.lower(): [aid.name.lower()] for aid in suite.aids}
        if has["CAMERA"]:
            names["camera"] = ["pixels"]
        parts = {"gnss_position": "GNSS", "gnss_baseline": "BASELINE", "gnss_velocity": "VELOCITY"}
        names["gnss"] = [name for name, part in parts.items() if has[part]]
        ranks = (
            f"{' || '.join(f'm->{name}' for name in names[stream])} ? {rank} : "
            for rank, stream in enumerate(sorted(names), 1)
            if names[stream]
        )
        values: dict[str, Any] = {
            **texts,
            **has,
            "RANK": f"{''.join(ranks)}{len(names) + 1}",
            "FEATURES": 0 if suite.camera is None else len(suite.camera.features_I),
            "BAROMETER": Aid.BAROMETER in suite.aids,
            "MAGNETOMETER": Aid.MAGNETOMETER in suite.aids,
            **{"FEATURE_BLOCKS": FEATURE_BLOCKS, "POSITION_BLOCK": POSITION_BLOCK},
            **{"BASELINE_BLOCK": BASELINE_BLOCK, "VELOCITY_BLOCK": VELOCITY_BLOCK},
        }
        return values if gnss is None else {**values, **self._start_values()}

    def _start_values(self) -> dict[str, Any]:
        suite, compass = self.suite, self.suite.magnetometer
        assert suite.gnss is not None
        values: dict[str, Any] = {
            "VELOCITY_SIGMA": repr(float(suite.gnss.velocity_sigma or 0.0)),
            "MIN_COURSE": repr(MIN_COURSE),
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
