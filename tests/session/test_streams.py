"""Streams check themselves: shapes, numbers, order, sigmas; what they keep they keep read-only and exactly."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from filled import example

from smartnav_graph.core.errors import SessionError
from smartnav_graph.session.streams import STREAMS, ControlPoint, GnssFix, Imu, PoseFix, StaticPeriod


def message(error: pytest.ExceptionInfo[SessionError]) -> str:
    return str(error.value)


def test_the_table_names_every_stream_by_its_file():
    assert list(STREAMS) == [kind.NAME for kind in STREAMS.values()]


@pytest.mark.parametrize("name", STREAMS)
@pytest.mark.parametrize("optional", [False, True])
def test_columns_and_back_is_the_same_stream(name, optional):
    stream = example(STREAMS[name], optional=optional)
    back = STREAMS[name].from_columns(stream.columns())
    assert next(iter(stream.columns())) == "t_ns"
    for spec in stream.specs():
        one, other = getattr(stream, spec.name), getattr(back, spec.name)
        assert (one is None) == (other is None)
        if one is not None:
            assert one.dtype == other.dtype and one.dtype in (np.float64, np.int64, np.object_)
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", STREAMS)
def test_arrays_are_read_only_and_a_copy(name):
    stream = example(STREAMS[name])
    for spec in stream.specs():
        array = getattr(stream, spec.name)
        if array is not None:
            with pytest.raises(ValueError, match="read-only"):
                array[0] = array[0]
    mine = np.arange(3)
    kept = Imu(t_ns=mine, gyro=np.zeros((3, 3)), accel=np.zeros((3, 3)))
    mine[0] = 99
    assert kept.t_ns[0] == 0 and mine.flags.writeable
    with pytest.raises(dataclasses.FrozenInstanceError):
        kept.t_ns = mine


def test_a_row_known_before_its_own_time():
    fix = example(GnssFix)
    early = np.array(fix.t_ns)
    early[[3, 5]] -= 7
    with pytest.raises(SessionError, match=r"^gnss: arrival_ns lies 7 ns before t_ns at row 3 \(2 such rows") as error:
        dataclasses.replace(fix, arrival_ns=early)
    assert (error.value.row, error.value.stream) == (3, "gnss")
    dataclasses.replace(fix, arrival_ns=fix.t_ns)


def test_taking_rows_takes_them_everywhere():
    fix = dataclasses.replace(example(GnssFix), extra={"satellites": np.arange(6)})
    for rows in (np.array([0, 2, 5]), np.array([True, False, True, False, False, True])):
        part = fix.take(rows)
        np.testing.assert_array_equal(part.t_ns, fix.t_ns[rows])
        np.testing.assert_array_equal(part.enu, fix.enu[rows])
        np.testing.assert_array_equal(part.extra["satellites"], [0, 2, 5])
    assert part.lla is None and len(fix.take(slice(0, 0))) == 0


def test_unknown_columns_are_kept():
    table = {**example(Imu).columns(), "temperature_raw": np.arange(6), "note": np.array(list("abcdef"), dtype=object)}
    stream = Imu.from_columns(table)
    assert set(stream.extra) == {"temperature_raw", "note"}
    assert list(stream.columns()) == list(table)


# --- bad input --------------------------------------------------------------------------------------------------------


def imu_columns(**changes) -> dict:
    return {**{k: np.array(v) for k, v in example(Imu).columns().items()}, **changes}


def test_a_wrong_column_is_named_with_what_is_there():
    table = imu_columns()
    table["gyro_z"] = table.pop("gyro_z_rad_s")
    with pytest.raises(SessionError, match=r"^imu: column gyro_z_rad_s is missing; expected columns gyro_x_rad_s") as e:
        Imu.from_columns(table)
    assert "the file has t_ns, " in message(e) and message(e).endswith("gyro_z; rename or add the column")


def test_a_part_of_an_optional_group_is_not_enough():
    table = dict(example(GnssFix, optional=False).columns(), sigma_e_m=np.ones(6))
    with pytest.raises(SessionError, match="gnss: column sigma_n_m, sigma_u_m is missing"):
        GnssFix.from_columns(table)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_no_number_names_column_row_and_remedy(bad):
    table = imu_columns()
    table["accel_y_m_s2"][[3, 5]] = bad
    with pytest.raises(SessionError) as e:
        Imu.from_columns(table)
    assert message(e) == (
        f"imu: accel_y_m_s2 is {bad} at row 3 (2 such values in all); expected finite numbers; "
        "correct the row, or add --repair nan to drop such rows, counted"
    )
    assert (e.value.row, e.value.stream) == (3, "imu")


def test_an_unknown_sigma_may_be_empty_but_not_infinite():
    sigma = np.full((6, 3), np.nan)
    assert np.isnan(dataclasses.replace(example(GnssFix), sigma=sigma).sigma).all()
    sigma[2, 1] = np.inf
    with pytest.raises(SessionError, match="gnss: sigma_n_m is inf at row 2"):
        dataclasses.replace(example(GnssFix), sigma=sigma)


@pytest.mark.parametrize("low", [0.0, -1.0])
@pytest.mark.parametrize("field", ["sigma", "sigma_velocity"])
def test_a_sigma_must_be_positive(low, field):
    sigma = np.ones((6, 3))
    sigma[4, 2] = low
    with pytest.raises(SessionError) as e:
        dataclasses.replace(example(GnssFix), **{field: sigma})
    assert message(e) == (
        f"gnss: {field} is {low} at row 4; expected standard deviations > 0; leave unknown values empty"
    )
    assert e.value.row == 4


@pytest.mark.parametrize(("step", "found"), [(0, "step 0 ns"), (-2_000_000, "step -2000000 ns")])
def test_stamps_must_increase(step, found):
    t = np.array(example(Imu).t_ns)
    t[3:] += t[2] + step - t[3]
    with pytest.raises(SessionError) as e:
        dataclasses.replace(example(Imu), t_ns=t)
    assert message(e).startswith(
        f"imu: t_ns not strictly increasing at row 3 ({found}; 1 such rows in all); expected > 0"
    )
    assert "add --repair order to sort rows and drop repeated stamps, counted" in message(e)
    assert e.value.row == 3


@pytest.mark.parametrize("name", STREAMS)
def test_equal_stamps_are_for_streams_of_several_rows_an_epoch(name):
    stream = example(STREAMS[name])
    t = np.array(stream.t_ns)
    t[3] = t[2]
    if STREAMS[name].UNIQUE_TIMES:
        with pytest.raises(SessionError, match="not strictly increasing at row 3"):
            dataclasses.replace(stream, t_ns=t)
    else:
        assert len(dataclasses.replace(stream, t_ns=t)) == 6
        with pytest.raises(SessionError, match=r"t_ns not increasing at row 3 .*expected >= 0"):
            dataclasses.replace(stream, t_ns=t - np.eye(6, dtype=int)[3])


def test_a_position_is_geodetic_or_local_never_both_or_neither():
    for kind in (GnssFix, ControlPoint, PoseFix):
        both = {**example(kind).columns(), **example(kind, geodetic=True).columns()}
        with pytest.raises(SessionError, match=f"{kind.NAME}: both geodetic and local position columns") as e:
            kind.from_columns(both)
        assert "either lat_deg, lon_deg, height_m or e_m, n_m, u_m" in message(e)
        bare = {k: v for k, v in example(kind).columns().items() if k not in ("e_m", "n_m", "u_m")}
        with pytest.raises(SessionError, match=f"{kind.NAME}: position columns missing"):
            kind.from_columns(bare)


def test_shapes_must_fit_the_stamps():
    with pytest.raises(SessionError, match=r"imu: gyro has shape \(5, 3\); expected \(6, 3\), one row per time stamp"):
        Imu(t_ns=np.arange(6), gyro=np.zeros((5, 3)), accel=np.zeros((6, 3)))
    with pytest.raises(SessionError, match=r"imu: accel has shape \(6,\)"):
        Imu(t_ns=np.arange(6), gyro=np.zeros((6, 3)), accel=np.zeros(6))


def test_an_empty_stream_is_valid_in_memory():
    assert len(StaticPeriod(t_ns=[], t_end_ns=[])) == 0


def test_a_picture_outside_its_folder_is_refused():
    images = example(STREAMS["images"])
    with pytest.raises(
        SessionError, match=r"images: file is '\.\./secret' at row 1; expected a name inside the folder"
    ):
        dataclasses.replace(images, file=[*images.file[:1], "../secret", *images.file[2:]])


@pytest.mark.parametrize(("name", "column"), [("imu", "t_ns"), ("imu", "arrival_ns"), ("static", "t_end_ns")])
def test_stamps_have_differences_of_64_bits(name, column):
    table = dict(example(STREAMS[name]).columns())
    table[column] = np.where(np.arange(len(table[column])) == 2, -(2**63), table[column])
    with pytest.raises(SessionError, match=rf"{column} is -9223372036854775808 at row 2 .*; expected nanoseconds"):
        STREAMS[name].from_columns(table)
