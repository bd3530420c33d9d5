"""Typed settings from layers of plain tables: strict about names, types and ranges, and clear about what is wrong.

Settings are frozen dataclasses, nested as the keys are. A field's annotation is its rule::

    @dataclass(frozen=True, slots=True, kw_only=True)
    class TrackerSettings:
        iterations: Annotated[int, Range(1, 1000)] = 60
        optimizer: Literal["adam", "gauss_newton"] = "gauss_newton"
        far_factor: Annotated[float, Range(low=1.0)] | None = None

Types: bool, int, float, str, Literal of those, tuples (fixed or ``tuple[T, ...]``), dataclasses, each also
``| None``. A Range may stand around a number, an optional number, or a tuple of numbers. In TOML and on the command
line, which have no null, the word ``none`` means None where None is allowed.
"""

import dataclasses
import datetime
import difflib
import math
import re
import tomllib
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar, Union, cast, get_args, get_origin
from typing import get_type_hints as _get_type_hints

from vtslam.common.config_hints import (
    NONE_WORD,
    SCALAR_TEXT,
    Range,
    default_of,
    nested_class,
    optional_part,
    range_text,
    type_text,
    value_text,
    without_bounds,
)

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    _Settings = TypeVar("_Settings", bound=DataclassInstance)
else:
    _Settings = TypeVar("_Settings")

__all__ = [
    "ConfigError",
    "KeyDescription",
    "Layer",
    "Range",
    "describe",
    "load",
    "load_toml",
    "parse_assignment",
    "to_dict",
]

Layer = tuple[str, Mapping[str, Any]]

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_BARE_WORD = re.compile(r"[^\s\"'\[\]{}=,#]+")


class ConfigError(ValueError):
    """A setting is refused: the text names its origin, key and value, and what is allowed."""


class KeyDescription(NamedTuple):
    """One line of a listing of settings."""

    key: str
    type_text: str
    default: str
    range_text: str


def load(settings_class: type[_Settings], layers: Sequence[Layer]) -> _Settings:
    """Settings from the defaults and ``layers`` of (origin, nested table), of which later ones win, key by key.

    Every layer is checked, also where a later one wins.

    Raises:
        ConfigError: An unknown key, a wrong type, a value out of range, a missing value, or a rule between keys (a
            ValueError of a settings class) broken.
    """
    return cast(_Settings, _build(settings_class, None, layers, "", _leaf_keys(settings_class)))


def load_toml(path: Path) -> dict[str, Any]:
    """The table in a TOML file.

    Raises:
        ConfigError: The file is missing, unreadable, or not TOML; the text names file and line.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot read: {error.strerror}") from error
    try:
        return tomllib.loads(data.decode())
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise ConfigError(f"{path}:{line}: not UTF-8 text") from error
    except tomllib.TOMLDecodeError as error:
        message, _, place = str(error).partition(" (at ")
        found = re.match(r"line (\d+)", place)
        line = int(found[1]) if found else data.count(b"\n") + 1
        raise ConfigError(f"{path}:{line}: not TOML: {message}") from error


def parse_assignment(text: str) -> dict[str, Any]:
    """The nested table of ``a.b=value``; the value is TOML, or a bare word that stands for itself.

    Raises:
        ConfigError: There is no ``=``, a part of the key is empty or odd, or the value is neither.
    """
    key, equals, value = text.partition("=")
    parts = [part.strip() for part in key.split(".")]
    if not equals or not all(_BARE_KEY.fullmatch(part) for part in parts):
        raise ConfigError(f"a setting reads key=value, as in source.noise=kinect; got {text!r}")
    table: Any = _parse_value(key.strip(), value.strip())
    for part in reversed(parts):
        table = {part: table}
    return cast(dict[str, Any], table)


def to_dict(settings: "DataclassInstance") -> dict[str, Any]:
    """``settings`` as a nested table for TOML, which :func:`load` turns back into equal settings.

    Tuples become lists. None is left out where it is the default, else it is the word ``none``.
    """
    return _to_dict(settings, None)


def describe(settings_class: "type[DataclassInstance]") -> list[KeyDescription]:
    """All keys with type, default and range as text, in the order of the fields."""
    return _describe(settings_class, None, "")


# --- building --------------------------------------------------------------------------------------------------------


def _build(
    settings_class: "type[DataclassInstance]",
    base: "DataclassInstance | None",
    layers: Sequence[Layer],
    prefix: str,
    known_keys: Sequence[str],
) -> "DataclassInstance":
    """An instance of the class: values of ``base`` or the class's defaults, replaced by those in ``layers``."""
    hints = _get_type_hints(settings_class, include_extras=True)
    names = [field.name for field in dataclasses.fields(settings_class)]
    for origin, table in layers:
        for key in table:
            if key not in names:
                raise ConfigError(_unknown_key(origin, prefix, key, table[key], names, known_keys))
    values: dict[str, Any] = {}
    for field in dataclasses.fields(settings_class):
        default = _default_in(base, field)
        given = [(origin, table[field.name]) for origin, table in layers if field.name in table]
        values[field.name] = _field_value(f"{prefix}{field.name}", hints[field.name], default, given, known_keys)
    try:
        return settings_class(**values)
    except ValueError as error:
        origins = ", ".join(dict.fromkeys(origin for origin, _ in layers)) or "defaults"
        raise ConfigError(f"{origins}: {prefix.rstrip('.') or 'settings'}: {error}") from error


