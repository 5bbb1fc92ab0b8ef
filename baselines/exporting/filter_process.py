"""The process that writes an exported filter: the C sources, with one flight in a block."""

import concurrent.futures
import itertools
import math
import multiprocessing
import os
import pickle
import sys
from typing import Any

import numpy as np

import quad_gym
from baselines.exporting.controller import filled
from baselines.exporting.filter_library import HEADER, LIBRARY, TARGETS, archive
from quad_gym.estimation.engine import Engine
from quad_gym.estimation.filters import LONGEST_STEP
from quad_gym.estimation.starts import empty_fix, level_start
from quad_gym.kernels.compiling.building import (
    Processor,
    emitted,
    is_cached,
    loaded_size,
    object_of,
)
from quad_gym.kernels.entries import FILTER_STAGES
from quad_gym.kernels.library import core_symbol, say
from quad_gym.kernels.stages import Stage, needed_stages
from quad_gym.logs.formats.log import mounting_of
from quad_gym.logs.replaying.results import COLUMNS
from quad_gym.params.sensor_table import READINGS, SENSOR_PARAMS
from quad_gym.params.suites import ALL_SUITES, SensorSuite
from quad_gym.records import (
    BLOCKS_OF,
    FIRST_OF_FLIGHTS,
    FLIGHT_BLOCK,
    KEPT,
    MEASUREMENT,
    OPERATION,
    PARAMS_BLOCK,
    PARTS,
    PRECISION,
    REAL_BYTES,
    SAMPLE,
    SINGLE,
    START,
    STEP_BLOCK,
    WORK_BLOCK,
    offset_of,
    room_of,
)
from quad_gym.records.inputs import EVENT, FIX, INPUT, MEMORY, PENDING, WINDOW, Kept, Outcome

# --------------------------------------------------------------------------------------------------
# The C sources of an exported filter: numbers of its records and suite, in the templates.
#
# Records must have one lane, see `filter_process`.
# --------------------------------------------------------------------------------------------------

_ENTRIES = tuple(
    f"quad_gym.kernels.exported:{name}"
    for name in ("take", "prepare", "start", "state", "covariance", "seen")
)
_RECORDS = {
    "sample": SAMPLE,
    "measurement": MEASUREMENT,
    "start": START,
    "fix": FIX,
    "input": INPUT,
    "operation": OPERATION,
    "event": EVENT,
    "pending": PENDING,
    "window": WINDOW,
    "memory": MEMORY,
}
"""Records in the memory of an exported filter, by their names there."""
_OUTCOMES = {
    Outcome.OK: "done",
    Outcome.NOT_STARTED: "call an init function first",
    Outcome.NOT_FINITE: "an argument is infinite or not a number",
    Outcome.OUT_OF_RANGE: "an argument is out of the range that its comment states",
    Outcome.TOO_OLD: "older than the memory of the filter, which export --log or QG_EVENTS extends",
    Outcome.TOO_NEW: "the time stamp is more than QG_LONGEST_STEP later than the filter",
    Outcome.FULL: "too many measurements wait for later samples, more than QG_WAITING",
    Outcome.NO_HEADING: "a start needs one of: baseline, heading, magnetometer, course",
    Outcome.CONTRADICTION: "arguments that exclude each other, or that the suite lacks",
}


