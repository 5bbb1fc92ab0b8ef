"""Exported filters: estimates of the example equal a replay bitwise on every processor."""

import ctypes
import dataclasses
import functools
import importlib.util
import math
import shutil
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import quad_gym
from baselines.exporting import controller_of, export_filter
from baselines.exporting.filter_library import LIBRARY, archive
from docs.examples import cortex_m4
from quad_gym.commands.main import main
from quad_gym.estimation import UnscentedKalmanFilter, replay
from quad_gym.estimation.starts import state_at_rest
from quad_gym.frames import geodetic_to_ecef
from quad_gym.logs.formats import read_log
from quad_gym.logs.replaying.log_start import wide_start
from quad_gym.params.suites import ALL_SUITES
from quad_gym.records import SINGLE
from tests.console_commands import refused
from tests.exported import as_printed, estimates, hard_log, parsed
from tests.logged_flights import Recorded, flown

FOLDER = Path(tempfile.mkdtemp(prefix="quad_gym_filters_"))
AARCH64, ARM = "aarch64-linux-gnu", "arm-linux-gnueabihf"


def runtime_of_wasm():
    """True if clang has its runtime library for WebAssembly."""
    if not shutil.which("clang"):
        return False
    line = ["clang", "--target=wasm32-wasi", "--print-libgcc-file-name"]
    return Path(subprocess.check_output(line, text=True).strip()).exists()


needs_compiler = pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler (cc)")
needs_wasm = pytest.mark.skipif(
    not (shutil.which("node") and Path("/usr/lib/wasm32-wasi").exists() and runtime_of_wasm()),
    reason="no node, wasi-libc, clang, or libclang-rt-dev-wasm32",
)
needs_cmake = pytest.mark.skipif(not shutil.which("cmake"), reason="no CMake")
needs_aarch64 = pytest.mark.skipif(
    not (shutil.which(f"{AARCH64}-gcc") and shutil.which("qemu-aarch64-static")),
    reason="no gcc-aarch64-linux-gnu, or no qemu-user-static",
)
needs_arm = pytest.mark.skipif(
    not (shutil.which(f"{ARM}-gcc") and shutil.which("qemu-arm-static")),
    reason="no gcc-arm-linux-gnueabihf, or no qemu-user-static",
)
needs_single = pytest.mark.skipif(
    not SINGLE, reason="computes in single precision: set QUAD_GYM_PRECISION=single"
)
needs_m4 = pytest.mark.skipif(
    not all(map(importlib.util.find_spec, ("unicorn", "ziglang"))),
    reason="no emulator of a Cortex-M4: pip install unicorn ziglang",
)
slow = partial(pytest.param, marks=pytest.mark.slow)  # half a minute for each target
REST = {"position": (0.0, 0.0, 1.5), "heading": math.radians(20.0)}
TURNED = quad_gym.sensor_suite("rtk")
TURNED = TURNED.replace(
    log_rotation=(0.05, 0.02, 0.1),
    log_accel_bias=(0.05, -0.1, 0.02),
    log_gyro_bias=(0.002, -0.001, 0.003),
    log_delays=TURNED.log_delays.replace(gnss=0.12, camera=-0.03),
    imu=TURNED.imu.replace(lever_arm_B=(0.05, -0.02, 0.03)),
)
"""A suite as calibration finds it."""
TURNED_FILE = str(TURNED.save(FOLDER / "turned.toml"))


@pytest.fixture(scope="module", autouse=True)
def _folder():
    yield
    shutil.rmtree(FOLDER)


def exported(name, target="x86-64", policy=None):
    folder = FOLDER / f"{Path(name).stem}_{target}_{policy is None}"
    if not folder.exists():
        export_filter(quad_gym.sensor_suite(name), name, target, folder, policy)
    return folder


@functools.cache
def logged(name, seconds=3.0, max_ticks=3):
    """Write a log with latency, jitter and losses, without columns of absent sensors."""
    suite = quad_gym.sensor_suite(name)
    recorded = Recorded(flown(suite, seconds), suite, max_ticks=max_ticks)
    table = recorded.table()
    absent = [k for k, v in table.items() if "gnss" in k and np.isnan(v).all()]
    absent += [k for k in table if k.startswith("pixel") and suite.camera is None]
    recorded.table = lambda: {k: v for k, v in table.items() if k not in absent}
    recorded.write_csv(FOLDER / f"{name}_{seconds:g}.csv")
    return FOLDER / f"{name}_{seconds:g}.csv"


