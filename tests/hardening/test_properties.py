"""Any streams, sessions, configurations and calibrations: taken as they are, or refused by a message that names where.

Hypothesis looks for values that give another error, a value that is not the one written, or a check that fails. A few
examples are tried in every run, thousands in the slow tests.
"""

import dataclasses
import tempfile
import tomllib

import numpy as np
import pandas as pd
import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from smartnav_graph.core.errors import CalibrationError, ConfigError, SessionError
from smartnav_graph.estimate import config
from smartnav_graph.session import folder as sessions
from smartnav_graph.session import health
from smartnav_graph.session.calibration import model
from smartnav_graph.session.calibration.camera import Camera
from smartnav_graph.session.session import Device, Mount, Session
from smartnav_graph.session.stream import LARGEST
from smartnav_graph.session.streams import STREAMS, Barometer, GnssFix, Imu, Magnetometer

EFFORTS = [pytest.param(25, id="some"), pytest.param(1500, id="many", marks=pytest.mark.slow)]
ROWS = 6

numbers = st.one_of(
    st.floats(-90, 90),
    st.sampled_from([np.nan, np.inf, -np.inf, 0.0, -0.0, 1e300, 5e-324, 1e10, -1.0]),
    st.floats(allow_nan=True, allow_infinity=True),
)
stamps = st.one_of(
    st.integers(0, 10**12), st.sampled_from([-(2**63), 2**63 - 1, 0, 1_700_000_000_000_000_000]), st.integers(0, 50)
)
words = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
cells = {"int": stamps, "float": numbers, "text": words}
plain = st.one_of(numbers, st.booleans(), st.integers(-(10**20), 10**20), words, st.just("0x10"))
anything = st.recursive(
    plain, lambda inside: st.one_of(st.lists(inside, max_size=3), st.dictionaries(words, inside, max_size=3))
)


def trying(effort):
    return settings(
        max_examples=effort, deadline=None, database=None, suppress_health_check=list(HealthCheck), derandomize=True
    )


def names_place(error, *names):
    text = str(error)
    assert "; expected " in text and any(name in text for name in names), text
    assert "\x1b" not in text and "Traceback" not in text and len(text) < 5000


def same(first, second):
    return pd.DataFrame(first.columns()).equals(pd.DataFrame(second.columns()))


# --- streams ----------------------------------------------------------------------------------------------------------


@st.composite
def tables(draw, kind):
    """Columns of a stream: most of them of their kind, stamps mostly in order, some missing or of another type."""
    rows = draw(st.integers(1, ROWS))
    table = {}
    for spec in kind.specs():
        if spec.default is None and draw(st.booleans()):
            continue
        for name in spec.metadata["columns"]:
            kinds = spec.metadata["kind"] if draw(st.integers(0, 19)) else draw(st.sampled_from(sorted(cells)))
            values = draw(st.lists(cells[kinds], min_size=rows, max_size=rows))
            whole = kinds == "int" and draw(st.integers(0, 4))
            table[name] = np.array(sorted(values) if whole else values, dtype=object if kinds == "text" else None)
    if table and not draw(st.integers(0, 9)):
        del table[draw(st.sampled_from(sorted(table)))]
    return table


@pytest.mark.parametrize("name", STREAMS)
@pytest.mark.parametrize("effort", EFFORTS)
def test_columns_make_a_stream_or_are_refused(name, effort):
    kind = STREAMS[name]

    @given(tables(kind))
    @trying(effort)
    def check(table):
        try:
            stream, counts = sessions.build_stream(kind, table, f"{name}.parquet")
        except SessionError as error:
            names_place(error, f"{name}.parquet")
            return
        assert counts == {} and same(stream, kind.from_columns(stream.columns()))
        assert (np.diff(stream.t_ns) >= 0).all()
        for spec in kind.specs():
            value = getattr(stream, spec.name)
            if value is not None and spec.metadata["kind"] == "float":
                assert not np.isinf(value).any() and not (np.abs(value) > LARGEST).any()
        for column, values in stream.columns().items():
            written = np.asarray(table[column])
            assert all(a == b or (a != a and b != b) for a, b in zip(values, written, strict=True)), column

    check()


# --- sessions ---------------------------------------------------------------------------------------------------------


