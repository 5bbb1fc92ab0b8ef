"""Reference pages, written from the code: environments, keywords, observations, suites, fields.

    python -m docs.extensions.environment_pages    # or make reference

They are committed in docs/reference, so that a repository's web page shows them; a test compares
them with the code. Tables of observations come from `observation_layout`. Tables of keywords come
from the fields of `TaskParams`, the signature of the environments and their docstrings. A keyword
or a part of an observation that is missing in the docstring is an error.
"""

import ast
import dataclasses
import inspect
import itertools
import pkgutil
import re
import sys
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import docstring_parser

import quad_gym
from docs.extensions import policy_cards
from docs.renewal.pages import TABLES
from quad_gym.batch.quantities import QUANTITIES
from quad_gym.envs.config import (
    BENCHMARKS,
    TASK_DEFAULTS,
    TASK_KEYWORDS,
)
from quad_gym.envs.spaces import ObservationField
from quad_gym.flights import COLUMNS
from quad_gym.logs.formats.log import LOG_COLUMNS, LogColumn
from quad_gym.params.sensor_table import SENSOR_PARAMS
from quad_gym.params.suites import ALL_SUITES
from quad_gym.params.task import FIELDS_WITHOUT_EFFECT, ONE_TASK_FIELDS
from quad_gym.records import DRAWABLES
from quad_gym.tasks.view import VIEW_FIELDS

if TYPE_CHECKING:
    from sphinx.application import Sphinx

DOCS = Path(__file__).parents[1]
FOLDER = DOCS / "reference"
GUIDE = DOCS / "environments.md"
"""A page with the table of the default observation, between two marks."""
_PIXELS = ("pixel_0_u", "pixel_0_v", "pixel_1_u", "...")
FILM = "<!-- film -->"
"""Line of an environment's page; the site shows a film there (`films`)."""


def _sections() -> dict[str, str]:
    """The sections of the specification, `QuadEnv`'s docstring, by their headings."""
    text = (inspect.getdoc(quad_gym.QuadEnv) or "").split("\nArgs:\n")[0]
    _, *parts = re.split(r"^## (.+)$", text, flags=re.MULTILINE)
    return dict(zip(parts[::2], (part.strip() for part in parts[1::2]), strict=True))


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"

    return "\n".join([line(head), line(["---"] * len(head)), *map(line, rows)]) + "\n"


def _attribute_docs(kind: type) -> dict[str, str]:
    """Docstrings below the fields of a class, in its own body."""
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    found = {}
    for part, after in itertools.pairwise(node.body):  # type: ignore[attr-defined]
        match part, after:
            case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                found[name] = " ".join(text.split())
    return found


def _field_docs(kind: type, more: Mapping[str, str] | None = None) -> dict[str, str]:
    """Docstrings below each field of a dataclass, inherited fields first; `more`: of others."""
    docs = dict(more or {})
    for part in filter(dataclasses.is_dataclass, reversed(kind.__mro__)):
        docs |= _attribute_docs(part)
    for field in dataclasses.fields(kind):
        if field.name not in docs:
            raise ValueError(f"{kind.__name__}.{field.name} has no docstring")
    return docs


def _digits(value: float) -> str:
    return f"{value:.10g}" if abs(value) >= 1e3 else f"{value:.4g}"


def _value(value: Any) -> str:
    """A default value as in code, rounded to few digits."""
    if isinstance(value, tuple) and all(isinstance(part, float) for part in value):
        return "`(" + ", ".join(map(_digits, value)) + ")`"
    if isinstance(value, float):
        return f"`{_digits(value)}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    if isinstance(value, quad_gym.RewardParams):
        return "`RewardParams()`"
    if isinstance(value, tuple) and value:
        kinds = ", ".join(f"`{type(part).__name__}`" for part in value)
        return f"{len(value)} points" if isinstance(value[0], tuple) else kinds
    return f"`{value!r}`"


def _observation_rows(
    table: Iterable[ObservationField], meanings: dict[str, str] | None = None
) -> list[tuple[str, ...]]:
    rows = []
    for field in table:
        said = () if meanings is None else (meanings[field.name],)
        where = f"{field.slice.start}:{field.slice.stop}"
        bounds = f"{field.low:g} to {field.high:g}"
        rows.append((where, f"`{field.name}`", *said, field.unit, field.frame, bounds))
    return rows


