"""Defaults of logs: suites by their sensors, headings from north, and files of others."""

import numpy as np
import pytest

from quad_gym.estimation import read_log, replay
from quad_gym.logs.calibrating.search import NUMBERS
from quad_gym.logs.replaying.replay import suite_for
from tests import foreign_logs
from tests.console_commands import refused, run


@pytest.fixture(scope="module")
def table():
    return foreign_logs.flight(8.0).table()


def written(table, path):
    columns = {}
    for name, values in table.items():
        axes = ("east", "north", "up") if name.endswith("_enu") else "xyz"
        stem = name.removesuffix("_enu")
        wide = values.reshape(len(values), -1).T
        names = [stem] if len(wide) == 1 else [f"{stem}_{axis}" for axis in axes]
        columns |= dict(zip(names, wide, strict=True))
    lines = [
        ",".join(columns),
        *(
            ",".join(map(repr, row))
            for row in zip(*(c.tolist() for c in columns.values()), strict=True)
        ),
    ]
    path.write_text("\n".join(lines).replace("nan", ""))
    return path


def test_suite_by_default_uses_the_sensors_of_the_log(table, tmp_path):
    ended = run("replay", written(table, tmp_path / "a.csv"), "--output", tmp_path / "a")
    assert ended.stdout.startswith("Suite: field, as the log has a receiver, a barometer and a")
    assert "Ignored" not in ended.stdout
    assert ended.returncode == 0


@pytest.mark.parametrize(
    ("columns", "suite"),
    [
        ({"gnss_baseline_enu": 3}, "rtk"),
        ({"attitude": 4}, "mocap"),
        ({"uwb_range": 4, "gnss_enu": 0}, "uwb"),
        ({"optical_flow": 2, "range_finder": 1, "gnss_enu": 0}, "crazyflie"),
    ],
)
def test_suites_of_other_sensors(table, columns, suite):
    some = {k: v for k, v in table.items() if columns.get(k) != 0}
    if "gnss_enu" not in some:
        some.pop("gnss_velocity_enu")
    rng = np.random.default_rng(0)
    for name, width in columns.items():
        if width:
            some[name] = np.squeeze(rng.normal(2.0, 0.1, (len(table["time"]), width)))
    assert suite_for(read_log(some))[0] == suite


def test_heading_from_north_is_the_heading_of_a_compass(table, tmp_path):
    """East is 90 degrees from north, and 0 from east."""
    log = written({k: v for k, v in table.items() if k != "magnetometer"}, tmp_path / "a.csv")
    words = [log, "--no-figure", "--overwrite"]
    estimates = []
    north = "--heading-from-north"
    for options in (["--heading", "17"], [north, "73"], [north, "-287"]):
        run("replay", *words, *options, "--output", tmp_path / "out")
        estimates.append((tmp_path / "out" / "estimates.csv").read_text())
    assert len(set(estimates)) == 1


@pytest.mark.parametrize("option", ["--heading", "--heading-from-north"])
@pytest.mark.parametrize(
    ("value", "message"), [("720", "at most 360, got 720"), ("nan", "finite"), ("-361", "at least")]
)
def test_heading_beyond_a_turn_is_refused_in_degrees(option, value, message, tmp_path, capsys):
    assert f"{option} must be {message}" in refused(f"replay a.csv {option} {value}", capsys)
    if option == "--heading":
        words = f"calibrate a.csv --output {tmp_path} {option} {value}"
        assert f"{option} must be {message}" in refused(words, capsys)


def test_two_headings_are_refused_with_both_conventions(tmp_path, capsys):
    words = f"replay {tmp_path}/a.csv --heading 1 --heading-from-north 2"
    message = refused(words, capsys)
    assert "from east toward north" in message
    assert "from north toward east" in " ".join(message.split())


@pytest.mark.parametrize(
    ("name", "tool"),
    [
        ("a.bbl", "blackbox_decode"),
        ("a.px4log", "sdlog2_dump.py"),
        ("FlightRecord.txt", "DatCon"),
        ("a.tlog", "mavlogdump.py"),
    ],
)
def test_files_of_others_are_refused_with_the_way_to_convert_them(name, tool, tmp_path):
    (tmp_path / name).write_bytes(b"H Product:Blackbox\n\xff\xfe\x00")
    with pytest.raises(ValueError, match=tool):
        replay(tmp_path / name, sensors="field")


def test_bias_of_the_accelerometer_has_a_narrow_prior_up_to_data_sheets():
    (number,) = (n for n in NUMBERS if n.name == "imu.accel_bias_sigma")
    for prior, most in ((0.02, 0.2), (0.2, 0.5), (0.4, 0.5)):
        assert number.value(prior, number.ends(prior)[1]) <= most + 1e-9
