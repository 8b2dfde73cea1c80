"""Solutions of RTKLIB in its time systems and forms."""

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS, utc_from_gps

COLUMNS = (
    "latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m) age(s) ratio"
)
VALUES = "  52.500000000   11.500000000   100.2500   1  12   0.0110   0.0120   0.0250   0.001  0.001  0.001  0.00  3.2"
NOON = int(np.datetime64("2025-06-01T12:00:00", "ns").astype(np.int64))


def read(
    tmp_path,
    system="GPST",
    times=("2025/06/01 12:00:18.000", "2025/06/01 12:00:18.500"),
    columns=COLUMNS,
    values=VALUES,
):
    rows = [f"{time} {values}" for time in times]
    (tmp_path / "a.pos").write_text("\n".join(["% program   : made up", f"%  {system}    {columns}", *rows, ""]))
    return readers.read(tmp_path / "a.pos")


def test_gps_time_sigmas_and_quality(tmp_path):
    solution = read(tmp_path)
    assert solution.clock_epoch == "gps"
    assert utc_from_gps(solution.gnss.t_ns).tolist() == [NOON, NOON + NS // 2]  # 18 leap seconds
    np.testing.assert_allclose(solution.gnss.lla[0], [52.5, 11.5, 100.25])
    np.testing.assert_allclose(solution.gnss.sigma[0], [0.012, 0.011, 0.025])  # file: north, east, up
    assert solution.gnss.fix_type.tolist() == [1, 1]


def test_other_time_systems(tmp_path):
    assert read(tmp_path, "UTC").gnss.t_ns[0] == NOON + 18 * NS
    assert read(tmp_path, "JST").gnss.t_ns[0] == NOON + 18 * NS - 9 * 3600 * NS
    week = read(tmp_path, "GPST", ("2369 43218.000", "2369 43218.500"))
    assert week.gnss.t_ns.tolist() == read(tmp_path).gnss.t_ns.tolist()


def test_geocentric(tmp_path):
    import pyproj

    x, y, z = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(11.5, 52.5, 100.25)
    columns = COLUMNS.replace("latitude(deg) longitude(deg)  height(m)", "x-ecef(m) y-ecef(m) z-ecef(m)")
    gnss = read(tmp_path, columns=columns, values=f"{x:.4f} {y:.4f} {z:.4f} " + VALUES.split(maxsplit=3)[3]).gnss
    np.testing.assert_allclose(gnss.lla[0], [52.5, 11.5, 100.25], atol=1e-3)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"values": "52.5 11.5"}, "row 0 has 4 cells; expected 15"),
        ({"times": ("2025/06/01 12:61",)}, "a time is not readable"),
        ({"times": ()}, "has no rows"),
        ({"columns": COLUMNS.replace("latitude(deg)", "e-baseline(m)")}, "holds a baseline"),
    ],
)
def test_faults_are_named(tmp_path, changes, text):
    with pytest.raises(SessionError) as caught:
        read(tmp_path, **changes)
    assert text in str(caught.value)


def test_real_solution(dataset):
    solution = sn.load(dataset("phone_logs") / "instinct_vn310" / "rtk.pos")
    assert solution.clock_epoch == "gps" and len(solution.gnss) == 2
    np.testing.assert_allclose(solution.gnss.lla[0], [29.999994371, 94.999992812, -9.3615])
    np.testing.assert_allclose(solution.gnss.velocity[0], [0.00473, 0.01216, -0.00324])
