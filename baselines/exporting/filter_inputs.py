"""The measurements that an exported filter takes, as text of its C sources."""

from collections.abc import Iterable
from typing import NamedTuple

from quad_gym.params.sensors import SensorSuite
from quad_gym.records import (
    AID_BLOCKS,
    AID_FREEDOMS,
    BASELINE_BLOCK,
    FEATURE_BLOCKS,
    POSITION_BLOCK,
    VELOCITY_BLOCK,
    Aid,
)

LAST_RANK = 4
"""Rank of sensors that logs do not have."""
_AID_RANKS = {Aid.BAROMETER: 0, Aid.MAGNETOMETER: 3}
_AID_NOTES = {
    Aid.BAROMETER: "height in I from static pressure [m]",
    Aid.MAGNETOMETER: "magnetic field in B [T]",
    Aid.OPTICAL_FLOW: "optical flow [rad/s], see quad_gym.OpticalFlowParams",
    Aid.RANGE_FINDER: "range to the ground [m]",
}


class Function(NamedTuple):
    """A C function that updates with one measurement alone."""

    name: str
    arguments: str
    assignments: tuple[str, ...]
    note: str

    @property
    def _signature(self) -> str:
        return f"int qg_update_{self.name}(qg_filter *f, {self.arguments}, double time)"

    @property
    def declaration(self) -> str:
        """Text for the header."""
        return f"{self._signature}; /* {self.note} */\n"

    @property
    def definition(self) -> str:
        """Text for the implementation."""
        body = "".join(f"    m.{assignment};\n" for assignment in self.assignments)
        return (
            f"{self._signature}\n{{\n    qg_measurements m;\n    memset(&m, 0, sizeof m);\n"
            f"{body}    return qg_update(f, &m, time);\n}}\n"
        )


class Input(NamedTuple):
    """A sensor's part of the C sources."""

    rank: int
    """order of measurements that wait with equal time stamps, as in a replay"""
    measured: str
    """C expression: whether `m` has it"""
    macros: tuple[str, ...]
    fields: tuple[str, ...]
    """fields of `qg_measurements`"""
    take: str
    """code that checks `m` and fills the record `r`"""
    functions: tuple[Function, ...]


def inputs_of(suite: SensorSuite) -> list[Input]:
    """Return the inputs of a suite's filter, by rank."""
    found = [_aid(aid) for aid in suite.aids]
    if suite.camera is not None:
        found.append(_camera(len(suite.camera.features_I)))
    if suite.gnss is not None:
        found.append(_gnss(suite.gnss.has_baseline, suite.gnss.velocity_sigma is not None))
    return sorted(found, key=lambda given: given.rank)


def _code(lines: Iterable[str]) -> str:
    return "".join(f"    {line}\n" for line in lines)


def _aid(aid: Aid) -> Input:
    name, count, note = aid.name.lower(), AID_FREEDOMS[aid], _AID_NOTES[aid]
    alone = count == 1
    value = f"double {name}" if alone else f"const double {name}[{count}]"
    return Input(
        _AID_RANKS.get(aid, LAST_RANK),
        f"m->{name}",
        (f"#define QG_{aid.name} 1",),
        (f"const double *{name}; /* {count}: {note} */", f"double {name}_sigma;"),
        _code(
            (
                "if (!error)",
                f"    error = qgi_block(m->{name}, {count}, &r.valid[{AID_BLOCKS + aid}],",
                f"                      r.aid_measurement[{int(aid)}]);",
                f"if (!error && m->{name}_sigma != 0.0)",
                f"    error = qgi_noise(m->{name}, &m->{name}_sigma, 1, 1e-12,",
                f"                      &r.aid_sigma[{int(aid)}]);",
            )
        ),
        (Function(name, value, (f"{name} = {'&' * alone}{name}",), note),),
    )


