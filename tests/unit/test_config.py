"""Settings: layers win key by key; every refusal names origin, key, value and what is allowed."""

import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
import tomli_w

from vtslam.common.config import (
    ConfigError,
    KeyDescription,
    Layer,
    Range,
    describe,
    load,
    load_toml,
    parse_assignment,
    to_dict,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Inner:
    iterations: Annotated[int, Range(1, 1000)] = 60
    rate: Annotated[float, Range(0.0, 1.0, low_open=True)] = 0.5
    far: Annotated[float, Range(low=1.0)] | None = 2.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Outer:
    size: tuple[int, int] = (320, 240)
    weights: Annotated[tuple[float, ...], Range(0.0)] = (1.0,)
    noise: Literal["none", "kinect"] = "none"
    levels: Literal[1, 2] = 1
    label: str = "a"
    verbose: bool = False
    limit: int | None = None
    inner: Inner = field(default_factory=Inner)
    quick: Inner = Inner(iterations=5, far=None)
    extra: Inner | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Required:
    number: Annotated[int, Range(high=9, high_open=True)]


def loaded(**table: Any) -> Outer:  # noqa: ANN401
    return load(Outer, [("my.toml", table)])


# --- layers ----------------------------------------------------------------------------------------------------------


def test_defaults() -> None:
    assert load(Outer, []) == Outer()


def test_later_layers_win_key_by_key() -> None:
    layers: list[Layer] = [
        ("preset", {"label": "p", "inner": {"iterations": 10, "rate": 0.25}}),
        ("my.toml", {"inner": {"iterations": 20}, "size": [64, 48]}),
        ("--set", {"inner": {"far": 8}}),
    ]
    assert load(Outer, layers) == Outer(label="p", size=(64, 48), inner=Inner(iterations=20, rate=0.25, far=8.0))


def test_layers_are_laid_over_the_fields_own_default() -> None:
    assert loaded(quick={"rate": 1.0}).quick == Inner(iterations=5, rate=1.0, far=None)


def test_whole_numbers_become_floats() -> None:
    rate = loaded(inner={"rate": 1}).inner.rate
    assert rate == 1.0
    assert type(rate) is float


def test_none_by_its_word_or_itself() -> None:
    assert loaded(inner={"far": "none"}).inner.far is None
    assert loaded(inner={"far": None}).inner.far is None
    assert loaded(extra={"rate": 0.125}).extra == Inner(rate=0.125)
    layers: list[Layer] = [("a", {"extra": {"rate": 0.125}}), ("b", {"extra": "none"})]
    assert load(Outer, layers).extra is None
    assert load(Outer, [*layers, ("c", {"extra": {"iterations": 2}})]).extra == Inner(iterations=2)


# --- refusals --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"nois": "kinect"}, 'nois = "kinect": unknown key; did you mean noise?'),
        ({"inner": {"iteration": 3}}, "inner.iteration = 3: unknown key; did you mean inner.iterations?"),
        ({"rate": 0.5}, "rate = 0.5: unknown key; did you mean inner.rate?"),
        ({"innr": {"rate": 0.5}}, "innr = {rate = 0.5}: unknown key; did you mean inner?"),
        ({"inner": {"zzz": 1}}, "inner.zzz = 1: unknown key; known here: iterations, rate, far"),
        ({"inner": 3}, "inner = 3: expected a table with the keys iterations, rate, far"),
        ({"extra": 3}, "extra = 3: expected a table or none with the keys iterations, rate, far"),
        ({"inner": "none"}, 'inner = "none": expected a table with the keys iterations, rate, far'),
        ({"inner": {"iterations": 0}}, "inner.iterations = 0: expected an integer in the range [1, 1000]"),
        ({"inner": {"iterations": 1001}}, "inner.iterations = 1001: expected an integer in the range [1, 1000]"),
        ({"inner": {"iterations": 2.0}}, "inner.iterations = 2.0: expected an integer in the range [1, 1000]"),
        ({"inner": {"iterations": True}}, "inner.iterations = true: expected an integer in the range [1, 1000]"),
        ({"inner": {"iterations": "3"}}, 'inner.iterations = "3": expected an integer in the range [1, 1000]'),
        ({"inner": {"rate": 0}}, "inner.rate = 0: expected a number in the range (0, 1]"),
        ({"inner": {"rate": float("nan")}}, "inner.rate = nan: expected a number in the range (0, 1]"),
        ({"inner": {"far": float("inf")}}, "inner.far = inf: expected a number >= 1 or none"),
        ({"inner": {"far": 10**400}}, f"inner.far = {10**400}: expected a number >= 1 or none"),
        ({"inner": {"far": True}}, "inner.far = true: expected a number >= 1 or none"),
        ({"noise": "kinekt"}, 'noise = "kinekt": expected one of "none", "kinect"; did you mean kinect?'),
        ({"levels": 3}, "levels = 3: expected one of 1, 2"),
        ({"levels": True}, "levels = true: expected one of 1, 2"),
        ({"label": 3}, "label = 3: expected a string"),
        ({"verbose": 1}, "verbose = 1: expected true or false"),
        ({"limit": "many"}, 'limit = "many": expected an integer or none'),
        ({"size": 320}, "size = 320: expected a list of 2: an integer, an integer"),
        ({"size": [320]}, "size = [320]: expected a list of 2: an integer, an integer"),
        ({"size": [320, 2.5]}, "size = [320, 2.5]: expected a list of 2: an integer, an integer"),
        ({"weights": [1, -1]}, "weights = [1, -1]: expected a list, each item a number >= 0"),
        ({"weights": 1.0}, "weights = 1.0: expected a list, each item a number >= 0"),
    ],
)
def test_refusals(table: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        loaded(**table)
    assert str(caught.value) == f"my.toml: {message}"


def test_earlier_layers_are_checked_too() -> None:
    with pytest.raises(ConfigError, match=r"^preset: label = 1: expected a string$"):
        load(Outer, [("preset", {"label": 1}), ("--set", {"label": "b"})])


def test_rule_between_keys_names_the_layers() -> None:
    @dataclass(frozen=True, slots=True, kw_only=True)
    class Pair:
        low: int = 1
        high: int = 2

        def __post_init__(self) -> None:
            if self.high < self.low:
                raise ValueError(f"high must be at least low, got {self.low} and {self.high}")

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Root:
        pair: Pair = field(default_factory=Pair)

    with pytest.raises(ConfigError, match=r"^a, b: pair: high must be at least low, got 3 and 2$"):
        load(Root, [("a", {"pair": {"low": 3}}), ("b", {"pair": {"high": 2}})])


def test_missing_value() -> None:
    assert load(Required, [("a", {"number": -5})]) == Required(number=-5)
    with pytest.raises(ConfigError, match=r"^settings: number: no value given; expected an integer < 9$"):
        load(Required, [])
    with pytest.raises(ConfigError, match=r"^a: number = 9: expected an integer < 9$"):
        load(Required, [("a", {"number": 9})])


def test_types_that_settings_cannot_have() -> None:
    @dataclass(frozen=True, slots=True, kw_only=True)
    class Bad:
        table: dict[str, int] = field(default_factory=dict)
        either: int | str = 1

    tables: list[dict[str, Any]] = [{"table": {}}, {"either": 1}]
    for table in tables:
        with pytest.raises(TypeError, match="settings cannot have fields of type"):
            load(Bad, [("a", table)])


# --- text in and out -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "settings",
    [
        Outer(),
        Outer(limit=3, inner=Inner(far=None), quick=Inner(far=4.0), extra=Inner(far=None), weights=()),
        Outer(quick=Inner(iterations=60, far=None)),
    ],
)
def test_settings_survive_toml(settings: Outer) -> None:
    text = tomli_w.dumps(to_dict(settings))
    assert load(Outer, [("run.toml", tomllib.loads(text))]) == settings


