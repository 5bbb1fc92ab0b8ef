"""Pages on environments and sensor suites, written from the code before Sphinx reads its sources.

Tables of observations come from `observation_layout`, those of keywords from the fields of
`TaskParams` and the signature behind the environments, their words from docstrings. What is said of
a keyword or of a part of an observation that the code has and the docstring lacks is an error.
"""

import dataclasses
import importlib
import inspect
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import docstring_parser
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.pycode import ModuleAnalyzer

import quad_gym
from extensions.films import film_of
from quad_gym.envs.benchmarks import BENCHMARKS
from quad_gym.envs.configuration import (
    KEYWORDS_WITHOUT_EFFECT,
    ONE_TASK_KEYWORDS,
    TASK_DEFAULTS,
    TASK_KEYWORDS,
    Flights,
)
from quad_gym.envs.rendered import rendering_of
from quad_gym.envs.spaces import ObservationField
from quad_gym.flights.record import COLUMNS, FEATURES
from quad_gym.params.suites import ALL_SUITES
from quad_gym.records import FLIGHT_FIELDS
from quad_gym.tasks.fields import VIEW_FIELDS

FOLDER = "generated"
"""Where the pages go, inside the sources of the site; Git ignores it."""


def _sections() -> dict[str, str]:
    """The sections of the specification, `QuadEnv`'s docstring, by their headings."""
    text = (inspect.getdoc(quad_gym.QuadEnv) or "").split("\nArgs:\n")[0]
    _, *parts = re.split(r"^## (.+)$", text, flags=re.MULTILINE)
    return dict(zip(parts[::2], (part.strip() for part in parts[1::2]), strict=True))


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"

    return "\n".join([line(head), line(["---"] * len(head)), *map(line, rows)]) + "\n"


def _field_docs(kind: type) -> dict[str, str]:
    """What is said below each field of a dataclass, inherited fields first."""
    docs = {}
    for part in filter(dataclasses.is_dataclass, reversed(kind.__mro__)):
        found = ModuleAnalyzer.for_module(part.__module__).find_attr_docs()
        docs |= {
            name: " ".join(lines).strip()
            for (of, name), lines in found.items()
            if of == part.__name__
        }
    for field in dataclasses.fields(kind):
        if field.name not in docs:
            raise ExtensionError(f"{kind.__name__}.{field.name} has no docstring")
    return docs


def _digits(value: float) -> str:
    return f"{value:.10g}" if abs(value) >= 1e3 else f"{value:.4g}"


def _value(value: Any) -> str:
    """A default value as it would be typed, in few digits."""
    if isinstance(value, tuple) and all(isinstance(part, float) for part in value):
        return "`(" + ", ".join(map(_digits, value)) + ")`"
    if isinstance(value, float):
        return f"`{_digits(value)}`"
    if isinstance(value, str):
        return f'`"{value}"`'
    if isinstance(value, tuple) and value:
        return f"{len(value)} of them"
    return f"`{value!r}`"


def _range(field: ObservationField) -> str:
    return f"{field.low:g} to {field.high:g}"


def _observation_rows(
    table: Iterable[ObservationField], meanings: dict[str, str] | None = None
) -> list[tuple[str, ...]]:
    rows = []
    for field in table:
        said = () if meanings is None else (meanings[field.name],)
        where = f"{field.slice.start}:{field.slice.stop}"
        rows.append((where, f"`{field.name}`", *said, field.unit, field.frame, _range(field)))
    return rows


def _meanings(section: str) -> dict[str, str]:
    """The column "meaning" of the specification's table of an observation, by name."""
    rows = re.findall(r"^\| *(\d+:\d+) *\| *(\w+) *\|([^|]*)\|", section, flags=re.MULTILINE)
    for (where, name, _), field in zip(rows, quad_gym.observation_layout(), strict=True):
        if (where, name) != (f"{field.slice.start}:{field.slice.stop}", field.name):
            raise ExtensionError(f"the specification has {where} {name}, the code {field}")
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
    text = "# Observations\n\nWhat `quad_gym.observation_layout` says of the observations. I: "
    text += "inertial (east, north, up), B: body, C: image. Observations are held within their "
    text += "bounds.\n"
    for title, options in layouts.items():
        rows = _observation_rows(quad_gym.observation_layout(**options))
        text += f"\n## {title}\n\n{_table(HEAD, rows)}"
    return text


