"""Sensor suites, vehicles and worlds as TOML files.

In a file of a suite, a table for each sensor has the fields of its parameters by name::

    base = "consumer"  # optional: the file changes this suite
    camera = "none"    # no camera; "none" stands for None

    [gnss]
    primary_antenna_B = [0.0, 0.0, 0.12]

Units are SI, angles in rad. Without `base` all tables are required; fields that a table leaves out
have the defaults of its class, which are the laboratory's. Files of a vehicle and of a world have
the fields of `VehicleParams` and `WorldParams`, all of them without `base`.
"""

import dataclasses
import json
import tomllib
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from quad_gym.params import checks as check

SUFFIX = ".toml"  #: ending of the names of such files

_NONE = "none"
_HEADS = {"SensorSuite": "Sensor suite", "VehicleParams": "Vehicle", "WorldParams": "World"}


def is_params_file(name: Any) -> bool:
    """True for the name of a file of a suite, vehicle or world."""
    return isinstance(name, str | Path) and Path(name).suffix == SUFFIX


class Saved:
    """Parameters that can be written to a file."""

    def save(self, file: str | Path) -> Path:
        """Write the parameters to a file, to edit, and to use in place of a preset's name.

        Args:
            file: A path that ends with ".toml"; replaced if it exists.

        Returns:
            The path.

        Raises:
            ValueError: If the path ends otherwise, or the parameters have obstacles.
            OSError: If it cannot be written.
        """
        path = Path(file)
        if path.suffix != SUFFIX:
            raise ValueError(f"file must end with {SUFFIX}, got {str(file)!r}")
        if getattr(self, "obstacles", ()):
            raise ValueError("a world with obstacles cannot be saved: make it in Python")
        head = f"# {_HEADS[type(self).__name__]} of quad_gym; units are SI, angles in rad.\n\n"
        path.write_text(head + text_of(self), encoding="utf-8")
        return path


def text_of(suite: Any) -> str:
    """Parameters as TOML, exactly: floating-point numbers have all their digits."""
    values = {field.name: getattr(suite, field.name) for field in dataclasses.fields(suite)}
    tables = {name: v for name, v in values.items() if dataclasses.is_dataclass(v)}
    parts = [_lines({name: v for name, v in values.items() if name not in tables})]
    for name, table in tables.items():
        fields = {field.name: getattr(table, field.name) for field in dataclasses.fields(table)}
        parts.append(f"[{name}]\n{_lines(fields)}")
    return "\n".join(part for part in parts if part)


def read_params(file: Path, kind: type, base_of: Callable[[Any], Any]) -> Any:
    """The suite, vehicle or world in a file.

    Args:
        file: A path.
        kind: `SensorSuite`, `VehicleParams` or `WorldParams`.
        base_of: From the value of `base` to an instance.

    Raises:
        ValueError: If the file is no TOML, or a name or value in it is invalid.
        OSError: If it cannot be read.
    """
    try:
        given = tomllib.loads(file.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{file} must be a file of TOML: {error}") from None
    try:
        base = base_of(given.pop("base")) if "base" in given else None
        for field in dataclasses.fields(kind):
            if base is None and field.default is not None and field.name not in given:
                number = isinstance(field.default, float | tuple)
                what = f"a value {field.name}" if number else f"a table [{field.name}]"
                raise ValueError(f'there must be {what}, or base = "NAME" of a built-in one')
        return _built(kind, given, base, "")
    except (ValueError, TypeError) as error:
        raise ValueError(f"{file}: {error}") from None


def _built(kind: Any, given: Mapping[str, Any], base: Any, where: str) -> Any:
    """An instance of a dataclass, from `base` if there is one, with the given fields."""
    hints, names = typing.get_type_hints(kind), [f.name for f in dataclasses.fields(kind)]
    changes: dict[str, Any] = {}
    for name, value in given.items():
        if name not in names:
            meant = check.did_you_mean(name, names) or f"; it has {', '.join(names)}"
            raise ValueError(f"{where}{name} is not a field of {kind.__name__}{meant}")
        inner = hints[name]
        if types.NoneType in typing.get_args(inner):
            (inner,) = (part for part in typing.get_args(inner) if part is not types.NoneType)
        if inner is not hints[name] and value == _NONE:
            changes[name] = None
        elif dataclasses.is_dataclass(inner):
            if not isinstance(value, dict):
                raise ValueError(f"{where}{name} must be a table, got {value!r}")
            changes[name] = _built(inner, value, getattr(base, name, None), f"{where}{name}.")
        else:
            changes[name] = value
    return kind(**changes) if base is None else base.replace(**changes)


def _lines(values: Mapping[str, Any]) -> str:
    return "".join(f"{name} = {_text(value)}\n" for name, value in values.items())


def _text(value: Any) -> str:
    """A value as TOML writes it."""
    if value is None or isinstance(value, str):
        return json.dumps(_NONE if value is None else value)
    if isinstance(value, bool | int):
        return str(value).lower()
    if isinstance(value, float):
        return repr(float(value))
    parts = [_text(part) for part in value]
    if parts and parts[0].startswith("["):  # a matrix: a line for each row
        return "[\n" + "".join(f"  {row},\n" for row in parts) + "]"
    return f"[{', '.join(parts)}]"
