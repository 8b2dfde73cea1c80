"""Match files of the SmartNav system of 2012: text, one match a row.

    time0  time1  x0  y0  x1  y1

Times in seconds of the session's clock. Coordinates in micrometres on the sensor, with lens distortion: the origin is
the centre of the picture, x points right and y down; the sensor of that camera is 4.54 mm wide and 3.42 mm high.
Columns are separated by commas, semicolons, tabs or blanks; lines that begin with # and a first line with names are
skipped.

    x_px = x_um / pitch + (width - 1) / 2,   pitch = 4540 um / width   (the centre of the first pixel is 0)
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from smartnav_graph.core.arrays import Floats, Times
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.files import replacing
from smartnav_graph.core.timebase import NS, nearest
from smartnav_graph.readers.text import first_lines, read_text
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.streams import Images, Matches

NAMES = ("time0", "time1", "x0", "y0", "x1", "y1")
SENSOR_UM = np.array([4540.0, 3420.0])  # width, height of the sensitive area
# Decimal places written: a nanometre, far below the noise of any match.
PLACES = 3
WITHIN_S = 0.02  # largest difference between the time of a match and that of its image


class Rows(NamedTuple):
    """Rows of a file: t0_ns, t1_ns (n,); xy0_um, xy1_um (n, 2) on the sensor."""

    t0_ns: Times
    t1_ns: Times
    xy0_um: Floats
    xy1_um: Floats


def read_match_file(path: str | Path) -> Rows:
    """The rows of a match file.

    Raises
    ------
    SessionError
        Missing or unreadable file, rows of another length, a cell that is no number, a point outside the sensor.
    """
    path = Path(path)
    named = any(line.lower().startswith(NAMES[0]) for line in first_lines(path, 1))
    table = read_text(path, names=None if named else NAMES)
    table.require(NAMES)
    rows = Rows(table.times("time0"), table.times("time1"), table.floats("x0", "y0"), table.floats("x1", "y1"))
    half = SENSOR_UM / 2.0
    for label, xy in (("0", rows.xy0_um), ("1", rows.xy1_um)):
        bad = np.argwhere(~(np.abs(xy) <= half))
        if len(bad):
            row, axis = map(int, bad[0])
            found = f"{'xy'[axis]}{label} is {xy[row, axis]:g} at row {row} ({len(bad)} such values in all)"
            expected = f"-{half[axis]:g} to {half[axis]:g} um from the picture's centre"
            raise SessionError(path, found, expected, "give um on the sensor, x right, y down", row=row)
    return rows


def to_matches(rows: Rows, images: Images, name: str, camera: Camera) -> tuple[Matches, int]:
    """Matches between the session's images, in undistorted normalised coordinates, and the number of other rows.

    Parameters
    ----------
    images, name : those of the session, and the camera; each time belongs to the nearest stamp, at most `WITHIN_S` away
    camera : of that name

    Raises
    ------
    SessionError
        No row belongs to two images.
    """
    mine = np.flatnonzero(images.camera == name)
    if not len(mine):
        raise SessionError("images", f"none of camera {name}", f"one of {', '.join(sorted(set(images.camera)))}")
    stamps = images.t_ns[mine]
    first, second = nearest(rows.t0_ns, stamps), nearest(rows.t1_ns, stamps)
    apart = np.maximum(np.abs(stamps[first] - rows.t0_ns), np.abs(stamps[second] - rows.t1_ns))
    good = (apart <= WITHIN_S * NS) & (first != second)
    if not good.any():
        spans = [f"{t.min() / NS:.3f} to {t.max() / NS:.3f} s" for t in (rows.t0_ns, stamps)]
        expected = f"times within {WITHIN_S:g} s of two images; those are from {spans[1]}"
        raise SessionError("match file", f"no row belongs to two images; times from {spans[0]}", expected)
    used = np.flatnonzero(good)
    used = used[np.lexsort((second[used], first[used]))]
    at = [mine[first[used]], mine[second[used]]]
    pitch, centre = _pitch_and_centre(camera)
    xy = [camera.normalised(um[used] / pitch + centre) for um in (rows.xy0_um, rows.xy1_um)]
    matches = Matches(
        t_ns=images.t_ns[at[0]],
        t_1_ns=images.t_ns[at[1]],
        image_id_0=images.image_id[at[0]],
        image_id_1=images.image_id[at[1]],
        xy0_n=xy[0],
        xy1_n=xy[1],
    )
    return matches, int((~good).sum())


def _pitch_and_centre(camera: Camera) -> tuple[Floats, Floats]:
    """Size of a pixel (2,) um, and pixel coordinates (2,) of the centre of the picture."""
    size = np.array([camera.width, camera.height])
    return SENSOR_UM / size, (size - 1) / 2.0


def of_images(matches: Matches, image_ids: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which matches (n,) are between two of these images."""
    return np.isin(matches.image_id_0, image_ids) & np.isin(matches.image_id_1, image_ids)


def on_sensor(matches: Matches, camera: Camera) -> NDArray[np.bool_]:
    """Which matches (n,) have both points on the sensor: noise may move those at its edges beyond it."""
    pitch, centre = _pitch_and_centre(camera)
    um = np.abs([(camera.pixels(xy) - centre) * pitch for xy in (matches.xy0_n, matches.xy1_n)])
    return np.asarray((um <= SENSOR_UM / 2.0).all(axis=(0, 2)))


def write_match_file(matches: Matches, path: str | Path, camera: Camera, *, force: bool = False) -> None:
    """Write matches of one camera as a match file: times with nine decimal places, coordinates with three.

    Raises
    ------
    SessionError
        The file exists and `force` is not given, or cannot be written.
    """
    pitch, centre = _pitch_and_centre(camera)
    um = [(camera.pixels(xy) - centre) * pitch for xy in (matches.xy0_n, matches.xy1_n)]
    lines = [f"# {' '.join(NAMES)}: s, um from the picture's centre, x right, y down"]
    for t0, t1, one, other in zip(matches.t_ns.tolist(), matches.t_1_ns.tolist(), *um, strict=True):
        places = " ".join(_fixed(value) for value in (*one, *other))
        lines.append(f"{_seconds(t0)} {_seconds(t1)} {places}")
    with replacing(path, force=force) as new:
        new.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _fixed(value: float) -> str:
    """Decimal text without a negative zero."""
    return f"{round(float(value), PLACES) + 0.0:.{PLACES}f}"


def _seconds(t_ns: int) -> str:
    """Exact decimal text."""
    whole, rest = divmod(abs(t_ns), NS)
    return f"{'-' if t_ns < 0 else ''}{whole}.{rest:09d}"