def _keywords_page() -> str:
    """Keywords of all environments, from the signature behind them and the specification."""
    parsed = docstring_parser.parse(
        inspect.getdoc(quad_gym.QuadEnv) or "", docstring_parser.DocstringStyle.GOOGLE
    )
    said = {p.arg_name: " ".join((p.description or "").split()) for p in parsed.params}
    said |= {
        "threads": "Threads of a vector environment; None: as many as there are cores.",
        "render_flights": "Which flights of a vector environment are rendered.",
    }
    parameters = inspect.signature(Flights._build).parameters.values()
    defaults = {
        p.name: p.default
        for p in parameters
        if p.kind is p.KEYWORD_ONLY and p.default is not p.empty
    }
    looks = inspect.signature(rendering_of).parameters
    defaults |= {"max_episode_steps": None, "render_mode": None}
    defaults |= {
        name: looks[name].default
        for name in looks
        if name.startswith("render_") and name != "render_mode"
    }
    missing = sorted(set(defaults) - set(said))
    if missing:
        raise ExtensionError(f"the specification says nothing of {', '.join(missing)}")
    rows = [(f"`{name}`", _value(value), said[name]) for name, value in defaults.items()]
    return (
        "# Keywords of every environment\n\nOf `gymnasium.make`, `gymnasium.make_vec` and "
        "`quad_gym.make_sb3_vec_env`, besides those of the task, which the page of each "
        "environment lists.\n\n" + _table(("keyword", "default", "meaning"), rows)
    )


def _task_class(name: str) -> type[quad_gym.Task]:
    module, attribute = name.split(":")
    found: type[quad_gym.Task] = getattr(importlib.import_module(module), attribute)
    return found


def _task_sections(task: type[quad_gym.Task]) -> dict[str, str]:
    """What the docstring of a task says, by its headings; "About" is what stands before them."""
    text = inspect.getdoc(task) or ""
    parts = re.split(r"^## (.+)$", text.split("\nArgs:")[0], flags=re.MULTILINE)
    about = "\n".join(parts[0].splitlines()[1:]).strip()
    return {"About": about} | {
        heading: body.strip() for heading, body in zip(parts[1::2], parts[2::2], strict=True)
    }


def _environment_page(env_id: str, sections: dict[str, str], docs: dict[str, str]) -> str:
    kind = quad_gym.IDS[env_id]
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", env_id.split("/")[1].removesuffix("-v0"))
    row = re.search(rf"^\| `{re.escape(env_id)}` \|(.+)\|$", sections["Description"], re.MULTILINE)
    if row is None:
        raise ExtensionError(f"the table of environments lacks {env_id}")
    reference, start, limit = (cell.strip() for cell in row[1].split("|"))
    own = BENCHMARKS.get(kind)
    defaults = TASK_DEFAULTS[kind] if own is None else own.task
    task = None if own is None else _task_class(own.keywords["task"])
    spec = sections if task is None else sections | _task_sections(task)
    settings = {} if own is None else dict(own.keywords)
    rows = [
        (f"`{key}`", _value(getattr(defaults, key)), docs[key])
        for key in TASK_KEYWORDS
        if ONE_TASK_KEYWORDS.get(key, defaults.kind) == defaults.kind
        and key not in KEYWORDS_WITHOUT_EFFECT.get(defaults.kind, ())
    ]
    rows += [
        (f"`{key}`", _value(value), "a keyword of every environment")
        for key, value in settings.items()
    ]
    rows_seen = _observation_rows(
        quad_gym.observation_layout(), _meanings(sections["Observation space"])
    )
    built_in = _table(("slice", "name", "meaning", "unit", "frame", "bounds"), rows_seen)
    seen = spec["Observation"] if task is not None else ""
    # a task's own observation takes the place of the built-in one, or follows it
    observation = seen if task is not None and task.replaces_observation else built_in + "\n" + seen
    shared = "Start and `info`" if own else "Reward, start, endings and `info`"
    parts = [
        f"# {name}\n\n`{env_id}`\n",
        f"{spec['About']}\n" if own else "",
        f"- **Reference**: {reference}\n- **Start**: {start}\n- **Time limit**: {limit}\n",
        "```python\nimport gymnasium\n\nimport quad_gym\n\n"
        f'env = gymnasium.make("{env_id}")\n```\n',
        film_of(env_id),
        f"{shared} below are from the specification that all environments share, "
        "`help(quad_gym.QuadEnv)`.\n",
        f"## Observation\n\n{observation}\n",
        "The other layouts are under [Observations](../observations.md).\n",
        f"## Action\n\n{sections['Action space']}\n",
        f"## Keywords of the task\n\n{_table(('keyword', 'default here', 'meaning'), rows)}",
        "All others are under [Keywords of every environment](../keywords.md).\n",
        f"## Reward\n\n{spec['Reward']}\n",
        f"## Start\n\n{sections['Start']}\n",
        f"## Endings\n\n{sections['Episode end']}\n\n{spec['Endings'] if own else ''}\n",
        f"## Info\n\n{sections['Info']}\n",
    ]
    return "\n".join(parts)