def _meanings(section: str) -> dict[str, str]:
    """The column "meaning" of the specification's table of an observation, by name."""
    rows = re.findall(r"^\| *(\d+:\d+) *\| *(\w+) *\|([^|]*)\|", section, flags=re.MULTILINE)
    for (where, name, _), field in zip(rows, quad_gym.observation_layout(), strict=True):
        if (where, name) != (f"{field.slice.start}:{field.slice.stop}", field.name):
            raise ValueError(f"the specification has {where} {name}, the code {field}")
    return {name: meaning.strip() for _, name, meaning in rows}


HEAD = ("slice", "name", "unit", "frame", "bounds")


def _observations_page() -> str:
    layouts = {
        'Relative, the default (`layout="relative"`)': {},
        'Absolute (`layout="absolute"`)': {"layout": "absolute"},
        'Raw measurements (`observation="measurements"`), two features': {
            "observation": "measurements"
        },
        "Relative, with the filter's standard deviations (`include_std=True`)": {
            "include_std": True
        },
        "Relative, with the truth for a critic (`privileged=True`)": {"privileged": True},
    }
    text = "# Observations\n\nTables of `quad_gym.observation_layout`. Frames: I inertial (east, "
    text += "north, up), B body, C image. Observations are clipped to their bounds.\n"
    for title, options in layouts.items():
        rows = _observation_rows(quad_gym.observation_layout(**options))
        text += f"\n## {title}\n\n{_table(HEAD, rows)}"
    return text


def _keywords_page() -> str:
    """Keywords of all environments, from their signature and the specification."""
    parsed = docstring_parser.parse(
        inspect.getdoc(quad_gym.QuadEnv) or "", docstring_parser.DocstringStyle.GOOGLE
    )
    said = {p.arg_name: " ".join((p.description or "").split()) for p in parsed.params}
    said |= {
        "threads": "Threads of a vector environment; None: as many as there are cores.",
        "render_flights": "Which flights of a vector environment are rendered.",
    }
    shown = inspect.signature(quad_gym.QuadEnv).parameters.values()
    defaults = {p.name: p.default for p in shown if p.name not in ("task", "base", *TASK_KEYWORDS)}
    defaults = {"task": None, **defaults, "threads": None, "render_flights": None}
    missing = sorted(set(defaults) - set(said))
    if missing:
        raise ValueError(f"the specification says nothing of {', '.join(missing)}")
    every = "".join(_keyword(name, _value(value), said[name]) for name, value in defaults.items())
    common, docs = quad_gym.TaskParams(), _field_docs(quad_gym.TaskParams)
    of_tasks = "".join(
        _keyword(name, _value(getattr(common, name)), f"{docs[name]}{_only(name)}")
        for name in TASK_KEYWORDS
    )
    return (
        "# Keywords\n\nOf `gymnasium.make`, `gymnasium.make_vec` and "
        "`quad_gym.make_sb3_vec_env`, with their defaults.\n\n## Every environment\n\n"
        f"{every}\n## Tasks\n\nFields of `quad_gym.TaskParams`. The page of an "
        "[environment](environments/index.md) lists the defaults in which it differs.\n\n"
        f"{of_tasks}{_vehicles()}"
    )


def _only(keyword: str) -> str:
    """A sentence on the tasks that accept a keyword, if not all do."""
    if keyword in ONE_TASK_FIELDS:
        return f". Only with `{ONE_TASK_FIELDS[keyword]}`"
    without = [kind for kind, keywords in FIELDS_WITHOUT_EFFECT.items() if keyword in keywords]
    return f". Not with {', '.join(f'`{kind}`' for kind in without)}" if without else ""


def _vehicles() -> str:
    """The numbers of the included vehicles side by side."""
    vehicles = {name: quad_gym.vehicle_params(name) for name in ("lab", "crazyflie")}
    rows = []
    for name, said in _field_docs(quad_gym.VehicleParams).items():
        numbers = (getattr(vehicle, name) for vehicle in vehicles.values())
        cells = (
            ", ".join(map(_value, n))
            if isinstance(n, tuple) and isinstance(n[0], tuple)
            else _value(n)
            for n in numbers
        )
        rows.append((f"`{name}`", *cells, said.split("; ")[0]))
    text = "\n## `vehicle`: VehicleParams\n\nThe included vehicles; the default is `lab`.\n\n"
    return text + _table(("field", *vehicles, "meaning"), rows)


