"""GPX: tracks with and without what loggers add."""

import numpy as np
import pytest

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError

HEAD = '<?xml version="1.0"?><gpx version="1.1" creator="test" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
TAIL = "</trkseg></trk></gpx>"
START = int(np.datetime64("2025-06-01T10:00:00", "ns").astype(np.int64))


def point(seconds, inside="", lat=52.5):
    return f'<trkpt lat="{lat}" lon="11.5"><ele>60.5</ele><time>2025-06-01T10:00:{seconds}Z</time>{inside}</trkpt>'


def read(tmp_path, *points, head=HEAD):
    (tmp_path / "track.gpx").write_text(head + "".join(points) + TAIL)
    return readers.read(tmp_path / "track.gpx")


def test_positions_and_times(tmp_path):
    fixes = read(tmp_path, point("00"), point("01.250", lat=52.501))
    assert fixes.clock_epoch == "unix" and fixes.gnss.t_ns.tolist() == [START, START + 1_250_000_000]
    np.testing.assert_allclose(fixes.gnss.lla, [[52.5, 11.5, 60.5], [52.501, 11.5, 60.5]])
    assert fixes.gnss.sigma is None and fixes.gnss.velocity is None


def test_geoid_dilution_and_extensions(tmp_path):
    more = "<geoidheight>40.0</geoidheight><hdop>1.5</hdop><vdop>2.0</vdop>"
    more += "<extensions><speed>3.0</speed><course>90.0</course></extensions>"
    gnss = read(tmp_path, point("00", more), point("01", more, lat=52.501)).gnss
    assert gnss.lla[0, 2] == 100.5
    np.testing.assert_allclose(gnss.sigma[0], [1.5 * 4.0 / np.sqrt(2.0)] * 2 + [8.0])
    np.testing.assert_allclose(gnss.velocity[0, :2], [3.0, 0.0], atol=1e-12)


def test_an_accuracy_precedes_the_dilution(tmp_path):
    more = "<hdop>1.5</hdop><extensions><accuracy>3.02</accuracy></extensions>"
    assert read(tmp_path, point("00", more)).gnss.sigma[0, 0] == pytest.approx(2.0, abs=0.01)  # 68 % radius / 1.51


def test_points_without_time_and_damage(tmp_path):
    assert read(tmp_path, point("00"), '<trkpt lat="1" lon="2"/>').dropped["gnss"] == {"points without a time": 1}
    with pytest.raises(SessionError, match=r"holds no point with a time \(1 track points\)"):
        read(tmp_path, '<trkpt lat="1" lon="2"/>')
    (tmp_path / "torn.gpx").write_text(HEAD + point("00"))
    with pytest.raises(SessionError, match="is no GPX"):
        readers.read(tmp_path / "torn.gpx")