def _suites_page() -> str:
    """The numbers of every suite side by side."""
    suites = {name: quad_gym.sensor_suite(name) for name in ALL_SUITES}
    text = "# Sensor suites in numbers\n\nThe fields of `quad_gym.SensorSuite`. Their meaning is "
    text += "under [Parameters](../api/parameters.md), their sources are beside the numbers in "
    text += "`quad_gym/params/`.\n"
    for part, kind in {
        "imu": quad_gym.ImuParams,
        "gnss": quad_gym.GnssParams,
        "camera": quad_gym.CameraParams,
        "barometer": quad_gym.BarometerParams,
        "magnetometer": quad_gym.MagnetometerParams,
        "initial_pose": quad_gym.InitialPoseParams,
        "estimator": quad_gym.FilterParams,
        "noisy": quad_gym.NoisyObservationParams,
    }.items():
        rows = []
        said = _field_docs(kind)
        for name in (field.name for field in dataclasses.fields(kind)):
            of = (getattr(suite, part) for suite in suites.values())
            values = ["-" if p is None else _value(getattr(p, name)) for p in of]
            unit = re.search(r"\[[^]\d][^]]*\]", said[name])  # no range, such as [0, 1)
            rows.append((f"`{name}`" + (f" {unit[0]}" if unit else ""), *values))
        text += f"\n## `{part}`: {kind.__name__}\n\n{_table(('', *suites), rows)}"
    return text


def _fields_page() -> str:
    """What a flight's record and a recorded flight hold."""
    fields = [(f"`{f.name}`", str(f.shape), f.unit, f.meaning) for f in FLIGHT_FIELDS]
    view = [(f"`{f.name}`", f.shape, f.unit, f.frame, f.meaning) for f in VIEW_FIELDS]
    columns = [
        (
            f"`{c.name}`",
            "(" + ", ".join("features" if n == FEATURES else str(n) for n in c.shape) + ")",
            c.unit,
            c.frame,
            c.meaning,
        )
        for c in COLUMNS
    ]
    return (
        "# Fields of flights\n\n## Columns of a recorded flight\n\nWhat `quad_gym.Flight` holds, "
        "a row for each control step.\n\n"
        + _table(("column", "shape of a row", "unit", "frame", "meaning"), columns)
        + "\n## Fields of a flight's record\n\nWhat `FlightBatch.read` returns by name, with the "
        "flights as a first axis.\n\n"
        + _table(("field", "shape", "unit", "meaning"), fields)
        + "\n## Fields of a view\n\nWhat the methods of a `quad_gym.Task` read.\n\n"
        + _table(("field", "shape", "unit", "frame", "meaning"), view)
    )


def pages() -> dict[str, str]:
    """All pages by their names."""
    sections, docs = _sections(), _field_docs(quad_gym.TaskParams)
    found = {
        f"environments/{kind}": _environment_page(env_id, sections, docs)
        for env_id, kind in quad_gym.IDS.items()
    }
    return found | {
        "observations": _observations_page(),
        "keywords": _keywords_page(),
        "suites": _suites_page(),
        "fields": _fields_page(),
    }


def write_pages(app: Sphinx) -> None:
    """Write the pages that are not there as they should be, and remove others."""
    folder = Path(app.srcdir) / FOLDER
    (folder / "environments").mkdir(parents=True, exist_ok=True)
    wanted = {folder / f"{name}.md": text for name, text in pages().items()}
    for file in set(folder.rglob("*.md")) - set(wanted):
        file.unlink()
    for file, text in wanted.items():
        if not file.exists() or file.read_text(encoding="utf-8") != text:
            file.write_text(text, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, Any]:
    """Write the pages when a build begins."""
    app.connect("builder-inited", write_pages, priority=100)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
