"""The base of every stream: a frozen dataclass of typed columns, one field per quantity, one file per stream.

Rows are samples; arrays are read-only; every field declares its file columns, so that the table on disk and the
object in memory hold the same. A stream checks itself when it is built: shapes, finite values, time order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, Field, dataclass, field, fields
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from smartnav_graph.core.arrays import Column, Floats, Indices, Mask, Table, Times
from smartnav_graph.core.display import Summarised
from smartnav_graph.core.errors import InputTypeError, SessionError
from smartnav_graph.core.timebase import NS, span_text

LATEST_NS = 1 << 62
_DTYPES = {"float": np.float64, "int": np.int64, "text": np.object_}


# What no reading exceeds, whatever its unit: positions as far as the Moon, forces and rates of a shot.
LARGEST = 1e9


def quantity(
    *names: str, optional: bool = False, kind: str = "float", nan: bool | str = False, limit: float = LARGEST
) -> Any:
    """A field stored as the file columns `names`; `nan` allows unknown values, or names the column that may. No number
    is larger than `limit`, also in a wrong unit that a repair converts."""
    meta = {"columns": names, "kind": kind, "nan": nan, "limit": limit}
    return field(metadata=meta) if not optional else field(default=None, metadata=meta)


def axes(
    template: str, names: str = "xyz", *, optional: bool = False, nan: bool = False, limit: float = LARGEST
) -> Any:
    """A vector stored as one file column per axis: ``{}`` in `template` becomes its name."""
    return quantity(*(template.format(name) for name in names), optional=optional, nan=nan, limit=limit)


def required_columns(spec: Field[object]) -> list[bool]:
    """Which columns of a field must be finite."""
    names, nan = spec.metadata["columns"], spec.metadata["nan"]
    return [spec.metadata["kind"] == "float" and not (name == nan if isinstance(nan, str) else nan) for name in names]


class Label(NamedTuple):
    """Title and colour (red, green, blue) of a stream or a factor; `assumes` : meaning of a factor without a sensor."""

    title: str
    assumes: str = ""
    colour: tuple[int, int, int] = (190, 130, 255)


@dataclass(frozen=True, kw_only=True)
class Stream(Summarised):
    """Base of every stream. `t_ns` (n,) int64 on the session's clock; `extra` keeps unknown columns."""

    NAME: ClassVar[str]
    LABEL: ClassVar[Label]
    ABSOLUTE: ClassVar[bool] = False  # rows tie the trajectory to places, and make keyframes
    AIDING: ClassVar[bool] = False  # rows measure the motion
    UNIQUE_TIMES: ClassVar[bool] = True
    ONE_OF: ClassVar[tuple[str, ...]] = ()

    t_ns: Times = quantity("t_ns", kind="int")
    arrival_ns: Times | None = quantity("arrival_ns", kind="int", optional=True)
    extra: Mapping[str, Column] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.t_ns)

    def facts(self) -> dict[str, str]:
        """Rows, span, rate, fields."""
        known = [spec.name for spec in self.specs() if spec.name != "t_ns" and getattr(self, spec.name) is not None]
        span = span_text(self.t_ns)
        return {"rows": str(len(self)), **({"span": span} if span else {}), "fields": ", ".join([*known, *self.extra])}

    @property
    def available_ns(self) -> Times:
        """When each row (n,) became known."""
        return self.t_ns if self.arrival_ns is None else self.arrival_ns

    def __post_init__(self) -> None:
        for spec in self.specs():
            value = getattr(self, spec.name)
            if value is not None:
                object.__setattr__(self, spec.name, self._checked(spec, value))
        self._check_rows()

    @classmethod
    def _error(cls, found: str, expected: str, remedy: str = "", row: int | None = None) -> SessionError:
        return SessionError(cls.NAME, found, expected, remedy, row=row, stream=cls.NAME)

    @classmethod
    def specs(cls) -> list[Field[object]]:
        """The fields that are file columns."""
        return [f for f in fields(cls) if "columns" in f.metadata]

    def _checked(self, spec: Field[object], value: ArrayLike) -> Column:
        names, kind = spec.metadata["columns"], spec.metadata["kind"]
        if kind == "int":
            self._refuse_other_times(spec.name, value)
        owned = isinstance(value, np.ndarray) and value.base is None and not value.flags.writeable
        array: Column = np.array(value, dtype=_DTYPES[kind], copy=None if owned else True)
        shape = (len(self.t_ns),) if len(names) == 1 else (len(self.t_ns), len(names))
        if array.shape != shape:
            raise self._error(f"{spec.name} has shape {array.shape}", f"{shape}, one row per time stamp")
        if kind == "float":
            required = np.array(required_columns(spec))
            bad = np.isinf(array) | np.isnan(array) & (required if len(names) > 1 else required[0])
            if bad.any():
                where = np.argwhere(bad)[0]
                name = names[int(where[1]) if len(where) > 1 else 0]
                found = f"{name} is {array[tuple(where)]} at row {where[0]} ({int(bad.sum())} such values in all)"
                remedy = "correct the row, or add --repair nan to drop such rows, counted"
                raise self._error(found, "finite numbers", remedy, int(where[0]))
            self._check_limit(array, names, spec.metadata["limit"])
        array.flags.writeable = False
        return array

    @classmethod
    def _refuse_other_times(cls, name: str, value: object) -> None:
        """Whole numbers are given as such: of seconds and of datetimes the unit would be lost."""
        kind = np.asarray(value).dtype.kind
        if kind not in "iub" and np.size(np.asarray(value)):
            what = {"f": "floating numbers", "M": "datetimes", "m": "timedeltas"}.get(kind, "no numbers")
            remedy = "build the session with Session.from_arrays, which takes datetime64, or convert seconds with "
            raise InputTypeError(
                f"{cls.__name__}.{name}", f"holds {what}", "int64", remedy + "np.round(s * 1e9).astype('int64')"
            )

    def _check_limit(self, array: Column, names: tuple[str, ...], limit: float) -> None:
        beyond = np.argwhere(np.abs(array) > limit)
        if len(beyond):
            row, name = int(beyond[0][0]), names[int(beyond[0][1]) if len(names) > 1 else 0]
            at_s = (int(self.t_ns[row]) - int(self.t_ns[0])) / NS
            found = (
                f"{name} is {array[tuple(beyond[0])]:.6g} at row {row}, {at_s:.3f} s ({len(beyond)} such rows in all)"
            )
            raise self._error(
                found, f"-{limit:g} to {limit:g}", "correct the row or the unit, or leave the row out", row
            )

    def _check_stamps(self) -> None:
        """Stamps whose differences are numbers of 64 bits."""
        for spec in (spec for spec in self.specs() if spec.name.endswith("_ns")):
            name, stamps = spec.metadata["columns"][0], getattr(self, spec.name)
            if stamps is None:
                continue
            outside = np.flatnonzero((stamps < -LATEST_NS) | (stamps > LATEST_NS))
            if len(outside):
                row = int(outside[0])
                found = f"{name} is {stamps[row]} at row {row} ({len(outside)} such rows in all)"
                raise self._error(found, "nanoseconds of a clock", "check the unit of the stamps", row)

    def _check_rows(self) -> None:
        self._check_stamps()
        present = [name for name in self.ONE_OF if getattr(self, name) is not None]
        if self.ONE_OF and len(present) != 1:
            columns = " or ".join(", ".join(f.metadata["columns"]) for f in self.specs() if f.name in self.ONE_OF)
            found = "position columns missing" if not present else "both geodetic and local position columns"
            raise self._error(found, f"either {columns}")
        step = np.diff(self.t_ns)
        bad = np.flatnonzero(step <= 0 if self.UNIQUE_TIMES else step < 0)
        if len(bad):
            row = int(bad[0]) + 1
            strictly, rule = ("strictly ", "> 0") if self.UNIQUE_TIMES else ("", ">= 0")
            count = f"(step {int(step[row - 1])} ns; {len(bad)} such rows in all)"
            found = f"t_ns not {strictly}increasing at row {row} {count}"
            remedy = "correct the file, or add --repair order to sort rows and drop repeated stamps, counted"
            if step.min() < -NS:
                remedy += "; --repair clock where the clock was set back"
            if (step == 0).sum() > len(step) / 2:  # rounded to a unit longer than the period
                found, remedy = f"{found}: stamps look like whole seconds", "give t_ns in nanoseconds, with every digit"
            raise self._error(found, rule, remedy, row)
        early = np.zeros(0) if self.arrival_ns is None else np.flatnonzero(self.arrival_ns < self.t_ns)
        if len(early):
            row = int(early[0])
            lead = int(self.t_ns[row] - np.asarray(self.arrival_ns)[row])
            found = f"arrival_ns lies {lead} ns before t_ns at row {row} ({len(early)} such rows in all)"
            rule = "arrival at or after the time of the measurement"
            raise self._error(found, rule, "correct the column, or leave it out", row)
        for name in self.__dataclass_fields__:
            if "sigma" in name and getattr(self, name) is not None:
                sigma = np.asarray(getattr(self, name))
                low = np.argwhere(sigma <= 0)
                if len(low):
                    found, remedy = f"{name} is {sigma[tuple(low[0])]} at row {low[0][0]}", "leave unknown values empty"
                    raise self._error(found, "standard deviations > 0", remedy, int(low[0][0]))

    def take(self, rows: Mask | Indices | slice) -> Self:
        """The same stream with only these rows (mask, indices or slice)."""
        values = {f.name: getattr(self, f.name) for f in self.specs()}
        selected: dict[str, Any] = {name: None if value is None else value[rows] for name, value in values.items()}
        return type(self)(**selected, extra={name: value[rows] for name, value in self.extra.items()})

    def columns(self) -> Table:
        """File columns, in order; the inverse of `from_columns`."""
        out: Table = {}
        for spec in self.specs():
            value = getattr(self, spec.name)
            if value is None:
                continue
            names = spec.metadata["columns"]
            out.update({names[0]: value} if len(names) == 1 else dict(zip(names, value.T, strict=True)))
        return out | dict(self.extra)

    @classmethod
    def from_columns(cls, table: Mapping[str, Column]) -> Self:
        """Build from file columns. Unknown columns are kept in `extra`.

        Raises
        ------
        SessionError
            A required column, or a part of a column group, is missing; or a row is invalid.
        """
        values: dict[str, Any] = {}
        known: set[str] = set()
        for spec in cls.specs():
            names = spec.metadata["columns"]
            found = [name for name in names if name in table]
            known.update(found)
            if len(found) == len(names):
                rows = [cls._typed(n, table[n], spec.metadata["kind"]) for n in names]
                values[spec.name] = rows[0] if len(names) == 1 else _stacked(rows)
            elif found or spec.default is MISSING:
                missing = [name for name in names if name not in table]
                remedy = f"the file has {', '.join(table) or 'no columns'}; rename or add the column"
                raise cls._error(f"column {', '.join(missing)} is missing", f"columns {', '.join(names)}", remedy)
        return cls(**values, extra={name: np.asarray(table[name]) for name in table if name not in known})

    @classmethod
    def _typed(cls, name: str, column: Column, kind: str) -> Column:
        """A column in the type of its kind; a number that is not whole is no whole number."""
        column = np.asarray(column)
        if kind == "int" and column.dtype.kind == "f":
            bad = np.flatnonzero(~(np.abs(column) < 2.0**53) | (column != np.floor(column)))
            if len(bad):
                found = f"{name} is {column[bad[0]]!r} at row {bad[0]} ({len(bad)} such rows in all)"
                raise cls._error(found, "whole numbers with all their digits", "write integers", int(bad[0]))
        return np.asarray(column, dtype=_DTYPES[kind])


