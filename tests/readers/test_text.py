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
        (b"t,x\n1,2\n3\n", ("no table of 2 columns", "Expected 2 columns, got 1: 3")),
        (b"t,x,x\n1,2,3\n", ("column 'x' appears twice",)),
        (b"t,x\n1,\0\n", ("is no text",)),
        (b"t,x\n1,\xff\xfe\n", ("no table of 2 columns", "invalid UTF8")),
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
        ("1,5", "floats", "a number"),
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
