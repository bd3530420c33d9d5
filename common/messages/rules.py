"""Rules of message fields: each turns a value into plain msgpack and back, and refuses what it does not allow.

A message is a frozen dataclass. A field's annotation carries its rule, as in
``frame_id: Annotated[int, Integer(0, 9)]``; it is applied when a message is written and when it is read.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Protocol

import numpy as np

from vtslam.common.geometry import se3

MAX_INT = 2**63 - 1


class Reason(StrEnum):
    """Why a message was refused; the counters of refused messages go by it."""

    TOO_LONG = "too_long"  # more bytes than its topic allows
    NOT_MSGPACK = "not_msgpack"
    ENVELOPE = "envelope"  # not the seven values around every message
    KIND = "kind"  # a message of another kind than its topic's
    VERSION = "version"  # of the protocol or of the message
    FIELDS = "fields"  # missing or unknown ones
    VALUE = "value"  # of another type, shape or range
    TAIL = "tail"  # the raw bytes after the record have another length than it says


class MessageError(ValueError):
    """A message was refused.

    Attributes:
        reason: Its class of fault.
        place: The field, as in ``quality.renders``; empty if it concerns the whole message.
        expected, found: What is allowed and what there was.
    """

    def __init__(self, reason: Reason, place: str, *, expected: str, found: str) -> None:
        super().__init__(f"{place or 'message'}: expected {expected}, found {found}")
        self.reason, self.place, self.expected, self.found = reason, place, expected, found


def refused(place: str, expected: str, value: object) -> MessageError:
    """The error of a value that a rule does not allow."""
    return MessageError(Reason.VALUE, place, expected=expected, found=f"{type(value).__name__} {value!r:.60}")


class Rule(Protocol):
    """How one field crosses the bus."""

    def to_plain(self, value: Any, place: str) -> Any:  # noqa: ANN401
        """The value as None, bool, int, float, str, list or dict; MessageError if it is not allowed."""
        ...

    def from_plain(self, plain: Any, place: str) -> Any:  # noqa: ANN401
        """The value of :meth:`to_plain`'s result; MessageError if nothing allowed gives it."""
        ...


@dataclass(frozen=True, slots=True)
class Flag:
    """A bool."""

    def to_plain(self, value: Any, place: str) -> bool:  # noqa: ANN401
        """See `Rule`."""
        if type(value) is not bool:
            raise refused(place, "a boolean", value)
        return value

    from_plain = to_plain


@dataclass(frozen=True, slots=True)
class Integer:
    """An int in low..high."""

    low: int
    high: int

    def to_plain(self, value: Any, place: str) -> int:  # noqa: ANN401
        """See `Rule`."""
        if type(value) is not int or not self.low <= value <= self.high:
            raise refused(place, f"an integer in {self.low}..{self.high}", value)
        return value

    from_plain = to_plain


@dataclass(frozen=True, slots=True)
class Real:
    """A finite float in low..high."""

    low: float = -math.inf
    high: float = math.inf

    def to_plain(self, value: Any, place: str) -> float:  # noqa: ANN401
        """See `Rule`."""
        if not isinstance(value, float) or not math.isfinite(value) or not self.low <= value <= self.high:
            raise refused(place, f"a finite float in {self.low:g}..{self.high:g}", value)
        return float(value)

    from_plain = to_plain


@dataclass(frozen=True, slots=True)
class Text:
    """Printable text of a bounded length, and of a pattern if there is one."""

    max_length: int
    pattern: re.Pattern[str] | None = None

    def to_plain(self, value: Any, place: str) -> str:  # noqa: ANN401
        """See `Rule`."""
        if type(value) is not str or len(value) > self.max_length or not value.isprintable():
            raise refused(place, f"printable text of at most {self.max_length} characters", value)
        if self.pattern is not None and self.pattern.fullmatch(value) is None:
            raise refused(place, f"text of the form {self.pattern.pattern}", value)
        return value

    from_plain = to_plain


NAME = Text(64, re.compile(r"[a-z0-9][a-z0-9_.-]*"))  # of a block, file or service: no path can be made of it


@dataclass(frozen=True, slots=True)
class Choice:
    """A member of an enumeration of texts, by its value."""

    members: type[StrEnum]

    def to_plain(self, value: Any, place: str) -> str:  # noqa: ANN401
        """See `Rule`."""
        if not isinstance(value, self.members):
            raise refused(place, f"a {self.members.__name__}", value)
        return value.value

    def from_plain(self, plain: Any, place: str) -> StrEnum:  # noqa: ANN401
        """See `Rule`."""
        if type(plain) is not str or plain not in list(self.members):
            raise refused(place, f"one of {', '.join(self.members)}", plain)
        return self.members(plain)