def example(name, target, *flags, compiler="cc"):
    program = exported(name, target) / "example"
    if not program.exists():
        files = [program.with_name("main.c"), program.with_name(LIBRARY)]
        subprocess.run([compiler, "-O2", *flags, *files, "-lm", "-o", program], check=True)
    return program


def require_equal(run, log, suite, start):
    """Replay a log, and compare with the output of a program on its samples."""
    samples = FOLDER / f"samples_{len(list(FOLDER.iterdir()))}.csv"
    wanted = replay(log, sensors=suite, start=start, samples=samples)
    names, rows = run(samples)
    assert names == list(wanted.columns())
    np.testing.assert_array_equal(rows, as_printed(wanted))
    assert len(rows) > 100
    return wanted


@needs_compiler
@pytest.mark.parametrize("name", ["rtk", "consumer", slow("standard"), "indoor", slow("uwb")])
def test_example_prints_estimates_of_replay(name):
    suite, program = quad_gym.sensor_suite(name), example(name, "x86-64")
    start = REST if suite.gnss is None else {}
    require_equal(partial(estimates, program), logged(name), suite, start)


@needs_compiler
@pytest.mark.parametrize(
    "name", [name if name in ("rtk", "consumer") else slow(name) for name in ALL_SUITES]
)
def test_example_equals_replay_after_resets_outliers_outage_and_start_in_motion(name):
    suite = quad_gym.sensor_suite(name)
    table, start = hard_log(suite)
    result = require_equal(partial(estimates, example(name, "x86-64")), table, suite, start)
    if name in ("rtk", "consumer"):  # all of that happens there
        assert wide_start(suite, read_log(table))["tilt_sigma"] == 0.3
        assert result.measured["gnss_position"].rejected.any()
        assert np.diff(result.sigma[:, 6]).max() > 0.5 * suite.estimator.initial_tilt_sigma


@needs_compiler
@pytest.mark.slow  # it compiles two filters for export
@pytest.mark.parametrize("name", ["consumer", "field"])
def test_example_equals_replay_with_a_compass_that_reverses_in_flight(name):
    suite = quad_gym.sensor_suite(name)
    table = Recorded(flown(suite, 8.0), suite, max_ticks=3).table()
    table = {k: v for k, v in table.items() if np.isfinite(v).any()}
    for axis in "xy":
        table[f"magnetometer_{axis}"][table["time"] > 3.0] *= -1.0
    result = require_equal(partial(estimates, example(name, "x86-64")), table, suite, {})
    assert result.compass_out.any()


@needs_compiler
@pytest.mark.slow  # it compiles a filter for export
def test_example_equals_replay_after_a_fix_of_consumer_with_reported_noise():
    """In single precision, too, the reported noise is scaled in double precision, here by 2."""
    suite = quad_gym.sensor_suite("consumer")
    suite = suite.replace(estimator=suite.estimator.replace(initial_covariance_scale=2.0))
    table = Recorded(flown(suite, 3.0), suite).table()
    table = {k: v for k, v in table.items() if np.isfinite(v).any()}
    for axis, sigma in (("east", 0.7), ("north", 0.9), ("up", 1.3)):
        table[f"gnss_sigma_{axis}"] = np.where(np.isfinite(table["gnss_up"]), sigma, np.nan)
    name = str(suite.save(FOLDER / "scaled.toml"))
    require_equal(partial(estimates, example(name, "x86-64")), table, suite, {})


@needs_compiler
def test_exported_filter_takes_samples_in_the_axes_of_sensors(tmp_path):
    """Rows of samples are those of the log, and the library rotates them as the replay does."""
    suite = quad_gym.sensor_suite("consumer").replace(
        log_rotation=(0.05, 0.02, 0.1),
        log_compass_rotation=(0.1, -0.1, 0.3),
        log_accel_bias=(0.1, 0.0, 0.2),
    )
    export_filter(suite, "askew", "x86-64", tmp_path)
    # the suite is none of the built-in ones, so a command needs its file
    assert "quad-gym replay LOG --sensors askew.toml " in (tmp_path / "README.md").read_text()
    program = tmp_path / "example"
    files = [tmp_path / "main.c", tmp_path / LIBRARY]
    subprocess.run(["cc", "-O2", *files, "-lm", "-o", program], check=True)
    table = read_log(logged("consumer"))
    result = replay(table, sensors=suite, samples=tmp_path / "samples.csv")
    rows = [line.split(",") for line in (tmp_path / "samples.csv").read_text().split()]
    for name, first, values in (
        ("imu", 1, np.hstack([table.imu.values["gyro"], table.imu.values["accel"]])),
        ("magnetometer", 2, table.magnetometer.values["magnetometer"]),
    ):
        given = {tuple(row) for row in values.tolist()}
        width = values.shape[1]
        found = [tuple(map(float, row[first:][:width])) for row in rows if row[0] == name]
        assert len(found) > 20
        assert set(found) <= given
    found = estimates(program, tmp_path / "samples.csv")[1]
    np.testing.assert_array_equal(found, as_printed(result))