def _task_sections(task: type[quad_gym.Task]) -> dict[str, str]:
    """Sections of a task's docstring by heading; "About" is the text before the first one."""
    text = inspect.getdoc(task) or ""
    parts = re.split(r"^## (.+)$", text.split("\nArgs:")[0], flags=re.MULTILINE)
    about = "\n".join(parts[0].splitlines()[1:]).strip()
    return {"About": about} | {
        heading: body.strip() for heading, body in zip(parts[1::2], parts[2::2], strict=True)
    }


SHARED_PAGES = ("keywords", "observations", "specification", "drawable")
SHARED = ("Observation space", "Action space", "Reward", "Episode end", "Start", "Info", "World")


def _specification_page(sections: dict[str, str]) -> str:
    """Sections of the specification that all environments share."""
    text = "# Specification of the environments\n\nThe text of `help(quad_gym.QuadEnv)`. "
    text += "[Keywords](keywords.md) have their own page, and so has each "
    text += "[environment](environments/index.md), with the parts that differ.\n"
    return text + "".join(f"\n## {name}\n\n{sections[name]}\n" for name in SHARED)


def _environment_page(env_id: str, sections: dict[str, str], docs: dict[str, str]) -> str:
    kind = quad_gym.IDS[env_id]
    name = env_id.split("/")[1].removesuffix("-v0")
    row = re.search(rf"^\| `{re.escape(env_id)}` \|(.+)\|$", sections["Description"], re.MULTILINE)
    if row is None:
        raise ValueError(f"the table of environments lacks {env_id}")
    reference, start, limit = (cell.strip() for cell in row[1].split("|"))
    own = BENCHMARKS.get(kind)
    defaults = TASK_DEFAULTS[kind] if own is None else own.task
    task = None if own is None else pkgutil.resolve_name(own.keywords["task"])
    spec = {} if task is None else _task_sections(task)
    settings = {} if own is None else dict(own.keywords)
    common = quad_gym.TaskParams()
    accepted = [key for key in TASK_KEYWORDS if _has_effect(key, defaults.kind)]
    if own is not None:
        accepted.remove("reward_params")  # its reward has no such weights
    differ = [
        _keyword(key, _value(getattr(defaults, key)), docs[key].partition(". ")[0])
        for key in accepted
        if getattr(defaults, key) != getattr(common, key)
    ]
    every = "a keyword of every environment"
    differ += [_keyword(key, _value(value), every) for key, value in settings.items()]
    others = ", ".join(f"`{key}`" for key in accepted)
    headings = () if task is None else ("Observation", "Reward", "Endings")
    different = "".join(f"## {heading}\n\n{spec[heading]}\n\n" for heading in headings)
    return "\n".join(
        [
            f"# {name}\n\n`{env_id}`\n",
            f"{spec['About']}\n" if spec else "",
            f"- **Reference**: {reference}\n- **Start**: {start}\n- **Time limit**: {limit}\n",
            "```python\nimport gymnasium\n\nimport quad_gym\n\n"
            f'env = gymnasium.make("{env_id}")\n```\n',
            f"{FILM}\n",
            f"{different}Unless stated here, observation, action, reward, start, endings and "
            "`info` follow the [specification](../specification.md) of all environments. "
            "[Your own task](../../tasks.md) changes them.\n",
            "## Keywords\n",
            "These defaults differ from the [common ones](../keywords.md):\n"
            if differ
            else "All defaults are the [common ones](../keywords.md).\n",
            "".join(differ),
            f"The keywords of a task that this environment accepts are {others}.\n",
        ]
    )


def _has_effect(keyword: str, kind: str) -> bool:
    """Return True if a kind of task accepts a keyword."""
    without = FIELDS_WITHOUT_EFFECT.get(kind, ())
    return ONE_TASK_FIELDS.get(keyword, kind) == kind and keyword not in without


