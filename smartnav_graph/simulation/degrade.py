"""A real session with simulated faults: noisier fixes, outliers, missing, jittered, repeated and broken rows.

Faults that a valid session can hold (noise, outliers, missing rows) are in what `degrade` returns. Row faults break a
stream's own rules, so they appear only on disk: `write_degraded` writes the session and then spoils imu.parquet, and
declares the repairs in session.toml, so that loading it repairs and counts. Every fault has its own random numbers:
adding one leaves the others as they were.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from smartnav_graph.core.arrays import Floats, Indices, Table
from smartnav_graph.core.errors import ConfigError
from smartnav_graph.core.files import replacing, write_table
from smartnav_graph.core.progress import Progress, silent
from smartnav_graph.session import folder as session_folder
from smartnav_graph.session import repair
from smartnav_graph.session.session import Session
from smartnav_graph.session.streams import GnssFix, Imu, Reference
from smartnav_graph.simulation import fixes
from smartnav_graph.simulation.fixes import Outliers

_FAULTS = ("gnss_white", "gnss_gm", "outliers", "jitter", "rows", "nan")


@dataclass(frozen=True, kw_only=True)
class Degrade:
    """The faults; none by default.

    gnss_white m, gnss_gm (sigma m, correlation time s): per horizontal axis, vertical 1.5 times as large. outliers of
    the fixes. drop_imu: (start s, length s) of missing inertial rows, counted from the session's time zero. jitter_ms:
    1-sigma of normal stamp errors. duplicates, swaps, nan_rows: shares of the inertial rows that are repeated, swapped
    with the next one, or have one value that is not a number; no row has two of these faults.
    """

    gnss_white: float | None = None
    gnss_gm: tuple[float, float] | None = None
    outliers: Outliers | None = None
    drop_imu: tuple[tuple[float, float], ...] = ()
    jitter_ms: float = 0.0
    duplicates: float = 0.0
    swaps: float = 0.0
    nan_rows: float = 0.0

    def __post_init__(self) -> None:
        if self.gnss_white is not None:
            _positive("--gnss-white", self.gnss_white)
        for value in self.gnss_gm or ():
            _positive("--gnss-gm", value)
        for start, length in self.drop_imu:
            _positive("--drop-imu", length)
            if start < 0:
                raise ConfigError("--drop-imu", f"start {start} s", "seconds from the session's start, >= 0")
        if not (np.isfinite(self.jitter_ms) and self.jitter_ms >= 0):
            raise ConfigError("--jitter-ms", f"{self.jitter_ms} ms", "a number >= 0")
        for name in ("duplicates", "swaps", "nan_rows"):
            if not 0.0 <= getattr(self, name) <= 0.25:
                raise ConfigError(f"--{name.replace('_', '-')}", f"share {getattr(self, name)}", "0 to 0.25")

    @property
    def repairs(self) -> tuple[str, ...]:
        """The repairs that the row faults ask for, in the order they are applied."""
        wanted = {"stamps"} if self.jitter_ms else set()
        if self.jitter_ms or self.duplicates or self.swaps or self.nan_rows:
            wanted |= {"nan", "order"}
        return repair.check_names(wanted)


def _positive(option: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0):
        raise ConfigError(option, f"{value}", "a number > 0")


def parse_pair(text: str, option: str) -> tuple[float, float]:
    """Two numbers separated by a comma, such as ``4,60``.

    Raises
    ------
    ConfigError
        Anything else; it names the option.
    """
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(option, repr(text), "two numbers separated by a comma, such as 4,60") from error
    return first, second


def parse_outliers(text: str) -> Outliers:
    """``isolated:SHARE:LOW-HIGH`` or ``burst:SHARE:LOW-HIGH``, such as ``isolated:0.05:50-200``.

    Raises
    ------
    ConfigError
        Anything else.
    """
    try:
        kind, share, sizes = text.split(":")
        low, high = sizes.split("-")
        numbers = float(share), float(low), float(high)
    except ValueError as error:
        expected = "isolated:SHARE:LOW-HIGH or burst:SHARE:LOW-HIGH, such as isolated:0.05:50-200"
        raise ConfigError("--outliers", repr(text), expected) from error
    return Outliers(kind, *numbers)


def _rng(seed: int, fault: str) -> np.random.Generator:
    return np.random.default_rng((seed, _FAULTS.index(fault)))


def degrade(whole: Session, options: Degrade, seed: int = 0) -> Session:
    """The session with noisier fixes, outliers and missing inertial rows; streams not concerned are untouched.

    Added white noise s goes into the sigma columns: sqrt(sigma^2 + s^2), or s where no sigma was known; the
    Gauss-Markov part and outliers do not. Extra column `is_outlier` is 1 for outliers. A session without reference
    gets the clean fixes as one.

    Raises
    ------
    ConfigError
        A fault asked of a stream that the session has not, or an IMU gap outside of the recording.
    """
    faulty = whole
    if options.gnss_white is not None or options.gnss_gm is not None or options.outliers is not None:
        faulty = _degrade_fixes(faulty, options, seed)
    if options.drop_imu:
        faulty = faulty.replace(imu=_drop(faulty, options.drop_imu))
    return faulty


def _degrade_fixes(whole: Session, options: Degrade, seed: int) -> Session:
    fix = whole.gnss
    if fix is None:
        raise ConfigError("degrade", "no gnss stream", "a session with fixes", "leave the gnss options out")
    clean, n = whole.nav_position(fix), len(fix)
    noisy, sigma, extra = clean, fix.sigma, dict(fix.extra)
    if options.gnss_white is not None:
        noisy = noisy + fixes.white(n, options.gnss_white, _rng(seed, "gnss_white"))
        known = np.zeros((n, 3)) if sigma is None else np.nan_to_num(sigma)
        sigma = np.hypot(known, options.gnss_white * fixes.AXES)
    if options.gnss_gm is not None:
        noisy = noisy + fixes.gauss_markov(fix.t_ns, *options.gnss_gm, _rng(seed, "gnss_gm"))
    if options.outliers is not None:
        errors, mask = fixes.outlier_errors(fix.t_ns, options.outliers, _rng(seed, "outliers"))
        noisy = noisy + errors
        extra["is_outlier"] = (mask | (np.asarray(extra.get("is_outlier", 0)) == 1)).astype(np.int64)
    known_truth = whole.reference or Reference(t_ns=fix.t_ns, enu=clean)
    return whole.replace(gnss=_moved(whole, fix, noisy, sigma, extra), reference=known_truth)


def _moved(whole: Session, fix: GnssFix, enu: Floats, sigma: Floats | None, extra: Table) -> GnssFix:
    """The fix stream at other places, geodetic or local as it was."""
    values = {spec.name: getattr(fix, spec.name) for spec in fix.specs()} | {"sigma": sigma, "extra": extra}
    if fix.enu is not None:
        return GnssFix(**values | {"enu": enu})
    assert whole.frame is not None  # a session with geodetic fixes has an origin
    return GnssFix(**values | {"lla": whole.frame.lla_from_nav(enu)})


def _drop(whole: Session, gaps: tuple[tuple[float, float], ...]) -> Imu:
    imu = whole.require_imu()
    t = whole.seconds(imu.t_ns)
    kept = np.ones(len(t), dtype=bool)
    for start, length in gaps:
        hit = (t >= start) & (t < start + length)
        if not hit.any():
            raise ConfigError("--drop-imu", f"{start},{length} hits no row", f"a gap within 0 .. {t[-1]:.3f} s")
        kept &= ~hit
    if kept.sum() < 2:
        raise ConfigError("--drop-imu", f"{int(kept.sum())} rows left", "at least two", "drop less")
    return imu.take(kept)


def spoil_rows(table: Table, options: Degrade, seed: int = 0) -> Table:
    """IMU columns with jittered stamps, repeated and swapped rows and NaN values; the input is not changed."""
    n = len(table["t_ns"])
    rows = {name: np.array(column) for name, column in table.items()}
    if options.jitter_ms:
        jitter = options.jitter_ms * 1e6 * _rng(seed, "jitter").standard_normal(n)
        rows["t_ns"] = rows["t_ns"] + np.rint(jitter).astype(np.int64)
    broken, repeated, swapped = _disjoint_rows(n, options, _rng(seed, "rows"))
    axes = [name for spec in Imu.specs() if spec.name in ("gyro", "accel") for name in spec.metadata["columns"]]
    for row, axis in zip(broken, _rng(seed, "nan").integers(len(axes), size=len(broken)), strict=True):
        rows[axes[axis]][row] = np.nan
    order = np.arange(n)
    order[swapped], order[swapped + 1] = swapped + 1, swapped
    order = np.repeat(order, 1 + np.isin(np.arange(n), repeated))
    return {name: column[order] for name, column in rows.items()}


def _disjoint_rows(n: int, options: Degrade, rng: np.random.Generator) -> list[Indices]:
    """Rows with NaN, rows to repeat, first rows of swapped pairs: no row in two of them, so that counts stay exact."""
    counts = [round(share * n) for share in (options.nan_rows, options.duplicates, options.swaps)]
    kinds = rng.permutation(np.repeat([0, 1, 2], counts))
    lengths = [2 if kind == 2 else 1 for kind in kinds]
    starts = np.array(fixes.place_runs(n, lengths, rng, apart=False), dtype=np.intp)
    return [starts[kinds == kind] for kind in range(3)]


def write_degraded(
    whole: Session, options: Degrade, seed: int, path: str | Path, *, force: bool = False, progress: Progress = silent
) -> Session:
    """Write the degraded session folder, row faults included; gives the valid part, as `degrade` does.

    Raises
    ------
    ConfigError
        As `degrade`.
    SessionError
        `path` exists and `force` is not given, the system refuses to write, or there is no imu to spoil.
    """
    progress("spoiling", 0, 0)
    faulty = degrade(whole, options, seed)
    repairs = repair.check_names({*faulty.repairs, *options.repairs})
    with replacing(path, force=force) as folder:
        session_folder.save(faulty.replace(repairs=repairs), folder, progress=progress)
        if options.repairs:
            table = spoil_rows(faulty.require_imu().columns(), options, seed)
            write_table(table, folder / "imu.parquet")
    return faulty