@functools.cache
def rtk_table():
    return Recorded(flown(quad_gym.sensor_suite("rtk"), 3.0), quad_gym.sensor_suite("rtk")).table()


def turned_table():
    """A table of `rtk`, whose columns tests change."""
    return {name: column.copy() for name, column in rtk_table().items()}


@functools.cache
def calibrated():
    """The example of the suite with rotation, delays and lever arm."""
    return example(TURNED_FILE, "x86-64")


@needs_compiler
@pytest.mark.parametrize(
    "change", ["none", "motors", "early fix", "missing numbers", "Unix time", "attitudes"]
)
def test_example_of_a_calibrated_suite_prints_estimates_of_replay(change):
    """Rotation, delays of both signs and a lever arm, on logs that the replay reads."""
    table = turned_table()
    if change == "motors":
        table |= {f"motor_{k}": np.full(len(table["time"]), 3.0) for k in range(4)}
    elif change == "early fix":
        row = int(np.flatnonzero(np.isfinite(table["gnss_east"]))[0])
        table = {name: np.insert(values, 0, values[row]) for name, values in table.items()}
        for name in [name for name in table if name.startswith(("gyro", "accel", "pixel"))]:
            table[name][0] = np.nan
        table["time"][0] = table["received"][0] = -1.5
    elif change == "missing numbers":
        table["gnss_velocity_east"][200::2] = np.nan
        table["gnss_baseline_north"][200::3] = np.nan
    elif change == "Unix time":
        table["time"], table["received"] = table["time"] + 1.7e9, table["received"] + 1.7e9
    elif change == "attitudes":  # of motion capture, which replace the baselines
        found, fixes = replay(table, sensors=TURNED), np.isfinite(table["gnss_east"])
        table = {name: v for name, v in table.items() if not name.startswith("gnss_baseline")}
        for k, axis in enumerate("wxyz"):
            values = np.interp(table["time"], found.time, found.quaternion[:, k])
            table[f"attitude_{axis}"] = np.where(fixes, values, np.nan)
    require_equal(partial(estimates, calibrated()), table, TURNED, {})


@needs_compiler
def test_example_refuses_measurements_older_than_its_memory(tmp_path):
    """With an IMU of 1 kHz, it has room for a tenth of the delay."""
    n = 3000
    table = {"time": 1e-3 * np.arange(n), "gyro": np.zeros((n, 3))}
    table["accel"] = np.tile([0.0, 0.0, 9.8], (n, 1))
    table["gnss_enu"] = np.full((n, 3), np.nan)
    table["gnss_enu"][::200] = 0.0
    table["gnss_baseline_enu"] = table["gnss_enu"] + [1.0, 0.0, 0.0]
    late = table["time"][::200] + 0.45
    table["received"] = table["time"].copy()
    table["received"][200::200] = late[1:]
    samples = tmp_path / "samples.csv"
    result = replay(table, sensors="rtk", samples=samples)
    assert result.too_late == 0
    done = subprocess.run([example("rtk", "x86-64"), samples], capture_output=True, text=True)
    assert done.returncode == 2
    assert "older than the memory of the filter" in done.stderr
    folder = tmp_path / "fast"
    suite = quad_gym.sensor_suite("rtk")
    export_filter(suite, "rtk", "x86-64", folder, imu_rate=1000.0)
    files = [folder / "main.c", folder / LIBRARY]
    subprocess.run(["cc", "-O2", *files, "-lm", "-o", folder / "example"], check=True)
    found = estimates(folder / "example", samples)[1]
    np.testing.assert_array_equal(found, as_printed(result))


@needs_compiler
def test_example_refuses_samples_of_another_origin(tmp_path):
    table = turned_table()
    far = 1.05 * np.array(TURNED.gnss.reference_antenna_G)
    for axis, ecef, center in zip(("east", "north", "up"), "xyz", far, strict=True):
        table[f"gnss_{ecef}"] = center + table.pop(f"gnss_{axis}")
    replay(table, sensors="rtk", samples=tmp_path / "samples.csv")
    command = [example("rtk", "x86-64"), tmp_path / "samples.csv"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, "--log LOG" in done.stderr) == (2, True)