def _keyword(name: str, default: str, meaning: str) -> str:
    """An item of a list of keywords, with the meaning, without its source, under the keyword."""
    meaning = re.sub(r" \(report section \d+(\.\d+)*\)|; report section \d+(\.\d+)*", "", meaning)
    meaning = re.sub(r"^\(\d+,( \d+)?\) ", "", meaning)  # the shape, which the default shows
    return f"- `{name}` = {default}\\\n  {meaning[:1].upper()}{meaning[1:]}\n"


def _index_page() -> str:
    """The list of all environments, with the pages that they share."""
    ids = "".join(
        f"| [{env_id.split('/')[1].removesuffix('-v0')}]({kind}.md) | `{env_id}` |\n"
        for env_id, kind in quad_gym.IDS.items()
    )
    pages = "\n".join([*quad_gym.IDS.values(), *(f"../{name}" for name in SHARED_PAGES)])
    return (
        "# Environments by id\n\nEach page has the reference, start and time limit of an "
        "environment, and what differs from the specification that they share.\n\n"
        f"| page | id |\n| --- | --- |\n{ids}\n"
        "They share their [keywords](../keywords.md), [observations](../observations.md), "
        "[specification](../specification.md) and [parameters that can be "
        f"randomized](../drawable.md).\n\n```{{toctree}}\n:hidden:\n\n{pages}\n```\n"
    )


def _suites_page() -> str:
    """The numbers of every suite side by side."""
    suites = {name: quad_gym.sensor_suite(name) for name in ALL_SUITES}
    text = "# Sensor suite parameters\n\nThe fields of `quad_gym.SensorSuite`. Their meaning is "
    text += "under [Parameters](../api/parameters.md), their sources are beside the numbers in "
    text += "`quad_gym/params/`.\n"
    text += "A table has the suites that differ, or have the sensor at all.\n"
    for part, kind in {
        "imu": quad_gym.ImuParams,
        **SENSOR_PARAMS,
        "initial_pose": quad_gym.InitialPoseParams,
        "estimator": quad_gym.FilterParams,
        "noisy": quad_gym.NoisyObservationParams,
        "log_delays": quad_gym.LogDelays,
    }.items():
        having = {name: suite for name, suite in suites.items() if getattr(suite, part) is not None}
        rows, same = [], []
        of_aids = dict.fromkeys(SENSOR_PARAMS, "[s]") if kind is quad_gym.LogDelays else {}
        said = _field_docs(kind, of_aids)
        for name in (field.name for field in dataclasses.fields(kind)):
            values = [_value(getattr(getattr(suite, part), name)) for suite in having.values()]
            unit = re.search(r"\[[^]\d][^]]*\]", said[name])  # not a range, such as [0, 1)
            row = (f"`{name}`" + (f" {unit[0]}" if unit else ""), *values)
            if len(set(values)) == 1:
                same.append(row[:2])
            else:
                rows.append(row)
        text += f"\n## `{part}`: {kind.__name__}\n\n"
        text += _columns(tuple(having), rows) if rows else ""
        if same:
            who = "all suites" if len(having) == len(suites) else ", ".join(having)
            text += f"\n{_table(('', who), same)}"
    return text


