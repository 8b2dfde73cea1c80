"""Delimited text: exact stamps, exact numbers, errors that name file, row and value."""

import gzip

import numpy as np
import pytest

from smartnav_graph.core.errors import SessionError
from smartnav_graph.core.timebase import NS
from smartnav_graph.readers import text as text_module
from smartnav_graph.readers.text import read_text


def write(tmp_path, text, name="log.csv"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("46534.47837579", 46534478375790),
        ("46534.478375790000428", 46534478375790),
        ("1403715273.2621429765", 1403715273262142976),  # a half rounds to the even neighbour: ...976|5 -> 976
        ("1403715273.2621429775", 1403715273262142978),  # ... and 977|5 -> 978
        ("1403715273.26214297650001", 1403715273262142977),
        ("-0.0000000015", -2),
        ("-0.0000000025", -2),
        ("4.60e+02", 460_000_000_000),
        ("9000000000.123456789", 9000000000123456789),  # no float holds this nanosecond
    ],
)
def test_stamps_keep_every_digit(tmp_path, text, expected):
    assert read_text(write(tmp_path, f"t,v\n{text},1\n")).times("t").tolist() == [expected]


def test_binary_floats_would_lose_the_nanosecond():
    # guards the test above: the shortcut int(float * 1e9) gives another answer
    assert int(float("9000000000.123456789") * 1e9) != 9000000000123456789


@pytest.mark.parametrize("separator", [",", ";", "\t", " ", "   ", ", "])
def test_separators_and_line_ends(tmp_path, separator):
    lines = [separator.join(row) for row in (("t", "a", "b"), ("1", "2.5", "-3e-2"), ("2", "nan", "4"))]
    table = read_text(write(tmp_path, "\ufeff" + "\r\n".join(lines) + "\r\n"))
    assert list(table.cells) == ["t", "a", "b"]
    np.testing.assert_array_equal(table.floats("a", "b"), [[2.5, -0.03], [np.nan, 4.0]])


def test_comments_and_hash_headings(tmp_path):
    table = read_text(write(tmp_path, "#t [ns], x [m]\n1,2\n# remark, with comma\n3,4\n"))
    assert list(table.cells) == ["t [ns]", "x [m]"]
    assert table.ints("t [ns]").tolist() == [1, 3]


def test_names_for_files_without_heading(tmp_path):
    table = read_text(write(tmp_path, "# t x\n 1.0  2.0 \n 3.0  4.0\n"), names=("t", "x"))
    np.testing.assert_array_equal(table.floats("x"), [2.0, 4.0])


def test_empty_cells_become_nan_but_no_integers(tmp_path):
    table = read_text(write(tmp_path, "t_ns,x\n1,\n,2\n"))
    np.testing.assert_array_equal(table.floats("x"), [np.nan, 2.0])
    with pytest.raises(SessionError, match=r"t_ns is '' at row 1; expected a whole number"):
        table.ints("t_ns")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (b"", ("has no rows",)),
        (b"t,x\n", ("has no rows", "expected at least one row")),
        (b"t,x\n1,2\n3\n", ("no table of 2 columns", "Expected 2 columns, got 1: 3", "complete the row")),
        (b"t,x\n3\n1,2", ("no table of 2 columns", "Expected 2 columns, got 1: 3")),
        (b"t,x\n1,5,2,5\n3,5,4,5\n", ("no table of 2 columns", "if commas are decimal marks, export with decimal")),
        (b"t,x,x\n1,2,3\n", ("column 'x' appears twice",)),
        (b"t,x\n1,\0\n", ("is no text",)),
    ],
)
def test_faulty_files(tmp_path, text, parts):
    path = write(tmp_path, text)
    with pytest.raises(SessionError) as caught:
        read_text(path)
    for part in (str(path), *parts):
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("cell", "read", "expected"),
    [
        ("abc", "floats", "a number"),
        ("1,5,5", "floats", "a number"),
        ("0x10", "floats", "a number"),
        ("1.5", "ints", "a whole number"),
        ("99999999999999999999", "ints", "a whole number"),
        ("abc", "times", "a decimal number"),
        ("nan", "times", "a decimal number"),
        ("", "times", "a decimal number"),
        ("1e30", "times", "a decimal number"),
    ],
)
def test_bad_cells_name_file_row_and_value(tmp_path, cell, read, expected):
    path = write(tmp_path, f"t;x\n1;1\n2;2\n{cell};3\n")
    with pytest.raises(SessionError) as caught:
        getattr(read_text(path), read)("t")
    assert str(caught.value).startswith(f"{path}: t is {cell!r} at row 2; expected {expected}; ")
    assert caught.value.row == 2


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(SessionError, match="is missing"):
        read_text(tmp_path / "no.csv")
    with pytest.raises(SessionError, match="cannot be read"):
        read_text(tmp_path)