@pytest.mark.parametrize(
    ("without", "start", "message"),
    [
        ("motor", {"gnss_sigma": 0.1, "accel": (0.0, 0.0, 9.8)}, "accel"),
        ("gnss_baseline", {}, "baseline or a magnetic field"),
    ],
)
def test_starts_that_exported_filters_lack_are_refused(without, start, message):
    table = {key: v for key, v in turned_table().items() if not key.startswith(without)}
    with pytest.raises(ValueError, match=message):
        replay(table, sensors="rtk", start=start, samples=FOLDER / "none.csv")
    assert not (FOLDER / "none.csv").exists()


@needs_compiler
@pytest.mark.parametrize("option", ["heading", "course"])
def test_example_with_start_in_flight_equals_replay(option, tmp_path):
    """A start in flight uses a given heading or the course, without baseline or magnetometer."""
    lines = [line.split(",") for line in logged("consumer").read_text().split()]
    lines = [lines[0], *(line for line in lines[1:] if float(line[1]) > 1.5)]
    kept = [k for k, name in enumerate(lines[0]) if not name.startswith("magnetometer")]
    log = tmp_path / "log.csv"
    log.write_text("\n".join(",".join(line[k] for k in kept) for line in lines))
    start = {"heading": {"heading": math.radians(50.0)}, "course": {"course": True}}[option]
    run = partial(estimates, example("consumer", "x86-64"))
    require_equal(run, log, quad_gym.sensor_suite("consumer"), start)


def on_aarch64(name, log):
    program = example(name, "aarch64", "-static", compiler=f"{AARCH64}-gcc")
    return estimates("qemu-aarch64-static", program, log)


def on_arm(name, log):
    """Run the code for Cortex-M7, without the attributes that prevent its use on Linux."""
    folder = exported(name, "cortex-m7")
    program, flat = folder / "example", folder / "without_attributes.a"
    if not program.exists():
        strip = [f"{ARM}-objcopy", "--remove-section", ".ARM.attributes", folder / LIBRARY, flat]
        subprocess.run(strip, check=True)
        line = [f"{ARM}-gcc", "-O2", "-static", "-mthumb", folder / "main.c", flat, "-lm"]
        subprocess.run([*line, "-o", program], check=True)
    return estimates("qemu-arm-static", "-cpu", "max", program, log)


def on_m4(name, log):
    """Run the code for Cortex-M4 in Unicorn."""
    folder = exported(name, "cortex-m4")
    program = folder / "example"
    if not program.exists():
        cortex_m4.compiled(folder)
    return parsed(cortex_m4.Machine(program, log).run())


def on_wasm(name, log):
    """Run the code for WebAssembly in Node.js."""
    folder = exported(name, "wasm32")
    program, run = folder / "example", folder / "run.mjs"
    if not program.exists():
        clock = ["-D_WASI_EMULATED_PROCESS_CLOCKS", "-lwasi-emulated-process-clocks", "-lm"]
        files = [folder / "main.c", folder / LIBRARY]
        line = ["clang", "--target=wasm32-wasi", "--sysroot=/usr", "-std=c99", "-O2", *files]
        subprocess.run([*line, *clock, "-o", program], check=True, capture_output=True)
    run.write_text(
        "import { readFile } from 'node:fs/promises';\nimport { WASI } from 'node:wasi';\n"
        f"const given = {{ version: 'preview1', args: ['example', '{log}'], "
        f"preopens: {{ '{log.parent}': '{log.parent}' }} }};\nconst wasi = new WASI(given);\n"
        f"const program = await WebAssembly.instantiate(await readFile('{program}'), "
        "wasi.getImportObject());\nwasi.start(program.instance);\n"
    )
    return estimates("node", run)


@pytest.mark.parametrize(
    "run",
    [
        pytest.param(on_aarch64, id="aarch64", marks=[needs_aarch64, pytest.mark.slow]),
        pytest.param(on_arm, id="cortex-m7", marks=[needs_arm, pytest.mark.slow]),
        pytest.param(on_m4, id="cortex-m4", marks=[needs_single, needs_m4, pytest.mark.slow]),
        pytest.param(on_wasm, id="wasm32", marks=[needs_wasm, pytest.mark.slow]),
    ],
)
@pytest.mark.parametrize(
    "name", ["rtk", slow("crazyflie"), slow("consumer"), pytest.param(TURNED_FILE, id="turned")]
)
def test_example_on_foreign_processor_prints_estimates_of_replay(run, name):
    suite = quad_gym.sensor_suite(name)
    require_equal(partial(run, name), logged(name), suite, REST if suite.gnss is None else {})