def test_to_dict() -> None:
    table = to_dict(Outer(inner=Inner(far=None)))
    assert table["size"] == [320, 240]
    assert table["inner"] == {"iterations": 60, "rate": 0.5, "far": "none"}
    assert table["quick"] == {"iterations": 5, "rate": 0.5}
    assert not {"limit", "extra"} & set(table)


@pytest.mark.parametrize(
    ("text", "table"),
    [
        ("noise=kinect", {"noise": "kinect"}),
        ("a.b-c.d_1 = 3", {"a": {"b-c": {"d_1": 3}}}),
        ("a=0.5", {"a": 0.5}),
        ("a=true", {"a": True}),
        ("a=True", {"a": "True"}),
        ("a=[1, 2.5]", {"a": [1, 2.5]}),
        ('a="x = y"', {"a": "x = y"}),
        ("a={b = 1}", {"a": {"b": 1}}),
        ("a=320x240", {"a": "320x240"}),
        ("a=0:120", {"a": "0:120"}),
        ("a=10:20:30", {"a": "10:20:30"}),
        ("a=runs/today", {"a": "runs/today"}),
    ],
)
def test_assignments(text: str, table: dict[str, Any]) -> None:
    assert parse_assignment(text) == table


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a", "a setting reads key=value, as in source.noise=kinect; got 'a'"),
        ("=3", "a setting reads key=value, as in source.noise=kinect; got '=3'"),
        ("a..b=3", "a setting reads key=value, as in source.noise=kinect; got 'a..b=3'"),
        ("a b=3", "a setting reads key=value, as in source.noise=kinect; got 'a b=3'"),
        ("a=", "--set: a: expected a TOML value or a bare word, got ''"),
        ("a=two words", "--set: a: expected a TOML value or a bare word, got 'two words'"),
        ('a="open', "--set: a: expected a TOML value or a bare word, got '\"open'"),
        ("a=1\nb=2", "--set: a: expected a TOML value or a bare word, got '1\\nb=2'"),
    ],
)
def test_assignments_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_assignment(text)
    assert str(caught.value) == message


