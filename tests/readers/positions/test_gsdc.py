"""device_gnss.csv: one fix an epoch, of several rows."""

import numpy as np
import pytest

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError

HEADING = "MessageType,utcTimeMillis,Svid,WlsPositionXEcefMeters,WlsPositionYEcefMeters,WlsPositionZEcefMeters"


def write(path, rows):
    path.write_text("\n".join([HEADING, *rows]) + "\n")
    return path


def test_epochs(tmp_path):
    """A point on the equator at 90 degrees east, 100 m above the ellipsoid, then 1 m further east."""
    first, second = "1700000000000,{},0.0,6378237.0,0.0", "1700000001000,{},-1.0,6378237.0,0.0"
    rows = [f"Raw,{first.format(3)}", f"Raw,{first.format(7)}", f"Raw,{second.format(3)}", "Raw,1700000002000,3,,,"]
    path = write(tmp_path / "device_gnss.csv", rows)
    assert readers.find(path).name == "gsdc"
    session = readers.read(path)
    assert session.gnss.t_ns.tolist() == [1_700_000_000 * 10**9, 1_700_000_001 * 10**9]
    np.testing.assert_allclose(session.gnss.lla[0], [0.0, 90.0, 100.0], atol=1e-6)
    np.testing.assert_allclose(session.nav_position(session.gnss)[1, 0], 1.0, atol=1e-4)
    assert session.clock_epoch == "unix" and session.dropped["gnss"] == {"epochs without a position": 1}


def test_without_positions(tmp_path):
    with pytest.raises(SessionError, match="holds no position"):
        readers.read(write(tmp_path / "x.csv", ["Raw,1700000000000,3,,,"]))


def test_a_real_file(dataset):
    session = readers.read(dataset("phone_logs") / "gnsslogger_nmea_gsdc" / "device_gnss.csv")
    step = np.diff(session.gnss.t_ns)
    assert len(session.gnss) > 2 and np.median(step) == 1_000_000_000
    assert np.ptp(session.nav_position(session.gnss), axis=0).max() < 1000.0  # m
