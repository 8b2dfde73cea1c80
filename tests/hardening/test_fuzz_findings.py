"""What fuzzing found: inputs that once ended in another error than a named one."""

import re
import sys
import zipfile
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "readers" / "apps"))
import exports

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError

GPX = '<gpx version="1.1"><trk><trkseg>{}</trkseg></trk></gpx>'
POINT = '<trkpt lat="52.5" lon="11.0"><time>{}-06-01T12:00:00Z</time></trkpt>'


def zip_of_a_later_version(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.csv", "t,x\n0,1\n")
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\1\2") + 6] = 236
    path.write_bytes(data)


def sensors_of_other_columns(path):
    exports.gnss_logger(path)
    names = "# Accel,utcTimeMillis,elapsedRealtimeNanos,a,b,c"
    path.write_text(re.sub("# Accel,utc.*", names, path.read_text()))


def zip_without_a_name(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("name", "t,x\n0,1\n")
    path.write_bytes(path.read_bytes().replace(b"name", b"\0ame"))


FINDINGS = {
    "log.zip": (zip_of_a_later_version, "cannot be unpacked"),
    "nameless.zip": (zip_without_a_name, "cannot be unpacked"),
    "scale.raw": (
        lambda path: path.write_bytes(exports.gopro_payload(0).replace(b"SCALs", b"SCALm") * 4),
        "SCAL has values of type 'm'",
    ),
    "few.raw": (
        lambda path: path.write_bytes(exports.gopro_payload(0).replace(b"GPS5", b"GPS9") * 4),
        "GPS9 has 5 columns, not 9",
    ),
    "old.gpx": (lambda path: path.write_text(GPX.format(POINT.format(1012))), "time is 1012-06-01T12:00:00.* at row 0"),
    "late.csv": (
        lambda path: path.write_text(
            "time,latitude,longitude\n2025-06-01T12:00:00Z,52.5,11\n9025-06-01T12:00:01Z,52.5,11\n"
        ),
        "at row 1",
    ),
    "sensors.txt": (sensors_of_other_columns, "Accel has columns utctimemillis, elapsedrealtimenanos, a, b, c"),
    "late.pos": (
        lambda path: path.write_text(
            "% program : RTKPOST\n%  GPST latitude(deg) longitude(deg) height(m) Q ns\n"
            "9025/06/01 12:00:00.000 52.5 11.0 100.0 1 8\n"
        ),
        "years 9025",
    ),
}


@pytest.mark.parametrize("name", FINDINGS)
def test_a_finding_is_refused(tmp_path, name):
    write, found = FINDINGS[name]
    write(tmp_path / name)
    with pytest.raises(SessionError, match=rf"{name}.*{found}.*; expected "):
        readers.read(tmp_path / name)
