"""KF-GINS text: increments, sigmas north east down, time of week; what is no such file."""

import numpy as np
import pytest

from smartnav_graph import readers
from smartnav_graph.core.errors import SessionError

FIX = "{:.3f}    30.4447858054   114.4718661162     21.095    0.010    0.009    0.019 "


def fixes(first=456_250.0, rows=60, wrap=604_800):
    return "\n".join(FIX.format((first + i) % wrap) for i in range(rows)) + "\n"


def inertial(rows=400, hz=200.0):
    t = 456_250.0 + np.arange(1, rows + 1) / hz
    return "\n".join(f"{s:.4f} {0.1 / hz:.9f} {-0.2 / hz:.9f} {i * 1e-6:.9f} 0.001 0.0 {-9.8 / hz:.7f}" for i, s in
                     enumerate(t)) + "\n"  # fmt: skip


def test_fixes_in_order_north_east_down(tmp_path):
    path = tmp_path / "GNSS-RTK.txt"
    path.write_text(fixes())
    session = readers.read(path)
    assert session.gnss.t_ns[[0, 1]].tolist() == [456_250 * 10**9, 456_251 * 10**9]
    assert session.gnss.lla[0].tolist() == [30.4447858054, 114.4718661162, 21.095]
    assert session.gnss.sigma[0].tolist() == [0.009, 0.010, 0.019]
    assert session.clock_epoch == "unknown"  # the week is not in the file


def test_increments_become_rates_and_specific_force(tmp_path):
    (tmp_path / "imu.txt").write_text(inertial())
    (tmp_path / "GNSS.txt").write_text(fixes(rows=5))
    session = readers.read(tmp_path)
    assert (len(session.imu), len(session.gnss)) == (400, 5)
    np.testing.assert_allclose(session.imu.gyro[100], [0.1, -0.2, 0.02], atol=1e-6)
    np.testing.assert_allclose(session.imu.accel[100], [0.2, 0.0, -9.8], atol=1e-4)
    assert (session.device.forward, session.device.up) == ("+x", "-z")


def test_the_end_of_the_week(tmp_path, warned):
    path = tmp_path / "GNSS.txt"
    path.write_text(fixes(first=604_790.0, rows=80))
    gnss = readers.read(path).gnss
    assert (np.diff(gnss.t_ns) == 10**9).all() and len(gnss) == 80
    assert "begins anew at row 10" in warned()


@pytest.mark.parametrize(
    "text",
    [
        "1 2 3\n4 5 6\n7 8 9\n",
        fixes().replace("0.010", "0.000"),  # a sigma of zero
        fixes().replace("30.44", "95.44"),  # no latitude
        "".join(f"{1.7e9 + i} 1 2 3 0 0 0\n" for i in range(9)),  # Unix time
    ],
)
def test_other_numbers_are_no_such_file(tmp_path, text):
    path = tmp_path / "numbers.txt"
    path.write_text(text)
    assert not readers.READERS["kf-gins"].matches(str(path))


def test_two_files_of_one_kind_are_refused(tmp_path):
    for name in ("a.txt", "b.txt"):
        (tmp_path / name).write_text(fixes())
    with pytest.raises(SessionError, match=r"holds a.txt, b.txt; expected one file of fixes"):
        readers.read(tmp_path)


def test_the_fixes_of_both_programs(dataset):
    folder = dataset("phone_logs") / "kfgins_obgins"
    for name, rows in (("GNSS-RTK.txt", 3413), ("GNSS_RTK.pos", 1616)):
        gnss = readers.read(folder / name).gnss
        assert len(gnss) in (rows, rows - 1) and np.median(np.diff(gnss.t_ns)) == 10**9
        assert 0.005 < np.median(gnss.sigma[:, 0]) < 0.1