def test_toml_files(tmp_path: Path) -> None:
    path = tmp_path / "my.toml"
    path.write_text('label = "é"\n[inner]\nrate = 1.0\n')
    assert loaded(**load_toml(path)) == Outer(label="é", inner=Inner(rate=1.0))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a = 1\n\nb = \n", r"my\.toml:3: not TOML: "),
        (b"a = 1\nb = [1,\n", r"my\.toml:\d: not TOML: "),
        (b"a = 1\na = 2\n", r"my\.toml:2: not TOML: "),
        (b'a = 1\nb = "\xff"\n', r"my\.toml:2: not UTF-8 text$"),
    ],
)
def test_toml_files_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "my.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=message):
        load_toml(path)


def test_missing_toml_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: cannot read: No such file or directory$"):
        load_toml(tmp_path / "none.toml")


def test_description() -> None:
    rows = {row.key: row for row in describe(Outer)}
    assert list(rows)[:4] == ["size", "weights", "noise", "levels"]
    assert list(rows)[-9:-6] == ["inner.iterations", "inner.rate", "inner.far"]
    assert rows["size"] == KeyDescription("size", "a list of 2: an integer, an integer", "[320, 240]", "")
    assert rows["weights"] == KeyDescription("weights", "a list, each item a number", "[1.0]", ">= 0")
    assert rows["noise"] == KeyDescription("noise", 'one of "none", "kinect"', '"none"', "")
    assert rows["limit"] == KeyDescription("limit", "an integer or none", "none", "")
    assert rows["inner.rate"] == KeyDescription("inner.rate", "a number", "0.5", "(0, 1]")
    assert rows["inner.far"] == KeyDescription("inner.far", "a number or none", "2.0", ">= 1")
    assert rows["quick.iterations"].default == "5"
    assert describe(Required) == [KeyDescription("number", "an integer", "required", "< 9")]
