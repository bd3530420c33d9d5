"""What the annotation of a settings field says: its type, its bounds, and both as text."""

import dataclasses
import types
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

NONE_WORD = "none"
SCALAR_TEXT = {bool: "true or false", int: "an integer", float: "a number", str: "a string"}


@dataclass(frozen=True, slots=True)
class Range:
    """Bounds of a number, inclusive unless open; None is no bound."""

    low: float | None = None
    high: float | None = None
    low_open: bool = False
    high_open: bool = False

    def holds(self, value: float) -> bool:
        """Whether ``value`` is within the bounds."""
        if self.low is not None and (value < self.low or (self.low_open and value == self.low)):
            return False
        return self.high is None or value < self.high or (not self.high_open and value == self.high)

    @property
    def is_two_sided(self) -> bool:
        """Whether both bounds are set."""
        return self.low is not None and self.high is not None

    def __str__(self) -> str:
        if self.low is not None and self.high is not None:
            return f"{'(' if self.low_open else '['}{self.low:.10g}, {self.high:.10g}{')' if self.high_open else ']'}"
        low = "" if self.low is None else f"{'>' if self.low_open else '>='} {self.low:.10g}"
        return low if self.high is None else f"{'<' if self.high_open else '<='} {self.high:.10g}"


def without_bounds(hint: Any, bounds: Range | None) -> tuple[Any, Range | None]:  # noqa: ANN401
    """The annotated type itself, and the Range at it, else the one handed down from around it."""
    if get_origin(hint) is not Annotated:
        return hint, bounds
    inner, *marks = get_args(hint)
    return inner, next((mark for mark in marks if isinstance(mark, Range)), bounds)


def optional_part(hint: Any) -> Any:  # noqa: ANN401
    """T of ``T | None``; raises TypeError for a union of more."""
    inner = [part for part in get_args(hint) if part is not types.NoneType]
    if len(inner) != 1:
        raise TypeError(f"settings cannot have fields of type {hint!r}")
    return inner[0]


def nested_class(hint: Any) -> "tuple[type[DataclassInstance] | None, bool]":  # noqa: ANN401
    """The settings class that a hint stands for, if any, and whether it may be None."""
    optional = get_origin(hint) in (Union, types.UnionType)
    hint = optional_part(hint) if optional else hint
    return (hint if isinstance(hint, type) and dataclasses.is_dataclass(hint) else None), optional


def default_of(field: "dataclasses.Field[Any]") -> Any:  # noqa: ANN401
    """A field's default, made if it has a factory; ``dataclasses.MISSING`` if there is none."""
    return field.default if field.default_factory is dataclasses.MISSING else field.default_factory()


def type_text(hint: Any, *, with_range: bool = False, bounds: Range | None = None) -> str:  # noqa: ANN401
    """A type in words; with its bounds, which are those at ``hint``, else ``bounds``, if asked."""
    hint, bounds = without_bounds(hint, bounds)
    origin, parts = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return f"{type_text(optional_part(hint), with_range=with_range, bounds=bounds)} or {NONE_WORD}"
    if origin is Literal:
        return "one of " + ", ".join(value_text(choice) for choice in parts)
    if origin is tuple:
        texts = [type_text(item, with_range=with_range, bounds=bounds) for item in parts if item is not Ellipsis]
        return (
            f"a list, each item {texts[0]}" if parts[-1] is Ellipsis else f"a list of {len(texts)}: {', '.join(texts)}"
        )
    text = SCALAR_TEXT.get(hint, str(hint))
    if bounds is None or not with_range:
        return text
    return f"{text} in the range {bounds}" if bounds.is_two_sided else f"{text} {bounds}"


def range_text(hint: Any) -> str:  # noqa: ANN401
    """The Range at a hint or at the types inside it."""
    inner, bounds = without_bounds(hint, None)
    if bounds is not None:
        return str(bounds)
    texts = [range_text(part) for part in get_args(inner)] if get_origin(inner) is not Literal else []
    return ", ".join(dict.fromkeys(text for text in texts if text))


def value_text(value: Any) -> str:  # noqa: ANN401
    """A value as TOML writes it."""
    if value is None or value is dataclasses.MISSING:
        return NONE_WORD if value is None else "required"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return f"[{', '.join(value_text(item) for item in value)}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key} = {value_text(item)}' for key, item in value.items())}}}"
    return f'"{value}"' if isinstance(value, str) else str(value)