@st.composite
def recordings(draw):
    """A session whose readings are any that a stream takes; stamps of each at a rate of its own."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    start = draw(st.sampled_from([0, 1_700_000_000_000_000_000, -(10**15)]))

    def columns(rows, *shapes):
        step = draw(st.sampled_from([1, 1000, 10**7, 10**9, 10**13, 29 * 86_400 * 10**9]))
        size = draw(st.sampled_from([0.0, 1e-12, 1.0, 10.0, 1e4]))
        t_ns = start + draw(st.integers(-3, 3)) * 10**9 + np.arange(rows) * step
        return t_ns, *(size * rng.standard_normal((rows, *shape)) for shape in shapes)

    parts = {}
    rows = draw(st.integers(1, 60))
    t_ns, gyro, accel = columns(rows, (3,), (3,))
    lift = draw(st.sampled_from([0.0, 9.8, -9.8, 1.0]))
    parts["imu"] = Imu(t_ns=t_ns, gyro=gyro, accel=accel + np.array([0.0, 0.0, lift]))
    if draw(st.booleans()):
        t_ns, enu, sigma = columns(draw(st.integers(1, 30)), (3,), (3,))
        parts["gnss"] = GnssFix(t_ns=t_ns, enu=enu, sigma=np.abs(sigma) + 1e-3 if draw(st.booleans()) else None)
    if draw(st.booleans()):
        t_ns, field = columns(draw(st.integers(1, 30)), (3,))
        parts["magnetometer"] = Magnetometer(t_ns=t_ns, field_ut=field)
    if draw(st.booleans()):
        t_ns, pressure = columns(draw(st.integers(1, 30)), ())
        parts["barometer"] = Barometer(t_ns=t_ns, pressure_hpa=pressure)
    return Session(device=Device(name=draw(words)), **parts)


@pytest.mark.parametrize("effort", EFFORTS)
def test_a_session_is_checked_and_kept_as_it_is(effort):
    @given(recordings())
    @trying(effort)
    def check(session):
        findings = health.inspect(session).findings
        assert all(str(finding) and "nan" not in finding.text.split() for finding in findings)
        with tempfile.TemporaryDirectory() as folder:
            sessions.save(session, f"{folder}/s")
            found = sessions.load(f"{folder}/s")
        assert found.device == session.device and list(found.streams()) == list(session.streams())
        assert all(same(stream, found.streams()[name]) for name, stream in session.streams().items())

    check()


# --- tables of keys and values ----------------------------------------------------------------------------------------


def changed(table, draw):
    """A table with one key or value that is another, at any depth."""
    key = draw(st.sampled_from(sorted(table))) if table else ""
    if isinstance(table.get(key), dict) and draw(st.integers(0, 9)):
        return {**table, key: changed(table[key], draw)}
    others = {name: value for name, value in table.items() if name != key}
    what = draw(st.integers(0, 9))
    if what == 0:
        return others
    return {**table, draw(words): draw(anything)} if what == 1 else {**table, key: draw(anything)}


def kept(wanted, found):
    """Whether every key of a table has its value in another one."""
    if isinstance(wanted, dict) and isinstance(found, dict):
        return all(kept(value, found.get(key)) for key, value in wanted.items())
    if isinstance(wanted, list | tuple) and isinstance(found, list | tuple):
        return len(wanted) == len(found) and all(map(kept, wanted, found))
    return wanted == found or wanted != wanted or (wanted == {} and found is None)


def check_tables(whole, build, fault, text, effort):
    @given(st.data())
    @trying(effort)
    def check(data):
        table = changed(whole, data.draw)
        try:
            found = build(table)
        except fault as error:
            names_place(error, "the file")
            return
        written = tomllib.loads(text(found))
        assert kept({**table, "schema": written.get("schema")}, written), (table, written)  # written in the newest one
        assert build(written) == found or "nan" in text(found)

    check()


@pytest.mark.parametrize("effort", EFFORTS)
def test_a_configuration_is_as_written_or_refused(effort):
    whole = tomllib.loads(config.dumps(config.Config()))
    check_tables(whole, lambda table: config.from_dict(table, "the file"), ConfigError, config.dumps, effort)


@pytest.mark.parametrize("effort", EFFORTS)
def test_a_calibration_is_as_written_or_refused(effort):
    camera = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, distortion=(0.1, 0.0, 0.0, 0.0))
    whole = tomllib.loads(model.calibration_toml(model.Calibration(device="phone", cameras={"cam0": camera})))
    check_tables(
        whole,
        lambda table: model.calibration_from_dict(table, "the file"),
        CalibrationError,
        model.calibration_toml,
        effort,
    )


@pytest.mark.parametrize("effort", EFFORTS)
def test_the_header_of_a_session_is_as_written_or_refused(effort):
    imu = Imu(t_ns=np.arange(3) * 10**7, gyro=np.zeros((3, 3)), accel=np.tile([0.0, 0.0, 9.8], (3, 1)))
    session = Session(imu=imu, device=Device(name="phone"), gravity_m_s2=9.81, sensors={"gnss": Mount((0.1, 0.0, 0.0))})
    with tempfile.TemporaryDirectory() as top:
        sessions.save(session, f"{top}/the file")

        def build(table):
            try:
                text = tomli_w.dumps(table)
            except (ValueError, TypeError):  # no TOML can say it
                raise SessionError("the file", "is no TOML", "a table") from None
            with open(f"{top}/the file/session.toml", "w", encoding="utf-8", newline="") as file:
                file.write(text)
            return dataclasses.replace(sessions.load(f"{top}/the file"), path=None, pictures=None, imu=None)

        check_tables(
            sessions.header_of(session), build, SessionError, lambda s: tomli_w.dumps(sessions.header_of(s)), effort
        )
