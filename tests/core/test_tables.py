"""Tables become dataclasses whose every value is checked; a message names file, key, value and rule."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartnav_graph.core.errors import ConfigError, SmartnavError
from smartnav_graph.core.files import read_toml
from smartnav_graph.core.tables import check, structured


@dataclass(frozen=True)
class Lens:
    width: int
    focal: float = 1.5

    def __post_init__(self) -> None:
        if self.width == 0:
            raise ConfigError("lens", "width = 0", "> 0")


@dataclass(frozen=True)
class Options:
    on: bool = True
    offset: float = 0.0
    sigma: float = field(default=1.0, metadata={"nan": True})
    passes: int = 3
    spans: tuple[int, ...] = (1, 2)
    arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start: float | None = None
    name: str = ""
    lenses: Mapping[str, Lens] = field(default_factory=dict)


BROKEN = [
    ({"on": 1}, "on = 1; expected true or false"),
    ({"offset": True}, "offset = True; expected a number"),
    ({"offset": float("nan")}, "offset = nan; expected a finite number"),
    ({"offset": "0x10"}, "offset = '0x10'; expected a number"),
    ({"offset": 1e300}, r"offset = 1e\+300; expected a finite number of at most 1e\+15"),
    ({"sigma": -1.0}, r"sigma = -1\.0; expected a number >= 0"),
    ({"passes": 2.5}, r"passes = 2\.5; expected a whole number"),
    ({"passes": 10**30}, "passes = 10+; expected a finite number of at most"),
    ({"spans": [1, "2"]}, r"spans\[1\] = '2'; expected a whole number"),
    ({"arm": [0.0, 1.0]}, r"arm = \[0\.0, 1\.0\]; expected a list of 3"),
    ({"name": 5}, "name = 5; expected a text in quotes"),
    ({"pases": 5}, "unknown key pases; expected passes, or another of on, offset"),
    ({"lenses": {"a": {"focal": 1.0}}}, r"key lenses\.a\.width is missing; expected a value: it has no default"),
    ({"lenses": {"a": 3}}, r"lenses\.a = 3; expected a table with some of width, focal"),
    ({"lenses": {"a": {"width": 0}}}, r"o\.toml \[lenses\.a\]: width = 0; expected > 0"),
    ([], r"o\.toml: is \[\]; expected a table"),
]


@pytest.mark.parametrize(("table", "message"), BROKEN)
def test_a_value_that_breaks_a_rule(table, message):
    with pytest.raises(ConfigError, match=message) as error:
        structured(Options, table, ConfigError, "o.toml")
    assert str(error.value).startswith("o.toml")


def test_values_that_keep_the_rules():
    table = {"offset": -2, "sigma": float("nan"), "spans": [4], "start": 1, "lenses": {"a": {"width": 3}}}
    found = structured(Options, table, ConfigError, "o.toml")
    assert found.lenses == {"a": Lens(3)} and found.spans == (4,) and isinstance(found.offset, float)
    assert check(Options(spans=(7,)), ConfigError, "options") == Options(spans=(7,))


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from(["width", "focal", "a"]), inner),
    max_leaves=8,
)


@given(st.dictionaries(st.sampled_from([*Options.__dataclass_fields__, "other"]), values))
def test_any_table_is_read_or_refused_by_key(table):
    message = ""
    try:
        structured(Options, table, ConfigError, "o.toml")
    except SmartnavError as error:
        message = str(error)
    assert not message or (any(key in message for key in table) and "expected" in message)


@pytest.mark.parametrize("text", ["[" * 100_000, "a = " + "[" * 100_000, "a = " + "9" * 5000, "a = 1\na = 2", "\x00"])
def test_toml_that_cannot_be_read(tmp_path, text):
    (tmp_path / "o.toml").write_text(text)
    with pytest.raises(ConfigError, match=r"o\.toml: is (no TOML|nested too deeply)"):
        read_toml(tmp_path / "o.toml", ConfigError, "options")
    with pytest.raises(ConfigError, match="is no file"):
        read_toml(tmp_path, ConfigError, "options")
