"""Logs with random damage: a replay returns finite numbers, twice the same bits, or a sentence."""

import csv
import functools
import gzip
import math
import shutil
import tempfile
import traceback
from pathlib import Path

import numpy as np

import quad_gym
from quad_gym.commands.replay import report_of
from quad_gym.estimation import read_log, replay
from quad_gym.logs.replaying.replay import suite_for
from quad_gym.params.suites import ALL_SUITES
from tests import foreign_logs as foreign
from tests.contract.comparing import assert_same
from tests.soak.drawing import chance, log_uniform, pick

ABOUT = "replays of logs with damaged bytes, columns, values or times, twice each"
ROOT = Path(__file__).parents[2]
TABLES = sorted((ROOT / "tests/data/flights").glob("*.csv.gz"))
MAP = ROOT / "docs/examples/nanobench.toml"
MAPPED = "crazyflie_circle.csv.gz"
"""The table whose columns have other names."""
ODD = (
    "nan",
    "inf",
    "1e300",
    "-1e300",
    "1e18",
    "-1e9",
    "1e6",
    "1e-320",
    "0",
    "-0.0",
    "",
    "x",
    "\u0663",
)
"""Values, the last one in other digits."""


# --------------------------------------------------------------------------------------------------
# Sound logs.
# --------------------------------------------------------------------------------------------------


@functools.cache
def sound():
    """Logs by the names of their files: contents, or for a folder the contents of its files."""
    found = {path.name: path.read_bytes() for path in TABLES}
    flight = foreign.flight(seconds=8.0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        foreign.write_dataflash(folder / "flight.bin", foreign.ardupilot_rows(flight))
        foreign.write_px4(folder / "flight.ulg", flight)
        for version, file in ((1, "flight.bag"), (2, "folder")):
            bag = foreign.Bag(version)
            bag.imu("/imu", flight)
            bag.fixes("/fix", flight)
            bag.velocities("/velocity", flight)
            bag.pressures("/pressure", flight)
            bag.compass("/field", flight)
            bag.write(folder / file)
        for path in folder.iterdir():
            parts = {p.name: p.read_bytes() for p in path.iterdir()} if path.is_dir() else {}
            found[path.name] = parts or path.read_bytes()
    return found


@functools.cache
def table(name):
    """Rows of cells of a table; the first row has the names of its columns."""
    text = gzip.decompress(sound()[name]).decode()
    return list(csv.reader(text.splitlines()))


# --------------------------------------------------------------------------------------------------
# Damage of bytes.
# --------------------------------------------------------------------------------------------------


def damaged_bytes(rng, content):
    """Flip, cut, drop, double, overwrite or insert bytes, once or a few times."""
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 3))):
        if not data:
            break
        at = int(rng.integers(len(data)))
        if chance(rng, 0.3):
            at = min(at, int(rng.integers(400)))  # heads of files
        size = min(round(log_uniform(rng, 1.0, 5000.0)), len(data) - at)
        how = pick(rng, ("flip", "cut", "drop", "double", "zeros", "ones", "insert", "shuffle"))
        part = data[at : at + size]
        if how == "flip":
            for k in rng.integers(0, len(data), round(log_uniform(rng, 1.0, 50.0))):
                data[k] ^= 1 << int(rng.integers(8))
        elif how == "cut":
            del data[at:]
        else:
            put = {
                "drop": b"",
                "double": part + part,
                "zeros": bytes(size),
                "ones": b"\xff" * size,
                "insert": bytes(rng.integers(0, 256, size, np.uint8)) + part,
                "shuffle": bytes(rng.permutation(np.frombuffer(bytes(part), np.uint8))),
            }
            data[at : at + size] = put[how]
    return bytes(data)


# --------------------------------------------------------------------------------------------------
# Damage of tables: columns, values, times, rows.
# --------------------------------------------------------------------------------------------------