def _field_value(key: str, hint: Any, default: Any, given: Sequence[tuple[str, Any]], known_keys: Sequence[str]) -> Any:  # noqa: ANN401
    """The value of one field: its default, or the last of those given, all of which are checked."""
    nested, optional = nested_class(hint)
    if nested is not None:
        return _nested_value(key, nested, optional, default, given, known_keys)
    if default is dataclasses.MISSING and not given:
        raise ConfigError(f"settings: {key}: no value given; expected {type_text(hint, with_range=True)}")
    value = default
    for origin, found in given:
        try:
            value = _checked(hint, found, None)
        except ValueError as error:
            expected = type_text(hint, with_range=True) + _like_choice(hint, found)
            raise ConfigError(f"{origin}: {key} = {value_text(found)}: expected {expected}") from error
    return value


def _nested_value(
    key: str,
    nested: "type[DataclassInstance]",
    optional: bool,
    default: Any,  # noqa: ANN401
    given: Sequence[tuple[str, Any]],
    known_keys: Sequence[str],
) -> Any:  # noqa: ANN401
    """A table's value; in an optional one, ``none`` forgets what earlier layers said."""
    base = None if default is dataclasses.MISSING else default
    absent = default is None
    layers: list[Layer] = []
    for origin, found in given:
        if optional and _is_none(found):
            base, absent, layers = None, True, []
        elif isinstance(found, Mapping):
            layers.append((origin, found))
            absent = False
        else:
            names = ", ".join(field.name for field in dataclasses.fields(nested))
            expected = f"a table{' or none' if optional else ''} with the keys {names}"
            raise ConfigError(f"{origin}: {key} = {value_text(found)}: expected {expected}")
    return None if absent else _build(nested, base, layers, f"{key}.", known_keys)


# --- checking one value ----------------------------------------------------------------------------------------------


def _checked(hint: Any, value: Any, bounds: Range | None) -> Any:  # noqa: ANN401
    """``value`` as the type of ``hint``; ValueError if it is something else."""
    hint, bounds = without_bounds(hint, bounds)
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        return None if _is_none(value) else _checked(optional_part(hint), value, bounds)
    if origin is Literal:
        if not any(type(choice) is type(value) and choice == value for choice in get_args(hint)):
            raise ValueError("not one of the choices")
        return value
    if origin is tuple:
        return _checked_tuple(get_args(hint), value, bounds)
    return _checked_scalar(hint, value, bounds)


def _is_none(value: Any) -> bool:  # noqa: ANN401
    return value is None or (isinstance(value, str) and value == NONE_WORD)