_WINDOW = 0.5  #: longest delay of measurements beyond the suite's `log_delays` [s], as in a replay
_SHORT_WINDOW = 0.1
"""Longest delay beyond the suite's latencies in single precision, for processors with little memory
[s]."""
_CORE = ("tick", "filter_status", "diverged")
"""Fields that the filter uses of the core, of which it has all in memory."""


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
        used = {"core", "filter", "watch"}
        if self.engine.slow_states:
            used.add("slow")
        self.room = room_of(frozenset(used))
        self.copied = self._copied(used)

    @property
    def functions(self) -> tuple[str, ...]:
        """Names of the compiled functions in the library."""
        return (*self.stages.values(), *_ENTRIES)

    @property
    def constants(self) -> dict[str, bytes]:
        """Records that do not change, by their symbols in the library."""
        engine = self.engine
        return {
            "qg_core_params": engine.params.tobytes(),
            "qg_core_steps": engine.steps.tobytes(),
            "qg_core_settings": engine.settings.tobytes(),
            "qg_core_first": level_start(self.suite).tobytes(),
            "qg_core_fix": empty_fix(self.suite).tobytes(),
            "qg_core_mounting": mounting_of(self.suite).tobytes(),
            "qg_core_parts": np.array([len(self.copied), *itertools.chain(*self.copied)]).tobytes(),
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

    def _copied(self, used: set[str]) -> list[tuple[int, int]]:
        """Return places and lengths of the used parts in memory, in words of REAL_BYTES."""
        found: list[tuple[int, int]] = []
        names = [f.name for part, fields in PARTS if part in used - {"core"} for f in fields]
        for name in (*_CORE, *names):
            place = (offset_of(FLIGHT_BLOCK, name) - self.room.skipped) // REAL_BYTES
            length = FLIGHT_BLOCK[name].itemsize // REAL_BYTES
            if found and sum(found[-1]) == place:
                found[-1] = (found[-1][0], found[-1][1] + length)
            else:
                found.append((place, length))
        return found

    def _record_values(self) -> dict[str, Any]:
        values: dict[str, Any] = {
            **{f"{name}_WORDS": -(-size // 8) for name, size in self._sizes.items()},
            "REAL": "float" if SINGLE else "double",
            "PRECISION": PRECISION,
            "COPY_WORDS": sum(length for _, length in self.copied),
            "SKIPPED": self.room.skipped,
            "STAGES": len(Stage),
            "KEPT": KEPT,
            "OF_LEVEL": offset_of(STEP_BLOCK, "level"),
            "OF_STATUS": offset_of(FLIGHT_BLOCK, "filter_status"),
        }
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
        values["OUTCOMES"] = "".join(
            f"    QG_{outcome.name} = {int(outcome)}, /* {words} */\n"
            for outcome, words in _OUTCOMES.items()
        )
        values["WORDS"] = ", ".join(f'"{words}"' for words in _OUTCOMES.values())
        values["COLUMNS"] = ",".join((*COLUMNS, "diverged"))
        values |= {f"A_{kind.name}": int(kind) for kind in Kept}
        return values

    @property
    def _sizes(self) -> dict[str, int]:
        """Bytes of the filter's records in memory, by their names in the templates."""
        return {
            "FLIGHT": self.room.dtype.itemsize,
            "PARAMS": PARAMS_BLOCK.itemsize,
            "WORK": offset_of(WORK_BLOCK, FIRST_OF_FLIGHTS),
            "STEPS": STEP_BLOCK.itemsize,
        }

    def _suite_values(self) -> dict[str, Any]:
        suite = self.suite
        window, every, waiting = _WINDOW, 8, 16
        if SINGLE:
            latencies = (sensor.latency for sensor in suite.sensors.values())
            window, every, waiting = _SHORT_WINDOW + max(0.0, *latencies), 16, 4
        window += max(0.0, *vars(suite.log_delays).values())
        rate = sum(sensor.rate for sensor in suite.sensors.values())
        events = math.ceil(1.25 * window * (max(suite.imu.rate, self.imu_rate) + rate)) + 24
        measurements = math.ceil(1.25 * window * rate) + waiting
        copies = events // every + 2
        words = sum(
            (
                sum(self._sizes.values()) + 8 * len(Stage) + WINDOW.itemsize + 24,
                (events + copies + 4 * waiting + 8) * OPERATION.itemsize,
                waiting * PENDING.itemsize + events * EVENT.itemsize,
                (events + 2 * waiting + 4) * SAMPLE.itemsize,
                (measurements + waiting) * MEASUREMENT.itemsize,
                copies * REAL_BYTES * sum(length for _, length in self.copied),
            )
        )
        turns = bool(mounting_of(suite)["imu_turns"][0])
        return {
            "MOUNTING": "the library rotates them" if turns else "B does not differ",
            "TITLE": f"State estimator: {suite.estimator.kind.upper()} of the sensor suite "
            f'"{self.label}", quad_gym {quad_gym.__version__}.',
            "SUITE": self.label if self.label in ALL_SUITES else f"{self.label}.toml",
            "ESTIMATOR": suite.estimator.kind,
            "TARGET": TARGETS[self.target].words,
            "FMA": "fma" in TARGETS[self.target].processor,
            "BUILD": TARGETS[self.target].build,
            "TICK": repr(suite.imu.dt),
            "AVERAGES": int(suite.imu.samples == "average"),
            "LONGEST": repr(max(LONGEST_STEP, suite.imu.dt)),
            "WINDOW": repr(window),
            "COPY_EVERY": every,
            "WAITING": waiting,
            "EVENTS": events,
            "MEASUREMENTS": measurements,
            "RAM": f"{words:,}",
            "REFERENCE": _numbers(suite.gnss.reference_antenna_G if suite.gnss else (0, 0, 0)),
        }

    def _sensor_values(self) -> dict[str, Any]:
        suite = self.suite
        texts = dict.fromkeys(("MACROS", "FIELDS_OF_MEASUREMENTS", "TAKE", "API", "SOURCE"), "")
        names = {
            sensor: [r.name for r in params.readings(sensor) if suite.blocks_of(r.name)]
            for sensor, params in suite.sensors.items()
        }
        for name in itertools.chain(*names.values()):
            for place, text in self._texts_of(name).items():
                texts[place] += text
        ranks = (
            f"{' || '.join(f'm->{name}' for name in names[stream])} ? {rank} : "
            for rank, stream in enumerate(sorted(names), 1)
        )
        return {
            **texts,
            "RANK": f"{''.join(ranks)}{len(names) + 1}",
            "ROWS": "".join(
                f'    if (!strcmp(name, "{sensor}"))\n        {self._row_of(sensor)};\n    else\n'
                for sensor in names
            ),
            **{name.upper(): name in names for name in SENSOR_PARAMS},
        }

    def _texts_of(self, name: str) -> dict[str, str]:
        """Return the texts of a reading in the templates."""
        reading, count, first = READINGS[name], self.suite.blocks_of(name), BLOCKS_OF[name].start
        group, length = list(READINGS).index(name), reading.length
        numbers, several = count * length, reading.sigmas > 1
        frame = ", in G" if reading.in_G else ""
        note = f"{reading.meaning}{frame} [{reading.unit}]"
        note += "; NAN: not measured" if reading.most_blocks > 1 else ""
        kind, put = ("double", "qgi_place") if reading.from_center else ("qg_real", "qgi_value")
        value = f"const {kind} {name}[{numbers}]" if numbers > 1 else f"{kind} {name}"
        sigma = f"const qg_real *{reading.sigma}" if several else f"qg_real {reading.sigma}"
        of_sigma = f"{reading.sigmas} standard deviations" if several else "standard deviation"
        given = f", {sigma}" if reading.reported else ""
        call = f"int qg_update_{name}(qg_filter *f, {value}{given}, double time)"
        take = (
            f"    for (int i = 0; m->{name} && i < {count}; i++)\n"
            f"        r.valid[{first} + i] = {put}(r.measurement[{first} + i],\n"
            f"{38 * ' '}m->{name} + {length} * i, {length});\n"
        )
        take += (
            f"    qgi_value(r.sigma[{group}], m->{reading.sigma}, {reading.sigmas});\n"
            if several
            else f"    r.sigma[{group}][0] = m->{reading.sigma};\n"
        )
        values = {"CALL": call, "NAME": name, "ADDRESS": name if numbers > 1 else f"&{name}"}
        values["SIGMA"] = f"    m.{reading.sigma} = {reading.sigma};\n" if given else ""
        macros = f"#define QG_{name.upper()} 1\n"
        if reading.block:
            macros += f"#define QG_{reading.block.upper()}S {count}\n"
        return {
            "MACROS": macros,
            "FIELDS_OF_MEASUREMENTS": (
                f"    const {kind} *{name}; /* {numbers}: {note} */\n"
                f"    {sigma}; /* {of_sigma} [{reading.sigma_unit}] */\n"
            ),
            "TAKE": take,
            "API": f"{call}; /* {note} */\n",
            "SOURCE": filled("update.c", values),
        }

    def _row_of(self, sensor: str) -> str:
        """Return the C code that takes the numbers of a row of the example's input."""
        readings = self.suite.sensors[sensor].readings(sensor)
        if len(readings) == 1:
            return f"m.{readings[0].name} = real + 1"
        taken, place = [], 1
        for reading in readings:
            if self.suite.blocks_of(reading.name):
                numbers = "given" if reading.from_center else "value"
                taken.append(f"m.{reading.name} = {numbers}({place})")
                if reading.reported:
                    number = "value" if reading.sigmas > 1 else "number"
                    taken.append(f"m.{reading.sigma} = {number}({place + reading.length})")
            place += reading.length + reading.sigmas * reading.reported
        return ", ".join(taken)


def _numbers(values: Any) -> str:
    """Format numbers so that C reads the same bits."""
    return ", ".join(repr(float(value)) for value in values)


def _struct(name: str, dtype: np.dtype) -> str:
    """Return the C type of a record."""
    assert dtype.fields is not None
    lines = []
    for field, (kind, *_) in dtype.fields.items():
        base, shape = kind.subdtype or (kind, ())
        word = {"f8": "double", "f4": "float", "i8": "int64_t"}[base.str[1:]]
        lines.append(f"    {word} {field}{''.join(f'[{n}]' for n in shape)};")
    return "\n".join(["typedef struct {", *lines, f"}} {name};", ""])


# --------------------------------------------------------------------------------------------------
# The process that writes an exported filter, with one flight in a block.
# --------------------------------------------------------------------------------------------------


def write() -> None:
    """Write the files for a pickled suite on standard input, pickled, to standard output."""
    sys.stdout.buffer.write(pickle.dumps(_contents(*pickle.load(sys.stdin.buffer))))


def _contents(
    suite: SensorSuite, label: str, target: str, policy: dict[str, Any], imu_rate: float
) -> dict[str, bytes]:
    """Return the files by name; records must have one lane."""
    sources = Sources(suite, label, target, policy, imu_rate)
    processor = Processor(**TARGETS[target].processor)
    missing = [name for name in sources.functions if not is_cached(name, processor)]
    if missing:
        say(f"quad_gym: compiling {len(missing)} kernels of the filter for {target} (once)")
        context = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(min(4, os.cpu_count() or 1), context) as pool:
            tasks = [pool.submit(object_of, name, processor) for name in missing]
            for task in tasks:
                task.result()
    objects = {core_symbol(name): object_of(name, processor) for name in sources.functions}
    for symbol, numbers in sources.constants.items():
        text = "".join(f"\\{byte:02X}" for byte in numbers)
        ir = f'@{symbol} = constant [{len(numbers)} x i8] c"{text}", align 64\n'
        objects[symbol] = emitted(ir, processor)
    flash = sum(map(loaded_size, objects.values()))
    return {LIBRARY: archive(objects), **sources.texts(flash)}
