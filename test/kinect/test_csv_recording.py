"""CSV recordings are read completely, and errors in them are named."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from body_tracking.core.skeleton import JOINT_NAMES, TrackingState
from body_tracking.core.sources import NOT_FINITE, SensorNameError
from body_tracking.kinect.csv_recording import BACKWARDS, IGNORED, REPEATED, CsvError, CsvRecording
from draws import draws
from skeleton_files import COORDINATES, write_csv
from skeleton_files import csv_row as row

STATES = [f"{joint}_state" for joint in JOINT_NAMES]


def fails(path: Path, text: str, **options: object) -> str:
    with pytest.raises(CsvError, match=text) as caught:
        list(CsvRecording(path, "kinect1", **options))
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    return str(caught.value)


# --- content


@pytest.mark.parametrize("name", ["a.csv", "a.csv.gz"])
def test_coordinates_become_optical_and_stamps_stay_exact(tmp_path, name):
    path = write_csv(tmp_path / name, [row("1700000000.123456789"), row("1700000000.156789012", 1.0)])
    first, second = CsvRecording(path, "left")
    assert (first.sensor, first.received_ns) == ("left", 1_700_000_000_123_456_789)
    assert second.skeletons[0].stamp_ns == 1_700_000_000_156_789_012
    skeleton = first.skeletons[0]
    assert skeleton.frame_id == "left_optical_frame" and skeleton.body == 0
    expected = np.arange(75).reshape(25, 3) / 100 * [-1, -1, 1]
    np.testing.assert_array_equal(skeleton.positions, expected)
    assert (skeleton.states == TrackingState.TRACKED).all()


@settings(max_examples=draws(8, 20), deadline=None)
@given(st.permutations([*COORDINATES, *STATES, "stamp", "sensor", "received", "person", "task", "mood"]), st.data())
def test_columns_may_come_in_any_order(tmp_path_factory, columns, data):
    states = data.draw(st.lists(st.integers(0, 2), min_size=25, max_size=25))
    content = row("2.5", sensor="kinect2", received="3.25", person="4", task="7", mood="good")
    content |= dict(zip(STATES, states, strict=True))
    path = write_csv(tmp_path_factory.mktemp("csv") / "a.csv", [content], list(columns))
    recording = CsvRecording(path)
    (frame,) = recording
    assert (frame.sensor, frame.received_ns) == ("kinect2", 3_250_000_000)
    (skeleton,) = frame.skeletons
    assert (skeleton.stamp_ns, skeleton.body) == (2_500_000_000, 4)
    assert skeleton.states.tolist() == states
    np.testing.assert_array_equal(skeleton.positions[3], [-0.09, -0.1, 0.11])
    assert recording.problems == {IGNORED: 1}


def test_rows_of_one_stamp_are_one_frame_though_sensors_alternate(tmp_path):
    rows = [
        row(stamp, sensor=sensor, person=person)
        for stamp in ("0.0", "0.1")
        for person in (0, 1)
        for sensor in ("kinect1", "kinect2")
    ]
    frames = list(CsvRecording(write_csv(tmp_path / "a.csv", rows)))
    assert [(frame.sensor, frame.skeletons[0].stamp_ns) for frame in frames] == [
        ("kinect1", 0),
        ("kinect2", 0),
        ("kinect1", 100_000_000),
        ("kinect2", 100_000_000),
    ]
    assert all([skeleton.body for skeleton in frame.skeletons] == [0, 1] for frame in frames)


def test_odd_stamps_are_kept_and_counted(tmp_path):
    recording = CsvRecording(write_csv(tmp_path / "a.csv", [row(stamp) for stamp in ("1", "1", "3", "2", "4")]), "a")
    assert [frame.skeletons[0].stamp_ns // 10**9 for frame in recording] == [1, 1, 3, 2, 4]
    assert recording.problems == {REPEATED: 1, BACKWARDS: 1}


@pytest.mark.parametrize("cell", ["", "nan", "NaN", "inf", "-inf", "1e999", "  "])
def test_a_joint_without_a_place_is_not_tracked(tmp_path, cell):
    recording = CsvRecording(write_csv(tmp_path / "a.csv", [row("0", Head_y=cell)]), "a")
    (frame,) = recording
    skeleton = frame.skeletons[0]
    assert np.isnan(skeleton.positions[3]).all() and skeleton.states[3] == TrackingState.NOT_TRACKED
    assert np.isfinite(np.delete(skeleton.positions, 3, axis=0)).all() and skeleton.valid.sum() == 24
    assert recording.problems == {NOT_FINITE: 1}


def test_names_of_sensors(tmp_path):
    one = write_csv(tmp_path / "one.csv", [row("0", sensor="a")])
    assert [frame.sensor for frame in CsvRecording(one, "b")] == ["b"]
    two = write_csv(tmp_path / "two.csv", [row("0", sensor="a"), row("0", sensor="b")])
    with pytest.raises(CsvError, match="several sensors"):
        list(CsvRecording(two, "c"))
    with pytest.raises(CsvError, match="--sensor"):
        list(CsvRecording(write_csv(tmp_path / "none.csv", [row("0")])))
    for name in ("fused", "1st", "a/b", ""):
        with pytest.raises(SensorNameError):
            CsvRecording(one, name)


def test_windows_line_ends_quotes_and_empty_lines(tmp_path):
    path = write_csv(tmp_path / "a.csv", [row("0"), row("1")])
    header, *lines = path.read_text().splitlines()
    quoted = ",".join(f'"{name}"' for name in header.split(","))
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join([quoted, lines[0], "", lines[1]]).encode())
    assert [frame.skeletons[0].stamp_ns for frame in CsvRecording(path, "a")] == [0, 10**9]


# --- errors


def cell(name: str, text: str, line: int = 3) -> Callable[[list[str]], str]:
    """Another text in a cell of a line of a file."""

    def change(lines: list[str]) -> str:
        cells = lines[line - 1].split(",")
        cells[lines[0].split(",").index(name)] = text
        return "\n".join([*lines[: line - 1], ",".join(cells), *lines[line:], ""])

    return change


def column(name: str, number: str = "0") -> Callable[[list[str]], str]:
    """One more column."""
    return lambda lines: "".join(f"{line},{number if k else name}\n" for k, line in enumerate(lines))


def without(name: str) -> Callable[[list[str]], str]:
    def change(lines: list[str]) -> str:
        place = lines[0].split(",").index(name)
        return "".join(",".join(each for k, each in enumerate(line.split(",")) if k != place) + "\n" for line in lines)

    return change


WRONG: list[tuple[Callable[[list[str]], str | bytes], str]] = [
    (cell("Head_x", "abc"), r"line 3: Head_x: 'abc' is not a number"),
    (cell("Head_x", "1.2.3"), r"line 3: Head_x"),
    (cell("Head_state", "3"), r"line 3: Head_state: tracking state '3'"),
    (cell("Head_state", "-1"), r"line 3: Head_state"),
    (cell("Head_state", "1.5"), r"line 3: Head_state"),
    (cell("Head_state", ""), r"line 3: Head_state"),
    (cell("stamp", ""), r"line 3: stamp: '' is not a number"),
    (cell("stamp", "nan"), r"line 3: stamp: 'nan' is not a time"),
    (cell("stamp", "1700000000123456789"), r"line 3: stamp: .* is not a time in seconds"),
    (cell("received", "soon"), r"line 3: received"),
    (cell("person", "-1"), r"line 3: person"),
    (cell("person", "70000"), r"line 3: person"),
    (cell("person", "Ann"), r"line 3: person: 'Ann'"),
    *((cell("sensor", name), "line 3: sensor name") for name in ("fused", "1st", "a/b", "")),
    (cell("Neck_z", "x", 2502), "line 2502: Neck_z"),
    *((without(name), f"missing column {name}$") for name in ("stamp", "Head_x", "ThumbRight_z")),
    *(
        (column(name), f"unknown joint column {name}$")
        for name in ("Nose_x", "head_x", "Head_w", "HandLeft_confidence", "Tail_state", "SpineBase")
    ),
    (column("Head_x"), "column 'Head_x' is there twice"),
    (lambda lines: "\n".join([*lines[:2], lines[2] + ",0"]), "line 3: 81 columns, expected 80"),
    (lambda lines: "\n".join([*lines[:2], lines[2].rpartition(",")[0], ""]), "line 3: 79 columns, expected 80"),
    (lambda lines: lines[0] + "\n", "no rows"),
    (lambda lines: b"", "the file is empty"),
    (lambda lines: b"\xff\xfe\x00\x01", "line 1: not UTF-8"),
    (lambda lines: "\n".join([*lines[:2], lines[2] + "\xe9 ", ""]).encode("latin-1"), "line 3: not UTF-8"),
    (lambda lines: "\n".join([*lines[:2], '"' + lines[2], lines[3], ""]), "line 3: a quoted cell goes on"),
    (lambda lines: "\n".join([*lines[:2], '"' + lines[2], lines[3] + '"', ""]), "line 3: a quoted cell goes on"),
    (lambda lines: b"stamp\n", "missing columns"),
    (
        lambda lines: b"time,left_elbow\n0,1\n",
        "and 71 more; docs/recordings.md lists the columns of each kind of CSV file$",
    ),
    (lambda lines: b"stamp;person;Head_x\n", "line 1: cells are separated by ';', expected ','"),
    (lambda lines: b"stamp\tperson\tHead_x\n", r"line 1: cells are separated by '\\t', expected ','"),
    (lambda lines: b'"stamp\n', "line 1"),
    (lambda lines: b"\x00\x00\n", "missing columns|line 1"),
]


@pytest.mark.parametrize(("change", "text"), WRONG)
def test_errors_name_the_line(tmp_path, change, text):
    good = row("0", received="0", person="0", sensor="a", Head_state="2")
    path = write_csv(tmp_path / "a.csv", [good] * (3000 if "2502" in text else 3))
    changed = change(path.read_text().splitlines())
    path.write_bytes(changed if isinstance(changed, bytes) else changed.encode())
    with pytest.raises(CsvError, match=text) as caught:
        list(CsvRecording(path))
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_an_absent_file_is_one_line(tmp_path):
    fails(tmp_path / "absent.csv", "No such file")


# --- cut off


def test_a_gzip_cut_anywhere_is_refused_or_read_as_far_as_it_goes(tmp_path):
    rows = [row(str(index), index * 0.37) for index in range(120)]
    data = write_csv(tmp_path / "a.csv.gz", rows).read_bytes()
    path = tmp_path / "cut.csv.gz"
    for size in range(2, len(data), 997):
        path.write_bytes(data[:size])
        text = fails(path, "cut off")
        recording = CsvRecording(path, "kinect1", partial=True)
        try:
            stamps = [frame.skeletons[0].stamp_ns // 10**9 for frame in recording]
        except CsvError as error:
            assert "cut off" in str(error), "not even the header is there"
            continue
        assert stamps == list(range(len(stamps))) and len(stamps) < 120
        assert f"{len(stamps)} row(s)" in text and f"{len(stamps)} row(s)" in recording.warnings[0]


def test_a_last_line_that_is_cut_off(tmp_path):
    path = write_csv(tmp_path / "a.csv", [row(str(index)) for index in range(5)])
    path.write_text(path.read_text()[:-40])
    assert "4 row(s)" in fails(path, "last line is cut off")
    recording = CsvRecording(path, "a", partial=True)
    assert len(list(recording)) == 4 and len(recording.warnings) == 1


def test_a_last_line_without_its_end_is_whole(tmp_path):
    path = write_csv(tmp_path / "a.csv", [row("0"), row("1")])
    path.write_text(path.read_text().rstrip("\n"))
    assert len(list(CsvRecording(path, "a"))) == 2


@pytest.mark.parametrize("partial", [False, True])
def test_a_damaged_gzip_is_refused(tmp_path, partial):
    rows = [row(str(index), index * 0.37) for index in range(300)]
    path = write_csv(tmp_path / "a.csv.gz", rows)
    data = bytearray(path.read_bytes())
    data[-6] ^= 1  # the checksum
    path.write_bytes(data)
    fails(path, "line 302: the gzip stream is damaged", partial=partial)
    path.write_bytes(b"stamp,no gzip at all\n")
    fails(path, "damaged", partial=partial)


def test_two_people_are_two_bodies_of_one_frame(shared_data):
    frames = list(CsvRecording(shared_data / "kinect_pairs" / "two_people_p24_45deg.csv.gz"))
    both = [frame for frame in frames if len(frame.skeletons) == 2]
    assert len(both) > 700
    assert all({skeleton.body for skeleton in frame.skeletons} == {0, 1} for frame in both)