def _camera(count: int) -> Input:
    note = "[QG_FEATURES][2] from the image's center; NaN: not seen"
    return Input(
        1,
        "m->pixels",
        (f"#define QG_FEATURES {count} /* features of the camera */",),
        (f"const double *pixels; /* {note} */", "double pixel_sigma; /* [pixels] */"),
        _code(
            (
                "for (int i = 0; !error && m->pixels && i < QG_FEATURES; i++) {",
                "    const double *pixel = m->pixels + 2 * i;",
                "    if (!isnan(pixel[0]) && !isnan(pixel[1]))",
                f"        error = qgi_block(pixel, 2, &r.valid[{FEATURE_BLOCKS} + i],",
                "                          r.pixels[i]);",
                "}",
                "if (!error && m->pixel_sigma != 0.0)",
                "    error = qgi_noise(m->pixels, &m->pixel_sigma, 1, 1e-12, &r.pixel_sigma);",
            )
        ),
        (Function("pixels", "const double *pixels", ("pixels = pixels",), note),),
    )


def _gnss(has_baseline: bool, has_velocity: bool) -> Input:
    fields = [
        "const double *gnss_position; /* primary antenna minus reference antenna, in G [m] */",
        "const double *gnss_sigma; /* 3 standard deviations of it: east, north, up [m] */",
    ]
    take = [
        "if (!error)",
        f"    error = qgi_block(m->gnss_position, 3, &r.valid[{POSITION_BLOCK}], r.gnss_position);",
        "if (!error && m->gnss_sigma)",
        "    error = qgi_noise(m->gnss_position, m->gnss_sigma, 3, 1e-9, r.position_sigma_I);",
    ]
    functions = [
        Function(
            "gnss_position",
            "const double position[3], const double *sigma",
            ("gnss_position = position", "gnss_sigma = sigma"),
            "in G [m]; sigma: 3, or NULL",
        )
    ]
    measured = ["m->gnss_position"]
    if has_baseline:
        measured.append("m->gnss_baseline")
        fields.append("const double *gnss_baseline; /* primary to secondary antenna, in G [m] */")
        fields.append("double baseline_sigma; /* of its direction [rad] */")
        take += [
            "if (!error && m->gnss_baseline) {",
            "    error = qgi_baseline(m->gnss_baseline, r.gnss_baseline);",
            f"    r.valid[{BASELINE_BLOCK}] = 1.0;",
            "}",
            "if (!error && m->baseline_sigma != 0.0) {",
            "    error = qgi_noise(m->gnss_baseline, &m->baseline_sigma, 1, 1e-12,",
            "                      &r.baseline_sigma);",
            "    if (r.baseline_sigma > 3.141592653589793)",
            "        r.baseline_sigma = 3.141592653589793;",
            "    r.baseline_noise = r.baseline_sigma;",
            "}",
        ]
        given = ("gnss_baseline = baseline",)
        functions.append(Function("gnss_baseline", "const double baseline[3]", given, "in G [m]"))
    if has_velocity:
        measured.append("m->gnss_velocity")
        fields.append("const double *gnss_velocity; /* of the primary antenna, in G [m/s] */")
        fields.append("double velocity_sigma; /* [m/s] */")
        take += [
            "if (!error)",
            f"    error = qgi_block(m->gnss_velocity, 3, &r.valid[{VELOCITY_BLOCK}],",
            "                      r.gnss_velocity);",
            "if (!error && m->velocity_sigma != 0.0)",
            "    error = qgi_noise(m->gnss_velocity, &m->velocity_sigma, 1, 1e-12,",
            "                      &r.velocity_sigma);",
        ]
        functions.append(
            Function(
                "gnss_velocity",
                "const double velocity[3], double sigma",
                ("gnss_velocity = velocity", "velocity_sigma = sigma"),
                "in G [m/s]; sigma: 0: the suite's",
            )
        )
    macros = ["#define QG_GNSS 1"]
    macros += ["#define QG_GNSS_BASELINE 1"] * has_baseline
    macros += ["#define QG_GNSS_VELOCITY 1"] * has_velocity
    together = " || ".join(measured)
    return Input(2, together, tuple(macros), tuple(fields), _code(take), tuple(functions))