def damaged_table(rng, rows, damages):
    """Damage a table by some of `damages`, once or a few times."""
    first = int(rng.integers(0, max(1, len(rows) // 2)))
    head, body = list(rows[0]), [list(row) for row in rows[1 + first : 1 + first + 2000]]
    for _ in range(int(rng.integers(1, 3))):
        head, body = pick(rng, damages)(rng, head, body)
        if not body or not head:
            break
    return [head, *body]


def _span(rng, count):
    first = int(rng.integers(count))
    return slice(first, first + round(log_uniform(rng, 1.0, count)))


def remove_column(rng, head, body):
    """Remove a column."""
    k = int(rng.integers(len(head)))
    return head[:k] + head[k + 1 :], [row[:k] + row[k + 1 :] for row in body]


def double_column(rng, head, body):
    """Append a column again, with its name or with another one."""
    k = int(rng.integers(len(head)))
    name = pick(rng, (head[k], "copy", ""))
    return [*head, name], [[*row, row[k] if k < len(row) else ""] for row in body]


def swap_columns(rng, head, body):
    """Exchange the names of two columns."""
    a, b = (int(k) for k in rng.integers(len(head), size=2))
    head[a], head[b] = head[b], head[a]
    return head, body


def odd_values(rng, head, body):
    """Replace values of a column, the times included, by odd ones."""
    k, odd, share = int(rng.integers(len(head))), pick(rng, ODD), log_uniform(rng, 1e-3, 1.0)
    for row in body[_span(rng, len(body))]:
        if k < len(row) and chance(rng, share):
            row[k] = odd
    return head, body


def scaled_values(rng, head, body):
    """Multiply the values of a column in some rows."""
    k, factor = int(rng.integers(len(head))), pick(rng, (-1.0, 0.0, 1e-6, 9.81, 57.3, 1e6, 1e12))
    for row in body[_span(rng, len(body))]:
        if k < len(row):
            row[k] = _times(row[k], factor)
    return head, body


def _times(cell, factor):
    try:
        return repr(float(cell) * factor) if cell else cell
    except ValueError:
        return cell


def odd_times(rng, head, body):
    """Repeat, reverse, move or scatter times."""
    how, moved = pick(rng, ("repeat", "reverse", "move", "scatter")), log_uniform(rng, 1e-4, 1e10)
    k, span = 0, _span(rng, len(body))
    rows = [row for row in body[span] if row]
    cells = [row[k] for row in rows]
    for i, row in enumerate(rows):
        if how == "repeat":
            row[k] = cells[0]
        elif how == "reverse":
            row[k] = cells[-1 - i]
        else:
            shift = moved if how == "move" else moved * float(rng.normal())
            row[k] = _shifted(cells[i], shift)
    return head, body


def _shifted(cell, shift):
    try:
        return repr(float(cell) + shift)
    except ValueError:
        return cell


def shuffled_rows(rng, head, body):
    """Shuffle rows."""
    span = _span(rng, len(body))
    part = body[span]
    body[span] = [part[k] for k in rng.permutation(len(part))]
    return head, body


def repeated_rows(rng, head, body):
    """Insert rows again, where they are or at the end."""
    part = [list(row) for row in body[_span(rng, len(body))]]
    at = int(rng.integers(len(body)))
    return head, body[:at] + part + body[at:]


def lost_rows(rng, head, body):
    """Remove rows, or all behind one."""
    span = _span(rng, len(body))
    return head, body[: span.start] + (body[span.stop :] if chance(rng, 0.7) else [])


def ragged_rows(rng, head, body):
    """Cut or extend rows."""
    longer = chance(rng, 0.5)
    for row in body[_span(rng, len(body))]:
        if longer:
            row.append("0")
        else:
            del row[int(rng.integers(len(row) + 1)) :]
    return head, body


def lost_stretch(rng, head, body):
    """Remove rows of at most two seconds or so, as where a card was slow."""
    at = int(rng.integers(len(body)))
    return head, body[:at] + body[at + int(rng.integers(1, 200)) :]


def noisy_column(rng, head, body):
    """Add noise to the numbers of a column other than the times, of up to their size."""
    if len(head) < 2:
        return head, body
    k, share = int(rng.integers(1, len(head))), log_uniform(rng, 1e-3, 1.0)
    for row in body[_span(rng, len(body))]:
        if k < len(row):
            row[k] = _times(row[k], 1.0 + share * float(rng.normal()))
    return head, body


def repeated_stamps(rng, head, body):
    """Give a few rows the time of the row before, as a clock of low resolution does."""
    for i in rng.integers(1, len(body), int(rng.integers(1, 6))) if len(body) > 1 else ():
        if body[i] and body[i - 1]:
            body[i][0] = body[i - 1][0]
    return head, body


def other_unit(rng, head, body):
    """Write a column other than the times in another unit, from the first row to the last."""
    if len(head) < 2:
        return head, body
    k = int(rng.integers(1, len(head)))
    factor = pick(rng, (180.0 / math.pi, math.pi / 180.0, 9.81, 1.0 / 9.81, 100.0, 0.01, -1.0))
    for row in body:
        if k < len(row):
            row[k] = _times(row[k], factor)
    return head, body


MILD = (lost_stretch, noisy_column, repeated_stamps, other_unit)
"""Damages with which most logs are read."""
DAMAGES = (
    remove_column,
    double_column,
    swap_columns,
    odd_values,
    odd_values,
    odd_values,
    scaled_values,
    odd_times,
    odd_times,
    shuffled_rows,
    repeated_rows,
    lost_rows,
    ragged_rows,
)


# --------------------------------------------------------------------------------------------------
# Cases.
# --------------------------------------------------------------------------------------------------


def written(rng, folder):
    """Write a damaged log into a folder; return its path, and options of the reader."""
    name = pick(rng, [path.name for path in TABLES] if chance(rng, 0.6) else sorted(sound()))
    content, options = sound()[name], {}
    path = folder / name
    if name == MAPPED and chance(rng, 0.9):
        options["columns"] = folder / MAP.name
        shown = MAP.read_text(encoding="utf-8").partition("[attitude]")[0]  # the table has no more
        options["columns"].write_text(shown, encoding="utf-8")
    if name.endswith(".csv.gz") and chance(rng, 0.9):
        path = path.with_suffix("")
        with path.open("w", newline="", encoding="utf-8") as stream:
            damages = MILD if chance(rng, 0.75) else DAMAGES
            csv.writer(stream).writerows(damaged_table(rng, table(name), damages))
    elif name.endswith(".csv.gz") and chance(rng, 0.5):
        path = path.with_suffix("")
        path.write_bytes(damaged_bytes(rng, gzip.decompress(content)[:300_000]))
    elif isinstance(content, dict):
        path.mkdir()
        hurt = pick(rng, sorted(content))
        for file, data in content.items():
            (path / file).write_bytes(damaged_bytes(rng, data) if file == hurt else data)
    else:
        path.write_bytes(damaged_bytes(rng, content))
    return path, options


def starts(rng):
    """A start of the filter: none, a heading, or a place."""
    heading = float(rng.uniform(-math.pi, math.pi))
    some = ({}, {}, {"heading": heading}, {"course": True})
    return pick(rng, (*some, {"position": (0.0, 0.0, 0.0), "heading": heading}))


def run(rng):
    """Replay a damaged log twice."""
    folder = Path(tempfile.mkdtemp(prefix="quad_gym_soak_"))
    try:
        path, reading = written(rng, folder)
        options = {"estimator": pick(rng, ("ukf", "ukf", "ekf")), "start": starts(rng)}
        own = None if chance(rng, 0.7) else quad_gym.sensor_suite(pick(rng, ALL_SUITES))
        first, second = (outcome(path, reading, own, options) for _ in range(2))
        if isinstance(first, str):
            assert first == second, f"twice, the errors are {first!r} and {second!r}"
            return True
        check(first)
        assert_same(numbers(first), numbers(second), "the second time")
        return False
    finally:
        shutil.rmtree(folder)


def outcome(path, reading, suite, options):
    """The result of a replay, or the sentence with which it was refused."""
    try:
        log = read_log(path, **reading)
        return replay(log, sensors=suite or suite_for(log)[0], **options)
    except ValueError as error:
        check_error(error)
        return str(error)


def check_error(error):
    """Check that an error is ours, with a sentence, not one of a library that it has met."""
    assert len(str(error).split()) > 3, f"the error has no sentence: {error!r}"
    raised = traceback.extract_tb(error.__traceback__)[-1].filename
    assert "quad_gym" in Path(raised).parts, f"another library says: {error!r}"


def check(result):
    """Check that all estimates are finite, and that the verdict and the report have text."""
    for name, values in result.columns().items():
        assert np.isfinite(values).all(), f"{name} is not finite"
    assert result.verdict
    assert report_of(result)


def numbers(result):
    """Everything that a replay returns, for a comparison."""
    series = {
        name: [m.time, m.received, m.innovation, m.sigma, m.nis, m.gate]
        for name, m in result.measured.items()
    }
    return {**result.columns(), **series, "summary": repr(result.summary())}