def _columns(names: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    """Table in which names with equal values share a column."""
    shared: dict[tuple[str, ...], list[str]] = {}
    for name, column in zip(names, list(zip(*rows, strict=True))[1:], strict=True):
        shared.setdefault(column, []).append(name)
    cells = zip(*shared, strict=True)
    heads = ("", *(", ".join(each) for each in shared.values()))
    return _table(heads, [(row[0], *values) for row, values in zip(rows, cells, strict=True)])


def _fields_page() -> str:
    """Columns of a recorded flight, quantities of a batch, and fields of a view."""

    def row(name: str, shape: Any, about: Any) -> tuple[str, ...]:
        if not isinstance(shape, str):
            shape = f"({', '.join(map(str, shape))})"
        return f"`{name}`", shape, about.unit, about.frame, about.meaning

    fields = [row(name, quantity.shape, quantity) for name, quantity in QUANTITIES.items()]
    view = [row(field.name, field.shape, field) for field in VIEW_FIELDS]
    columns = [row(column.name, column.shape, column) for column in COLUMNS]
    return (
        "# Fields of flights\n\n## Columns of a recorded flight\n\nColumns of `quad_gym.Flight`, "
        "with a row for each control step. Markers, anchors, rotors, motors and actions are "
        "counted from 0, in arrays and in names such as `uwb_range_0` of logs, tables and "
        "observations. Gates are counted from 1, in the order in which they are passed.\n\n"
        + _table(("column", "shape of a row", "unit", "frame", "meaning"), columns)
        + "\n## Quantities of a batch of flights\n\nNames of `FlightBatch.read`, with the flights "
        "as first axis.\n\n"
        + _table(("name", "shape", "unit", "frame", "meaning"), fields)
        + "\n## Fields of a view\n\nFields of the `view` that the methods of a `quad_gym.Task` "
        "read. In the shapes, n is the number of flights, m of features (markers), o of "
        "obstacles, and k of values in an observation. Frames: I inertial (east, north, up), B "
        "body, C image.\n\n" + _table(("field", "shape", "unit", "frame", "meaning"), view)
    )


def _log_page() -> str:
    """Columns of a log in a table."""
    columns = {**LOG_COLUMNS, "pixels": LogColumn(_PIXELS, "pixels", "C", "of each feature")}
    rows = [
        (f"`{key}`", ", ".join(f"`{name}`" for name in c.names), c.unit, c.frame, c.meaning)
        for key, c in columns.items()
    ]
    return (
        "# Columns of a log\n\n[`quad-gym replay`](../log-formats.md#tables) reads these columns "
        "of a table. A dictionary may have the columns of a quantity together, by the name at the "
        "left. "
        "Reported standard deviations replace the suite's, and a value of motors holds until "
        "the next row with one. Frames: I east, north, up; B body (forward, left, up); C image, "
        "from its center.\n\n" + _table(("together", "columns", "unit", "frame", "meaning"), rows)
    )


def _drawable_page() -> str:
    """Parameters that can be drawn for each episode."""
    rows = [
        (f"`{d.name}`", str(d.size) if d.size < 16 else "3 per feature", d.unit, d.meaning)
        for d in DRAWABLES
    ]
    return (
        "# Parameters that can be randomized\n\nNames for `randomization=`, the domain "
        "randomization of every environment "
        "([examples](../configure.md#domain-randomization-sim-to-real)).\n\n"
        + _table(("parameter", "values", "unit", "meaning"), rows)
    )


def observation_table() -> str:
    """The default observation, with meanings."""
    rows = _observation_rows(
        quad_gym.observation_layout(), _meanings(_sections()["Observation space"])
    )
    return _table(("slice", "name", "meaning", "unit", "frame", "bounds"), rows)


def pages() -> dict[Path, str]:
    """The texts of all pages, by file, and of the guide."""
    sections, docs = _sections(), _field_docs(quad_gym.TaskParams)
    found = (
        {"environments/index": _index_page()}
        | {
            f"environments/{kind}": _environment_page(env_id, sections, docs)
            for env_id, kind in quad_gym.IDS.items()
        }
        | {
            "specification": _specification_page(sections),
            "observations": _observations_page(),
            "keywords": _keywords_page(),
            "drawable": _drawable_page(),
            "suites": _suites_page(),
            "fields": _fields_page(),
            "log-columns": _log_page(),
            "policies": policy_cards.page(),
        }
    )
    guide = re.sub(
        r"(<!-- observation -->\n).*?(<!-- /observation -->)",
        lambda marks: marks[1] + observation_table() + marks[2],
        GUIDE.read_text(encoding="utf-8"),
        flags=re.DOTALL,
    )
    return {FOLDER / f"{name}.md": text for name, text in found.items()} | {GUIDE: guide}


def write_pages(app: "Sphinx | None" = None) -> list[Path]:
    """Write the pages that differ from the code, and remove others; return those that changed."""
    texts = pages()
    changed = [
        file
        for file, text in texts.items()
        if not file.exists() or file.read_text(encoding="utf-8") != text
    ]
    for file in changed:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(texts[file], encoding="utf-8")
    for file in set(FOLDER.rglob("*.md")) - {*texts, TABLES}:
        file.unlink()
    return changed


def setup(app: "Sphinx") -> dict[str, Any]:
    """Write the pages when a build of the site begins."""
    app.connect("builder-inited", write_pages, priority=100)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


if __name__ == "__main__":
    sys.stdout.writelines(f"{file.relative_to(DOCS.parent)}\n" for file in write_pages())