@pytest.mark.parametrize("separator", [",", " "])
@pytest.mark.parametrize("name", ["log.csv", "log.csv.gz"])
def test_a_long_file_is_read_block_by_block(tmp_path, monkeypatch, separator, name):
    lines = ["t,v,note", *(f"{row}.25,{row * 0.5},n{row}" for row in range(100))]
    lines.insert(40, "# remark, with comma")
    text = ("\ufeff" + "\r\n".join(lines)).replace(",", separator).encode()
    path = write(tmp_path, gzip.compress(text) if name.endswith(".gz") else text, name)
    whole = read_text(path)
    monkeypatch.setattr(text_module, "BLOCK", 64)  # two or three rows at once
    table = read_text(path)
    assert list(table.cells) == list(whole.cells) and len(table) == 100
    assert table.times("t").tolist() == whole.times("t").tolist() == [row * NS + NS // 4 for row in range(100)]
    np.testing.assert_array_equal(table.floats("v", "t"), whole.floats("v", "t"))
    assert table.texts("note").tolist() == [f"n{row}" for row in range(100)]
    assert not table.is_empty("note")


def test_a_fault_far_down_a_long_file_has_its_row(tmp_path, monkeypatch):
    monkeypatch.setattr(text_module, "BLOCK", 64)
    rows = [f"{row},{row}" for row in range(100)]
    table = read_text(write(tmp_path, "t,v\n" + "\n".join([*rows[:70], "70,x", *rows[71:]])))
    with pytest.raises(SessionError, match=r"v is 'x' at row 70"):
        table.floats("v")
    short = read_text(write(tmp_path, "\n".join(["t,v", *rows[:70], "70", *rows[71:]]), "short.csv"))
    with pytest.raises(SessionError, match=r"short.csv: is no table of 2 columns .*Row #71.*got 1: 70"):
        short.floats("v")


@pytest.mark.parametrize("separator", [";", "\t", "|"])
def test_decimal_commas(tmp_path, separator):
    rows = [("t", "a", "b"), ("1,5", "-2,25", "7"), ("2,5", "3,5E-1", "8")]
    table = read_text(write(tmp_path, "\n".join(separator.join(row) for row in rows) + "\n"))
    assert table.times("t").tolist() == [1_500_000_000, 2_500_000_000]
    np.testing.assert_array_equal(table.floats("a", "b"), [[-2.25, 7], [0.35, 8]])


def test_two_decimal_marks_are_refused(tmp_path):
    table = read_text(write(tmp_path, "t;x\n1,234;0.5\n2,345;0.25\n"))
    with pytest.raises(SessionError, match="t is '1,234' at row 0, but x has decimal points; expected one"):
        table.floats("t")


@pytest.mark.parametrize(
    "before",
    ["sep=,\n", "SEP=,\r\n", '"sep=,"\n', "sep=,,,,\n", ",,,\n", "\n\n", "# a remark\n", "\ufeffsep=,\n# a\n\n"],
)
def test_lines_before_the_heading(tmp_path, before):
    table = read_text(write(tmp_path, before + "t,x\n1,2\n"))
    assert list(table.cells) == ["t", "x"] and table.floats("x").tolist() == [2]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "cp1252"])
def test_encodings(tmp_path, encoding):
    text = "t,Richtung (°),Feld (µT)\n1,2,3\n"
    assert list(read_text(write(tmp_path, text.encode(encoding))).cells) == ["t", "Richtung (°)", "Feld (µT)"]


def test_repeated_headings_and_a_torn_last_row_are_counted(tmp_path):
    table = read_text(write(tmp_path, "t,x\n1,2\nt,x\n3,4\n5"))
    assert table.floats("t").tolist() == [1, 3]
    assert table.skipped == {"that repeat the heading left out": 1, "cut at the end of the file left out": 1}
    assert read_text(write(tmp_path, "t,x\n1,2\n3,4")).floats("x").tolist() == [2, 4]
    cut = read_text(write(tmp_path, "t,x\n1,2\n3,4"), whole=True)
    assert cut.floats("x").tolist() == [2] and cut.skipped == {"cut at the end of the file left out": 1}


def test_missing_values_and_unnamed_columns(tmp_path):
    table = read_text(write(tmp_path, "t,x,\n1,N/A,\n2,NaN,\n3,null,\n4,--,\n5,1.5,\n"))
    np.testing.assert_array_equal(table.floats("x"), [np.nan] * 4 + [1.5])
    assert table.known("x").tolist() == [False] * 4 + [True]
    assert list(read_text(write(tmp_path, "t,x\n1,2,\n3,4,\n")).cells) == ["t", "x", "column 3"]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2023-12-31T22:33:02.400Z", 1704061982_400_000_000),
        ("2023-12-31 23:33:02.4 +0100", 1704061982_400_000_000),
        ("2023-12-31T17:03:02,400-05:30", 1704061982_400_000_000),
        ("2018-08-03 20:47:12:853", 1533329232_853_000_000),
        ("1970-01-01T00:00:00.000000001Z", 1),
    ],
)
def test_dates_are_unix_nanoseconds(tmp_path, text, expected):
    assert read_text(write(tmp_path, f"t;x\n{text};1\n")).times("t").tolist() == [expected]


def test_a_date_among_dates_that_is_none(tmp_path):
    table = read_text(write(tmp_path, "t;x\n2023-12-31T22:33:02Z;1\n2023-13-31T22:33:02Z;1\n"))
    with pytest.raises(SessionError, match="'2023-13-31T22:33:02Z' at row 1; expected a date as in the first row"):
        table.times("t")