@dataclass(frozen=True, slots=True)
class Numbers:
    """A finite array of a fixed shape, float32 or float64, as a flat row-major list of floats.

    Attributes:
        shape: Its shape.
        dtype: Its type; float32 values must come as floats that float32 holds exactly.
        test: What else must hold, or None.
        meaning: What `test` asks for, in words.
    """

    shape: tuple[int, ...]
    dtype: str = "float64"
    test: Callable[[Any], bool] | None = None
    meaning: str = ""

    def to_plain(self, value: Any, place: str) -> list[float]:  # noqa: ANN401
        """See `Rule`."""
        expected = self._expected()
        if not isinstance(value, np.ndarray):
            raise refused(place, expected, value)
        if value.dtype != self.dtype or value.shape != self.shape:
            raise MessageError(Reason.VALUE, place, expected=expected, found=f"{value.dtype} {list(value.shape)}")
        self._check(value, place)
        return [float(x) for x in value.ravel()]

    def from_plain(self, plain: Any, place: str) -> Any:  # noqa: ANN401
        """See `Rule`."""
        if type(plain) is not list or len(plain) != math.prod(self.shape) or any(type(x) is not float for x in plain):
            raise refused(place, f"{math.prod(self.shape)} floats", plain)
        wide = np.array(plain, np.float64)
        with np.errstate(over="ignore"):
            value = wide.astype(self.dtype).reshape(self.shape)
        self._check(value, place)
        if not np.array_equal(value.ravel(), wide):
            raise refused(place, f"values that {self.dtype} holds exactly", plain)
        return value

    def _check(self, value: Any, place: str) -> None:  # noqa: ANN401
        if not np.isfinite(value).all() or (self.test is not None and not self.test(value)):
            raise refused(place, self._expected(), value.tolist())

    def _expected(self) -> str:
        return f"finite {self.dtype} {list(self.shape)}{self.meaning and ', ' + self.meaning}"


@dataclass(frozen=True, slots=True)
class Series:
    """A tuple of finite floats of a bounded length."""

    max_length: int

    def to_plain(self, value: Any, place: str) -> list[float]:  # noqa: ANN401
        """See `Rule`."""
        if type(value) is not tuple or len(value) > self.max_length:
            raise refused(place, f"a tuple of at most {self.max_length} floats", value)
        return [Real().to_plain(item, place) for item in value]

    def from_plain(self, plain: Any, place: str) -> tuple[float, ...]:  # noqa: ANN401
        """See `Rule`."""
        if type(plain) is not list or len(plain) > self.max_length:
            raise refused(place, f"at most {self.max_length} floats", plain)
        return tuple(Real().from_plain(item, place) for item in plain)


def _is_covariance(c: Any) -> bool:  # noqa: ANN401
    scale = float(np.abs(c).max())
    if not scale <= 1e12 or not np.allclose(c, c.T, atol=1e-9 * scale):
        return False
    return bool(np.linalg.eigvalsh(c).min() >= -1e-9 * max(scale, 1e-30))


def _is_pose(T: Any) -> bool:  # noqa: ANN401
    return bool(np.abs(T).max() <= 1e9) and se3.is_rigid(T)


POSE = Numbers((4, 4), test=_is_pose, meaning="a rigid motion")
COVARIANCE = Numbers((6, 6), test=_is_covariance, meaning="symmetric and positive semi-definite")


@dataclass(frozen=True, slots=True)
class Maybe:
    """What another rule allows, or None."""

    rule: Rule

    def to_plain(self, value: Any, place: str) -> Any:  # noqa: ANN401
        """See `Rule`."""
        return None if value is None else self.rule.to_plain(value, place)

    def from_plain(self, plain: Any, place: str) -> Any:  # noqa: ANN401
        """See `Rule`."""
        return None if plain is None else self.rule.from_plain(plain, place)


@dataclass(frozen=True, slots=True)
class Table:
    """A dict with names as keys, of a bounded size."""

    rule: Rule
    max_items: int

    def to_plain(self, value: Any, place: str) -> dict[str, Any]:  # noqa: ANN401
        """See `Rule`."""
        self._check(value, place)
        return {key: self.rule.to_plain(item, f"{place}.{key}") for key, item in value.items()}

    def from_plain(self, plain: Any, place: str) -> dict[str, Any]:  # noqa: ANN401
        """See `Rule`."""
        self._check(plain, place)
        return {key: self.rule.from_plain(item, f"{place}.{key}") for key, item in plain.items()}

    def _check(self, value: Any, place: str) -> None:  # noqa: ANN401
        if type(value) is not dict or len(value) > self.max_items:
            raise refused(place, f"a map of at most {self.max_items} entries", value)
        for key in value:
            NAME.to_plain(key, f"{place} (a key)")


class Fields:
    """A dataclass whose fields have rules; its constructor may refuse with ValueError."""

    __slots__ = ("factory", "rules")

    def __init__(self, factory: Callable[..., Any], rules: Mapping[str, Rule]) -> None:
        self.factory, self.rules = factory, dict(rules)

    def to_plain(self, value: Any, place: str) -> dict[str, Any]:  # noqa: ANN401
        """See `Rule`."""
        if type(value) is not self.factory:
            raise refused(place, f"a {getattr(self.factory, '__name__', self.factory)}", value)
        return {name: rule.to_plain(getattr(value, name), _inside(place, name)) for name, rule in self.rules.items()}

    def from_plain(self, plain: Any, place: str) -> Any:  # noqa: ANN401
        """See `Rule`."""
        try:
            return self.factory(**self.values(plain, place))
        except MessageError:
            raise
        except ValueError as error:
            raise MessageError(Reason.VALUE, place, expected="a consistent record", found=str(error)) from error

    def values(self, plain: Any, place: str) -> dict[str, Any]:  # noqa: ANN401
        """The checked values by field."""
        if type(plain) is not dict:
            raise refused(place, "a map of fields", plain)
        if plain.keys() != self.rules.keys():
            missing = sorted(self.rules.keys() - plain.keys())
            unknown = sorted(plain.keys() - self.rules.keys(), key=str)
            raise MessageError(
                Reason.FIELDS,
                place,
                expected=f"the fields {', '.join(self.rules)}",
                found=f"missing {missing}, unknown {unknown!r:.80}",
            )
        return {name: rule.from_plain(plain[name], _inside(place, name)) for name, rule in self.rules.items()}


def _inside(place: str, name: str) -> str:
    return f"{place}.{name}" if place else name
