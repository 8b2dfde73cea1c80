"""NMEA: what each sentence gives, what is no fix, and the date of sentences without one."""

from functools import reduce

import numpy as np
import pytest

import smartnav_graph as sn
from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS

JUNE = int(np.datetime64("2025-06-01T23:59:58", "ns").astype(np.int64))


def sentence(body):
    return f"${body}*{reduce(lambda a, b: a ^ b, body.encode()):02X}"


def gga(time, lat="5230.0000", lon="01130.0000", quality=1, hdop="0.8", alt="60.0", sep="40.0"):
    return sentence(f"GPGGA,{time},{lat},N,{lon},E,{quality},12,{hdop},{alt},M,{sep},M,,")


def rmc(time, date="010625", speed="10.0", course="90.0", status="A"):
    return sentence(f"GPRMC,{time},{status},5230.0000,N,01130.0000,E,{speed},{course},{date},,,A")


def read(tmp_path, *lines, end="\r\n"):
    (tmp_path / "log.nmea").write_bytes(end.join(lines).encode())
    return readers.read(tmp_path / "log.nmea")


def test_position_height_sigma_and_velocity(tmp_path):
    fixes = read(tmp_path, gga("235958.00"), rmc("235958.00"), gga("235959.00", lat="5230.0600"), rmc("235959.00"))
    gnss = fixes.gnss
    assert fixes.clock_epoch == "unix" and gnss.t_ns.tolist() == [JUNE, JUNE + NS]
    np.testing.assert_allclose(gnss.lla, [[52.5, 11.5, 100.0], [52.501, 11.5, 100.0]], atol=1e-9)  # 60 + 40 m
    h = 0.8 * 4.0 / np.sqrt(2.0)  # dilution of both axes, range error of a code receiver
    np.testing.assert_allclose(gnss.sigma[0], [h, h, 2.0 * h])
    np.testing.assert_allclose(gnss.velocity[0, :2], [10.0 * 1852.0 / 3600.0, 0.0], atol=1e-9)
    assert gnss.fix_type.tolist() == [1, 1]


def test_gst_is_preferred_and_carrier_phase_is_small(tmp_path):
    gst = sentence("GPGST,235958.00,,,,,0.011,0.012,0.025")
    gnss = read(tmp_path, rmc("235958.00"), gga("235958.00", quality=4), gst, gga("235959.00", quality=4)).gnss
    np.testing.assert_allclose(gnss.sigma[0], [0.012, 0.011, 0.025])
    assert gnss.sigma[1, 0] == pytest.approx(0.8 * 0.02 / np.sqrt(2.0))


def test_midnight_and_sentences_before_the_first_date(tmp_path):
    gnss = read(tmp_path, gga("235958.00"), gga("235959.50"), rmc("235959.50"), gga("000001.00", lat="5230.1")).gnss
    assert (gnss.t_ns - JUNE).tolist() == [0, 1.5 * NS, 3 * NS]


def test_without_date_the_clock_is_unknown(tmp_path):
    fixes = read(tmp_path, gga("000010.00"), gga("000011.00", lat="5230.1"))
    assert fixes.clock_epoch == "unknown" and fixes.gnss.t_ns.tolist() == [10 * NS, 11 * NS]


def test_invalid_fixes_and_broken_sentences_are_counted(tmp_path):
    broken = gga("235959.00").replace("5230", "5231")
    lines = ["NMEA," + rmc("235958.00") + ",1748822398000", broken, gga("000000.00", quality=0), "$GPGGA,torn"]
    counts = read(tmp_path, *lines).dropped["gnss"]
    assert counts["sentences with a wrong checksum or field"] == 2 and counts["epochs without a fix"] == 1


def test_no_fix_at_all(tmp_path):
    with pytest.raises(SessionError, match=r"holds no valid fix \(1 epochs, all of quality 0 or status V\)"):
        read(tmp_path, gga("235958.00", quality=0))


def test_course_does_not_matter_at_rest(tmp_path):
    velocity = read(tmp_path, rmc("235958.00", speed="0.0", course="")).gnss.velocity
    assert velocity[0, :2].tolist() == [0.0, 0.0]


def test_heights_above_the_sea_are_marked(tmp_path):
    session = read(tmp_path, gga("235958.00", sep=""))
    assert session.gnss.lla[0, 2] == 60.0 and session.mount("gnss").above_sea
    assert not read(tmp_path, gga("235958.00")).mount("gnss").above_sea


def test_real_logs(dataset):
    logs = dataset("phone_logs")
    phone = sn.load(logs / "gnsslogger_nmea_gsdc" / "pixel6.nmea").gnss
    assert len(phone) == 48 and phone.t_ns[0] == 1_699_400_577 * NS  # the logger's own stamp is .56 s later
    assert phone.lla[0, 2] == pytest.approx(51.9 - 28.4)
    other = sn.load(logs / "hyperimu" / "nmea_1.csv")
    assert len(other.gnss) > 200 and other.dropped["gnss"]["epochs without a fix"] == 3