def _checked_tuple(items: tuple[Any, ...], value: Any, bounds: Range | None) -> tuple[Any, ...]:  # noqa: ANN401
    if not isinstance(value, list | tuple):
        raise ValueError("not a list")
    if items[-1] is Ellipsis:
        items = (items[0],) * len(value)
    if len(value) != len(items):
        raise ValueError("not as many items")
    return tuple(_checked(item, part, bounds) for item, part in zip(items, value, strict=True))


def _checked_scalar(kind: Any, value: Any, bounds: Range | None) -> Any:  # noqa: ANN401
    if kind not in SCALAR_TEXT:
        raise TypeError(f"settings cannot have fields of type {kind!r}")
    if kind is float and type(value) is int:
        try:
            value = float(value)
        except OverflowError as error:
            raise ValueError("too large") from error
    if type(value) is not kind or (kind is float and not math.isfinite(value)):
        raise ValueError("another type")
    if bounds is not None and not bounds.holds(value):
        raise ValueError("out of range")
    return value


# --- defaults, which a nested default instance overrides -------------------------------------------------------------


def _default_in(base: "DataclassInstance | None", field: "dataclasses.Field[Any]") -> Any:  # noqa: ANN401
    return default_of(field) if base is None else getattr(base, field.name)


def _is_settings(value: Any) -> bool:  # noqa: ANN401
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _to_dict(settings: "DataclassInstance", base: "DataclassInstance | None") -> dict[str, Any]:
    out: dict[str, Any] = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        default = _default_in(base, field)
        if _is_settings(value):
            out[field.name] = _to_dict(value, default if _is_settings(default) else None)
        elif value is not None:
            out[field.name] = list(value) if isinstance(value, tuple) else value
        elif default is not None:
            out[field.name] = NONE_WORD
    return out


def _describe(
    settings_class: "type[DataclassInstance]", base: "DataclassInstance | None", prefix: str
) -> list[KeyDescription]:
    hints = _get_type_hints(settings_class, include_extras=True)
    rows: list[KeyDescription] = []
    for field in dataclasses.fields(settings_class):
        hint = hints[field.name]
        default = _default_in(base, field)
        nested, _ = nested_class(hint)
        if nested is not None:
            rows += _describe(nested, default if _is_settings(default) else None, f"{prefix}{field.name}.")
        else:
            key = f"{prefix}{field.name}"
            rows.append(KeyDescription(key, type_text(hint), value_text(default), range_text(hint)))
    return rows


# --- text ------------------------------------------------------------------------------------------------------------


def _leaf_keys(settings_class: "type[DataclassInstance]") -> list[str]:
    return [row.key for row in describe(settings_class)]


def _unknown_key(
    origin: str,
    prefix: str,
    key: str,
    value: Any,  # noqa: ANN401
    names: Sequence[str],
    known_keys: Sequence[str],
) -> str:
    """The text for an unknown key; looks for a like one beside it first, then anywhere."""
    near = [f"{prefix}{name}" for name in difflib.get_close_matches(key, names, n=1)]
    if not near:
        by_name = {known.rsplit(".", 1)[-1]: known for known in reversed(known_keys)}
        near = [by_name[name] for name in difflib.get_close_matches(key, by_name, n=1)]
    hint = f"did you mean {near[0]}?" if near else f"known here: {', '.join(names)}"
    return f"{origin}: {prefix}{key} = {value_text(value)}: unknown key; {hint}"


def _like_choice(hint: Any, value: Any) -> str:  # noqa: ANN401
    """For a misspelt choice, the one that was perhaps meant."""
    choices = [str(choice) for choice in get_args(hint)] if get_origin(hint) is Literal else []
    near = difflib.get_close_matches(str(value), choices, n=1)
    return f"; did you mean {near[0]}?" if near else ""


def _parse_value(key: str, text: str) -> Any:  # noqa: ANN401
    try:
        table = tomllib.loads(f"value = {text}")
        if set(table) == {"value"}:
            value = table["value"]
            return text if isinstance(value, datetime.date | datetime.time) else value  # no setting is a date
    except tomllib.TOMLDecodeError:
        if _BARE_WORD.fullmatch(text):
            return text
    raise ConfigError(f"--set: {key}: expected a TOML value or a bare word, got {text!r}")