@pytest.mark.slow  # two minutes to fly, three to filter
@needs_compiler
@needs_aarch64
@needs_arm
def test_examples_print_a_replay_of_1e5_samples():
    suite, log = quad_gym.sensor_suite("rtk"), logged("rtk", 510.0, 1)
    native = partial(estimates, example("rtk", "x86-64"))
    for run in (native, partial(on_aarch64, "rtk"), partial(on_arm, "rtk")):
        require_equal(run, log, suite, {})


@pytest.mark.parametrize("target", ["x86-64", slow("cortex-m7"), slow("aarch64")])
@pytest.mark.skipif(not shutil.which("nm"), reason="no nm (binutils)")
def test_compiled_filter_calls_no_function_of_the_math_library(target):
    command = ["nm", "--undefined-only", exported("rtk", target) / LIBRARY]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split("\n")
    called = {line.split()[1] for line in lines if " U " in line}
    assert {name for name in called if not name.startswith(("__aeabi_", "mem"))} == set()


@needs_compiler
def test_export_without_numba_raises_import_error_with_install_hint(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(ImportError, match=r'needs numba: pip install "quad-gym\[compile\]"'):
        export_filter(quad_gym.sensor_suite("rtk"), "rtk", "x86-64", tmp_path)


@needs_cmake
def test_cmake_builds_the_example_without_warnings(tmp_path):
    flags = "-DCMAKE_C_FLAGS=-Wall -Wextra -pedantic -Werror"
    subprocess.run(["cmake", "-S", exported("rtk"), "-B", tmp_path, flags], check=True)
    subprocess.run(["cmake", "--build", tmp_path], check=True)
    replay(logged("rtk"), sensors="rtk", samples=tmp_path / "samples.csv")
    assert estimates(tmp_path / "example", tmp_path / "samples.csv")[1].shape[1] == 33


@needs_compiler
@pytest.mark.parametrize("words", [["--fast"], [], ["no.csv", "--time"], ["no.csv"]])
def test_example_refuses_wrong_options(words):
    done = subprocess.run([example("rtk", "x86-64"), *words], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")


class Estimate(ctypes.Structure):
    _fields_ = (
        ("time", ctypes.c_double),
        ("numbers", ctypes.c_double * (3 + 3 + 9 + 4 + 3 + 3 + 15)),
        ("diverged", ctypes.c_int),
    )


OK, NOT_STARTED, NOT_FINITE, OUT_OF_RANGE, TOO_OLD, TOO_NEW, FULL = range(7)


class Library:
    """The exported filter of a suite, loaded by ctypes."""

    def __init__(self, name, policy=None):
        folder = exported(name, "x86-64", policy)
        source = folder / "all.c"
        source.write_text(
            '#define QUAD_GYM_FILTER_IMPLEMENTATION\n#include "quad_gym_filter.h"\n'
            "unsigned long qg_size(void) { return sizeof(qg_filter); }\n"
        )
        shared = folder / "all.so"
        flags = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-O2", "-shared", "-fPIC"]
        subprocess.run(["cc", *flags, source, folder / LIBRARY, "-lm", "-o", shared], check=True)
        self._c = ctypes.CDLL(str(shared))
        self._c.qg_time.restype = self._c.qg_oldest_time.restype = ctypes.c_double
        self.memory = ctypes.create_string_buffer(self._c.qg_size() + 64)

    def call(self, name, *arguments):
        """Call a function; scalars become doubles, sequences become arrays of doubles."""
        given = [
            ctypes.c_double(a) if np.ndim(a) == 0 else (ctypes.c_double * len(a))(*a)
            for a in arguments
        ]
        return getattr(self._c, f"qg_{name}")(self.memory, *given)

    def estimate(self):
        found = Estimate()
        assert self._c.qg_state(self.memory, ctypes.byref(found)) == OK
        return np.array(found.numbers)

    def covariance(self):
        found = np.empty((15, 15))
        pointer = found.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
        assert self._c.qg_covariance(self.memory, pointer) == OK
        return found


@functools.cache
def library(name):
    return Library(name)


def started(name):
    suite = quad_gym.sensor_suite(name)
    ukf, c = UnscentedKalmanFilter(suite), library(name)
    ukf.set_state(**state_at_rest(suite, (1.0, -2.0, 0.8), 0.4, 10.0))
    assert c.call("init_at_rest", [1.0, -2.0, 0.8], 0.4, 10.0) == OK
    return ukf, c


@needs_compiler
def test_calls_give_the_estimates_of_the_python_filter():
    """Samples have any length, and measurements are up to 0.4 s late."""
    ukf, c = started("crazyflie")
    rng = np.random.default_rng(0)
    for _ in range(400):
        kind, late = rng.integers(6), rng.uniform(0.0, 0.4) * rng.integers(2)
        time = max(ukf.oldest_time, ukf.time - late)
        if kind == 0:
            flow = rng.normal(0.0, 0.2, 2)
            ukf.update(optical_flow=flow, time=time)
            assert c.call("update_optical_flow", flow, time) == OK
        elif kind == 1:
            height = 0.8 + rng.normal(0.0, 0.02)
            ukf.update(range_finder=height, time=time)
            assert c.call("update_range_finder", height, time) == OK
        else:
            gyro, dt = rng.normal(0.0, 0.2, 3), rng.choice([0.005, rng.uniform(0.001, 0.02)])
            accel = rng.normal([0.0, 0.0, 9.8], 0.3)
            ukf.predict(gyro, accel, dt=dt)
            assert c.call("predict", gyro, accel, dt) == OK
    assert c._c.qg_time(c.memory) == ukf.time
    assert c._c.qg_oldest_time(c.memory) == ukf.oldest_time
    assert c._c.qg_status(c.memory) == ukf.status == 0
    parts = np.split(c.estimate(), np.cumsum([3, 3, 9, 4, 3, 3]))
    wanted = (ukf.position, ukf.velocity, ukf.R_BI.ravel(), ukf.accel_bias, ukf.gyro_bias)
    for found, values in zip((*parts[:3], *parts[4:6]), wanted, strict=True):
        np.testing.assert_array_equal(found, values)
    np.testing.assert_allclose(parts[6] ** 2, np.diag(ukf.covariance), rtol=1e-12)
    np.testing.assert_allclose(c.covariance(), ukf.covariance, rtol=1e-9, atol=1e-18)


@needs_compiler
def test_ranges_missing_late_and_after_an_outage_give_the_estimates_of_the_python_filter():
    ukf, c = started("uwb")
    anchors, rng = np.array(ukf.sensors.uwb_range.anchors_I), np.random.default_rng(1)
    for _ in range(300):
        if rng.random() < 0.2:
            time = max(ukf.oldest_time, ukf.time - rng.uniform(0.0, 0.4) * rng.integers(2))
            ranges = np.linalg.norm(anchors - (1.0, -2.0, 0.8), axis=1) + rng.normal(0.0, 0.1, 4)
            ranges[rng.random(4) < 0.3] = np.nan
            ukf.update(uwb_range=ranges, time=time)
            assert c.call("update_uwb_range", ranges, time) == OK
        else:
            gyro, accel = rng.normal(0.0, 0.2, 3), rng.normal([0.0, 0.0, 9.8], 0.3)
            ukf.predict(gyro, accel, dt=0.005)
            assert c.call("predict", gyro, accel, 0.005) == OK
    assert np.isfinite(ukf.nis[0])
    rest = np.zeros(3), np.array([0.0, 0.0, 9.8])
    for _ in range(2000):  # an outage of 10 s, after which ranges are processed in steps
        ukf.predict(*rest, dt=0.005)
        assert c.call("predict", *rest, 0.005) == OK
    ranges = np.linalg.norm(anchors - ukf.position - ukf.covariance[0, 0] ** 0.5, axis=1)
    ukf.update(uwb_range=ranges, time=ukf.time)
    assert c.call("update_uwb_range", ranges, ukf.time) == OK
    assert np.isnan(ukf.nis[0])
    parts = np.split(c.estimate(), np.cumsum([3, 3, 9, 4, 3, 3]))
    wanted = (ukf.position, ukf.velocity, ukf.R_BI.ravel(), ukf.accel_bias, ukf.gyro_bias)
    for found, values in zip((*parts[:3], *parts[4:6]), wanted, strict=True):
        np.testing.assert_array_equal(found, values)
    assert ukf.status == 0


@needs_compiler
@pytest.mark.parametrize(
    ("result", "name", "arguments"),
    [
        (NOT_FINITE, "predict", ([0.0, math.nan, 0.0], [0.0, 0.0, 9.8], 0.005)),
        (NOT_FINITE, "predict", ([0.0] * 3, [0.0, math.inf, 9.8], 0.005)),
        (OUT_OF_RANGE, "predict", ([0.0] * 3, [0.0, 0.0, 9.8], 0.0)),
        (OUT_OF_RANGE, "predict", ([0.0] * 3, [0.0, 0.0, 9.8], 1.1)),
        (NOT_FINITE, "update_optical_flow", ([0.1, math.nan], 10.1)),
        (NOT_FINITE, "update_range_finder", (0.8, math.nan)),
        (TOO_OLD, "update_range_finder", (0.8, 9.9)),
        (TOO_NEW, "update_range_finder", (0.8, 11.2)),
        (NOT_FINITE, "init_at_rest", ([0.0, 0.0, math.inf], 0.0, 0.0)),
    ],
)
def test_wrong_call_returns_an_error_and_changes_nothing(result, name, arguments):
    c = started("crazyflie")[1]
    for _ in range(20):
        assert c.call("predict", [0.0] * 3, [0.0, 0.0, 9.8], 0.005) == OK
    before = c.memory.raw
    assert c.call(name, *arguments) == result
    assert c.memory.raw == before


@needs_compiler
def test_calls_before_the_start_return_an_error():
    c = Library("crazyflie")
    assert c.call("predict", [0.0] * 3, [0.0, 0.0, 9.8], 0.005) == NOT_STARTED
    assert c.call("update_range_finder", 0.8, 0.0) == NOT_STARTED


@needs_compiler
def test_early_measurement_waits_for_the_imu_sample_of_its_time():
    """The estimate equals the one with a late measurement of this time."""
    c, whole = library("crazyflie"), []
    for early in (True, False):
        assert c.call("init_at_rest", [0.0, 0.0, 0.8], 0.0, 0.0) == OK
        if early:
            assert c.call("update_range_finder", 0.81, 0.004) == OK
        assert c.call("predict", [0.0] * 3, [0.0, 0.0, 9.8], 0.01) == OK
        if not early:
            assert c.call("update_range_finder", 0.81, 0.004) == OK
        whole.append(c.estimate())
    np.testing.assert_array_equal(whole[0], whole[1])


@needs_compiler
def test_only_so_many_measurements_wait_for_a_pausing_imu():
    """They are included in their order with the next sample, and one more is refused."""
    ukf, c = started("crazyflie")
    times = [10.5 + 0.01 * k for k in range(16)]
    for time in reversed(times):
        assert c.call("update_range_finder", 0.81, time) == OK
    assert c.call("update_range_finder", 0.81, 10.7) == FULL
    assert c.call("predict", [0.0] * 3, [0.0, 0.0, 9.8], 0.9) == OK
    ukf.predict([0.0] * 3, [0.0, 0.0, 9.8], dt=0.9)
    for time in times:
        ukf.update(range_finder=0.81, time=time)
    np.testing.assert_array_equal(c.estimate()[:3], ukf.position)


@needs_compiler
def test_full_memory_shortens_the_window_only():
    """Ten times as many measurements arrive as the suite's rates imply."""
    ukf, c = started("crazyflie")
    rng = np.random.default_rng(1)
    for _ in range(150):
        ukf.predict([0.0] * 3, [0.0, 0.0, 9.8], dt=0.005)
        assert c.call("predict", [0.0] * 3, [0.0, 0.0, 9.8], 0.005) == OK
        for height in rng.normal(0.8, 0.02, 10):
            ukf.update(range_finder=height)
            assert c.call("update_range_finder", height, ukf.time) == OK
    np.testing.assert_array_equal(c.estimate()[:3], ukf.position)
    assert ukf.oldest_time < c._c.qg_oldest_time(c.memory) < ukf.time


@needs_compiler
def test_policy_acts_on_the_estimate_as_its_network_does():
    controller = controller_of("pretrained", "QuadGym/Circle-v0")
    c, rng, last = Library("crazyflie", controller), np.random.default_rng(2), np.zeros(4)
    reference, action = rng.normal(0.0, 1.0, (6, 3)), (ctypes.c_float * 4)()
    r, v, a, h, *later = reference
    pointer = np.ascontiguousarray(reference).ctypes.data_as(ctypes.c_void_p)

    def act():
        return c._c.qg_action(c.memory, pointer, action)

    assert act() == NOT_STARTED
    assert c.call("init_at_rest", [1.0, -2.0, 0.8], 0.4, 0.0) == OK
    for _ in range(5):
        gyro = rng.normal(0.0, 0.2, 3)
        assert c.call("predict", gyro, [0.1, 0.2, 9.7], 0.005) == OK
        assert act() == OK
        position, velocity, R, _, _, b_g, _ = np.split(c.estimate(), np.cumsum([3, 3, 9, 4, 3, 3]))
        seen = [r - position, v - velocity, [0.0, 0.0, 1.0], h, a, later[0] - r, later[1] - r]
        seen = [R.reshape(3, 3) @ x for x in seen]
        observation = np.concatenate([*seen[:4], gyro - b_g, *seen[4:], last])
        last = controller.act(observation)
        np.testing.assert_allclose(list(action), last, atol=1e-6)
    before, reference[0, 0] = c.memory.raw, np.nan
    assert act() == NOT_FINITE
    assert c.memory.raw == before


def test_policy_that_observes_more_than_the_estimate_is_refused(tmp_path):
    controller = controller_of("pretrained", "QuadGym/Circle-v0")
    field = controller.table[0]._replace(name="true_position_error")
    controller = dataclasses.replace(controller, table=(field, *controller.table[1:]))
    with pytest.raises(ValueError, match="true_position_error"):
        export_filter(quad_gym.sensor_suite("rtk"), "rtk", "x86-64", tmp_path, controller)


@pytest.mark.skipif(not shutil.which("ar"), reason="no ar")
def test_archive_is_readable_by_ar(tmp_path):
    (tmp_path / "it.a").write_bytes(archive({"one": b"odd", "two": b"even"}))
    told = subprocess.run(["ar", "pv", tmp_path / "it.a"], check=True, capture_output=True)
    assert told.stdout == b"\n<0.o>\n\nodd\n<1.o>\n\neven"


@pytest.mark.parametrize("target", [slow("cortex-m7"), slow("wasm32")])
def test_library_for_a_foreign_processor_has_its_format(target):
    library = (exported("rtk", target) / LIBRARY).read_bytes()
    member = library[8 + 60 + int(library[8 + 48 : 8 + 58]) :].lstrip(b"\n")[60:]
    machine = {"cortex-m7": b"\x7fELF\x01\x01", "wasm32": b"\0asm\x01\0\0\0"}[target]
    assert member.startswith(machine)
    text = (exported("rtk", target) / "README.md").read_text()
    assert "@" not in text


def test_command_writes_a_folder_and_replaces_none(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    line = "export filter --sensors rtk --target x86-64"
    assert main(line.split()) == 0
    folder = tmp_path / "results" / "export" / "filter_rtk_x86-64"
    names = ["CMakeLists.txt", "README.md", "libquad_gym_filter.a", "main.c", "quad_gym_filter.h"]
    assert sorted(file.name for file in folder.iterdir()) == names
    assert "int qg_update_pixels(" in (folder / "quad_gym_filter.h").read_text()
    assert "README.md" in capsys.readouterr().out
    assert "libquad_gym_filter.a exists: use --overwrite" in refused(line, capsys)


def test_unknown_target_is_refused(tmp_path):
    with pytest.raises(ValueError, match="target must be one of"):
        export_filter(quad_gym.sensor_suite("rtk"), "rtk", "riscv", tmp_path)


def test_origin_is_the_first_fix_of_the_part_of_the_log_that_is_replayed(tmp_path, monkeypatch):
    """A vehicle drives north by 0.001 degrees a second; columns have the names of others."""
    time = np.arange(0.0, 4.0, 0.01)
    rows = [f"{t:.2f},0,0,0,0,0,9.81,{47.0 + 0.001 * t},8.5,400" for t in time]
    names = "stamp,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z,gnss_lat,gnss_lon,gnss_alt"
    (tmp_path / "log.csv").write_text("\n".join([names, *rows]))
    columns = {"time": ["stamp"], "gnss_lla": ["gnss_lat", "gnss_lon", "gnss_alt"]}
    columns |= {name: [f"{name}_{axis}" for axis in "xyz"] for name in ("gyro", "accel")}
    (tmp_path / "map.toml").write_text(
        "\n".join(f"[{name}]\ncolumns = {given}" for name, given in columns.items())
    )
    seen = []

    def caught(suite, *_, **__):
        seen.append(suite.gnss.reference_antenna_G)
        return []

    monkeypatch.setattr("baselines.exporting.filter_library.export_filter", caught)
    options = (
        "--sensors",
        "field",
        "--log",
        tmp_path / "log.csv",
        "--columns",
        tmp_path / "map.toml",
    )
    words = ["export", "filter", *map(str, options), "--output", str(tmp_path / "out")]
    for part, begin in (([], 0.0), (["--from", "2.5"], 2.5)):
        main([*words, *part])
        np.testing.assert_allclose(
            seen[-1],
            geodetic_to_ecef(math.radians(47.0 + 0.001 * begin), math.radians(8.5), 400.0),
            atol=1e-3,
        )


def test_options_that_read_a_log_need_one(capsys):
    assert "--from must come with --log" in refused("export filter --from 2", capsys)