def _stacked(columns: list[Column]) -> Column:
    """Columns side by side (n, k), read-only; the array itself where they are the columns of a read-only one."""
    whole = columns[0].base
    if isinstance(whole, np.ndarray) and not whole.flags.writeable and whole.shape == (len(columns[0]), len(columns)):
        starts = [column.__array_interface__["data"] for column in columns]
        if starts == [column.__array_interface__["data"] for column in whole.T]:
            return whole
    rows = np.stack(columns, axis=-1)
    rows.flags.writeable = False
    return rows


HIGHEST_M = 1e6  # of a geodetic position
LLA = ("lat_deg", "lon_deg", "height_m")
ENU = ("e_m", "n_m", "u_m")


@dataclass(frozen=True, kw_only=True)
class Located(Stream):
    """Rows that name a place: `lla` (lat deg, lon deg, ellipsoidal height m) or `enu` metres of the local frame."""

    ABSOLUTE: ClassVar[bool] = True
    AIDING: ClassVar[bool] = True
    ONE_OF: ClassVar[tuple[str, ...]] = ("lla", "enu")

    lla: Floats | None = quantity(*LLA, optional=True)
    enu: Floats | None = quantity(*ENU, optional=True)

    def _check_rows(self) -> None:
        super()._check_rows()
        if self.lla is None:
            return
        self._check_limit(self.lla[:, 2], ("height_m",), HIGHEST_M)
        for name, limit, degrees in (("lat_deg", 90.0, self.lla[:, 0]), ("lon_deg", 360.0, self.lla[:, 1])):
            outside = np.flatnonzero(np.abs(degrees) > limit)
            if len(outside):
                row, value = int(outside[0]), float(degrees[outside[0]])
                looks = "degrees x 1e7" if abs(value) > 1e6 else "ddmm.mmmm of NMEA" if abs(value) < 36_000.0 else ""
                found = f"{name} is {value:.10g} at row {row} ({len(outside)} such rows in all)"
                found += f": it looks like {looks}" if looks else ""
                raise self._error(found, f"-{limit:g} to {limit:g} degrees", "give decimal degrees", row)

    @property
    def has_height(self) -> Mask:
        """Mask (n,) of the rows whose height is known."""
        rows = self.enu if self.enu is not None else self.lla
        assert rows is not None  # checked when the stream was built
        return np.isfinite(rows[:, 2])


@dataclass(frozen=True, kw_only=True)
class Positioned(Located):
    """Rows with a position of a sensor of the device, and its 1-sigma (n, 3) m. The height may be unknown (NaN): the
    row is a horizontal fix."""

    lla: Floats | None = quantity(*LLA, optional=True, nan="height_m")
    enu: Floats | None = quantity(*ENU, optional=True, nan="u_m")
    sigma: Floats | None = axes("sigma_{}_m", "enu", optional=True, nan=True)
