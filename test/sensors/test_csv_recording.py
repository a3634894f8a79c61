"""CSV recordings: what is in the file is what comes out, and what is wrong in it is named."""

from __future__ import annotations

import csv
import gzip
import io
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from body_tracking.sensors import NOT_FINITE, SensorNameError
from body_tracking.sensors.csv_recording import BACKWARDS, IGNORED, REPEATED, CsvError, CsvRecording
from body_tracking.skeleton import JOINT_NAMES, TrackingState
from draws import some

COORDINATES = [f"{joint}_{axis}" for joint in JOINT_NAMES for axis in "xyz"]
STATES = [f"{joint}_state" for joint in JOINT_NAMES]


def row(stamp: object, offset: float = 0.0, **more: object) -> dict[str, object]:
    """A row whose 75 coordinates are all different."""
    return {"stamp": stamp, **{name: offset + index / 100 for index, name in enumerate(COORDINATES)}, **more}


def write(path: Path, rows: list[dict[str, object]], columns: list[str] | None = None) -> Path:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns or list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    data = text.getvalue().encode()
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)
    return path


def fails(path: Path, text: str, **options: object) -> str:
    with pytest.raises(CsvError, match=text) as caught:
        list(CsvRecording(path, "kinect1", **options))
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    return str(caught.value)


# --- content


@pytest.mark.parametrize("name", ["a.csv", "a.csv.gz"])
def test_coordinates_become_optical_and_stamps_stay_exact(tmp_path, name):
    path = write(tmp_path / name, [row("1700000000.123456789"), row("1700000000.156789012", 1.0)])
    first, second = CsvRecording(path, "left")
    assert (first.sensor, first.received_ns) == ("left", 1_700_000_000_123_456_789)
    assert second.skeletons[0].stamp_ns == 1_700_000_000_156_789_012
    skeleton = first.skeletons[0]
    assert skeleton.frame_id == "left_optical_frame" and skeleton.body == 0
    expected = np.arange(75).reshape(25, 3) / 100 * [-1, -1, 1]
    np.testing.assert_array_equal(skeleton.positions, expected)
    assert (skeleton.states == TrackingState.TRACKED).all()


@settings(max_examples=20, deadline=None)
@given(st.permutations([*COORDINATES, *STATES, "stamp", "sensor", "received", "person", "task", "mood"]), st.data())
def test_columns_may_come_in_any_order(tmp_path_factory, columns, data):
    states = data.draw(st.lists(st.integers(0, 2), min_size=25, max_size=25))
    content = row("2.5", sensor="kinect2", received="3.25", person="4", task="7", mood="good")
    content |= dict(zip(STATES, states, strict=True))
    path = write(tmp_path_factory.mktemp("csv") / "a.csv", [content], list(columns))
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
    frames = list(CsvRecording(write(tmp_path / "a.csv", rows)))
    assert [(frame.sensor, frame.skeletons[0].stamp_ns) for frame in frames] == [
        ("kinect1", 0),
        ("kinect2", 0),
        ("kinect1", 100_000_000),
        ("kinect2", 100_000_000),
    ]
    assert all([skeleton.body for skeleton in frame.skeletons] == [0, 1] for frame in frames)


def test_odd_stamps_are_kept_and_counted(tmp_path):
    recording = CsvRecording(write(tmp_path / "a.csv", [row(stamp) for stamp in ("1", "1", "3", "2", "4")]), "a")
    assert [frame.skeletons[0].stamp_ns // 10**9 for frame in recording] == [1, 1, 3, 2, 4]
    assert recording.problems == {REPEATED: 1, BACKWARDS: 1}


@pytest.mark.parametrize("cell", ["", "nan", "NaN", "inf", "-inf", "1e999", "  "])
def test_a_joint_without_a_place_is_not_tracked(tmp_path, cell):
    recording = CsvRecording(write(tmp_path / "a.csv", [row("0", Head_y=cell)]), "a")
    (frame,) = recording
    skeleton = frame.skeletons[0]
    assert np.isnan(skeleton.positions[3]).all() and skeleton.states[3] == TrackingState.NOT_TRACKED
    assert np.isfinite(np.delete(skeleton.positions, 3, axis=0)).all() and skeleton.valid.sum() == 24
    assert recording.problems == {NOT_FINITE: 1}


def test_names_of_sensors(tmp_path):
    one = write(tmp_path / "one.csv", [row("0", sensor="a")])
    assert [frame.sensor for frame in CsvRecording(one, "b")] == ["b"]
    two = write(tmp_path / "two.csv", [row("0", sensor="a"), row("0", sensor="b")])
    with pytest.raises(CsvError, match="several sensors"):
        list(CsvRecording(two, "c"))
    for name in ("fused", "1st", "a/b", ""):
        with pytest.raises(SensorNameError):
            CsvRecording(one, name)
        with pytest.raises(CsvError, match="line 3"):
            list(CsvRecording(write(tmp_path / "bad.csv", [row("0", sensor="a"), row("1", sensor=name)])))
    with pytest.raises(CsvError, match="--sensor"):
        list(CsvRecording(write(tmp_path / "none.csv", [row("0")])))


def test_windows_line_ends_quotes_and_empty_lines(tmp_path):
    path = write(tmp_path / "a.csv", [row("0"), row("1")])
    header, *lines = path.read_text().splitlines()
    quoted = ",".join(f'"{name}"' for name in header.split(","))
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join([quoted, lines[0], "", lines[1]]).encode())
    assert [frame.skeletons[0].stamp_ns for frame in CsvRecording(path, "a")] == [0, 10**9]


# --- what is wrong


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"Head_x": "abc"}, r"line 3: Head_x: 'abc' is not a number"),
        ({"Head_x": "1.2.3"}, r"line 3: Head_x"),
        ({"Head_state": "3"}, r"line 3: Head_state: tracking state '3'"),
        ({"Head_state": "-1"}, r"line 3: Head_state"),
        ({"Head_state": "1.5"}, r"line 3: Head_state"),
        ({"Head_state": ""}, r"line 3: Head_state"),
        ({"stamp": ""}, r"line 3: stamp: '' is not a number"),
        ({"stamp": "nan"}, r"line 3: stamp: 'nan' is not a time"),
        ({"stamp": "1700000000123456789"}, r"line 3: stamp: .* is not a time in seconds"),
        ({"received": "soon"}, r"line 3: received"),
        ({"person": "-1"}, r"line 3: person"),
        ({"person": "70000"}, r"line 3: person"),
        ({"person": "Ann"}, r"line 3: person: 'Ann'"),
    ],
)
def test_a_bad_cell_is_named_with_its_line(tmp_path, changes, text):
    good = row("0", received="0", person="0", Head_state="2")
    fails(write(tmp_path / "a.csv", [good, good | changes, good]), text)


def test_bad_cells_are_found_in_later_blocks_too(tmp_path):
    rows = [row(str(index)) for index in range(3000)]
    rows[2500]["Neck_z"] = "x"
    fails(write(tmp_path / "a.csv", rows), "line 2502: Neck_z")


@pytest.mark.parametrize("missing", ["stamp", "Head_x", "ThumbRight_z"])
def test_missing_columns_are_named(tmp_path, missing):
    content = row("0")
    del content[missing]
    fails(write(tmp_path / "a.csv", [content]), f"missing column {missing}$")


@pytest.mark.parametrize("strange", ["Nose_x", "head_x", "Head_w", "HandLeft_confidence", "Tail_state", "SpineBase"])
def test_unknown_columns_that_look_like_joints_are_refused(tmp_path, strange):
    fails(write(tmp_path / "a.csv", [row("0", **{strange: 0})]), f"unknown joint column {strange}$")


def test_a_column_that_is_there_twice_is_refused(tmp_path):
    path = write(tmp_path / "a.csv", [row("0")])
    path.write_text("\n".join(line + "," + line.split(",")[5] for line in path.read_text().splitlines()))
    fails(path, "twice")


@pytest.mark.parametrize("change", [lambda line: line + ",0", lambda line: line.rpartition(",")[0]])
def test_another_number_of_columns_is_named_with_its_line(tmp_path, change):
    path = write(tmp_path / "a.csv", [row("0"), row("1"), row("2")])
    lines = path.read_text().splitlines(keepends=True)
    lines[2] = change(lines[2].rstrip("\n")) + "\n"
    path.write_text("".join(lines))
    fails(path, r"line 3: 7[57] columns, expected 76")


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "the file is empty"),
        (b"\xff\xfe\x00\x01", "line 1: not UTF-8"),
        (b"stamp\n", "missing columns"),
        (b'"stamp\n', "line 1"),
        (b"\x00\x00\n", "missing columns|line 1"),
    ],
)
def test_what_is_no_csv_recording_is_one_line(tmp_path, data, text):
    path = tmp_path / "a.csv"
    path.write_bytes(data)
    fails(path, text)


def test_a_header_alone_is_no_recording(tmp_path):
    path = write(tmp_path / "a.csv", [row("0")])
    path.write_text(path.read_text().splitlines()[0] + "\n")
    fails(path, "no rows")


def test_an_absent_file_is_one_line(tmp_path):
    fails(tmp_path / "absent.csv", "No such file")


# --- cut off


def test_a_gzip_cut_anywhere_is_refused_or_read_as_far_as_it_goes(tmp_path):
    rows = [row(str(index), index * 0.37) for index in range(300)]
    data = write(tmp_path / "a.csv.gz", rows).read_bytes()
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
        assert stamps == list(range(len(stamps))) and len(stamps) < 300
        assert f"{len(stamps)} row(s)" in text and f"{len(stamps)} row(s)" in recording.warnings[0]


def test_a_last_line_that_is_cut_off(tmp_path):
    path = write(tmp_path / "a.csv", [row(str(index)) for index in range(5)])
    path.write_text(path.read_text()[:-40])
    assert "4 row(s)" in fails(path, "last line is cut off")
    recording = CsvRecording(path, "a", partial=True)
    assert len(list(recording)) == 4 and len(recording.warnings) == 1


def test_a_last_line_without_its_end_is_whole(tmp_path):
    path = write(tmp_path / "a.csv", [row("0"), row("1")])
    path.write_text(path.read_text().rstrip("\n"))
    assert len(list(CsvRecording(path, "a"))) == 2


@pytest.mark.parametrize("partial", [False, True])
def test_a_damaged_gzip_is_refused(tmp_path, partial):
    rows = [row(str(index), index * 0.37) for index in range(300)]
    path = write(tmp_path / "a.csv.gz", rows)
    data = bytearray(path.read_bytes())
    data[-6] ^= 1  # the checksum
    path.write_bytes(data)
    fails(path, "damaged", partial=partial)
    path.write_bytes(b"stamp,no gzip at all\n")
    fails(path, "damaged", partial=partial)


# --- the real ones


def test_real_recordings_come_out_as_they_are(shared_data):
    for path in some(sorted((shared_data / "kinect_pairs").glob("*.csv.gz")), 3):
        with gzip.open(path, "rt") as file:
            rows = list(csv.DictReader(file))
        frames = list(CsvRecording(path))
        assert sum(len(frame.skeletons) for frame in frames) == len(rows), path.name
        first = next(frame for frame in frames if frame.sensor == "kinect1")
        expected = next(row for row in rows if row["sensor"] == "kinect1")
        points = np.array([float(expected[name]) for name in COORDINATES]).reshape(25, 3)
        np.testing.assert_array_equal(first.skeletons[0].positions, points * [-1, -1, 1])
        for sensor in ("kinect1", "kinect2"):
            stamps = [skeleton.stamp_ns for frame in frames if frame.sensor == sensor for skeleton in frame.skeletons]
            assert stamps == [
                round(float(row["stamp"]) * 10_000) * 100_000 for row in rows if row["sensor"] == sensor
            ], path.name


def test_two_people_are_two_bodies_of_one_frame(shared_data):
    frames = list(CsvRecording(shared_data / "kinect_pairs" / "two_people_p24_45deg.csv.gz"))
    both = [frame for frame in frames if len(frame.skeletons) == 2]
    assert len(both) > 700
    assert all({skeleton.body for skeleton in frame.skeletons} == {0, 1} for frame in both)


def test_real_tracking_states(shared_data):
    path = shared_data / "kinect_states" / "skip_exercise.csv.gz"
    with gzip.open(path, "rt") as file:
        rows = list(csv.DictReader(file))
    frames = list(CsvRecording(path, "kinect1"))
    assert [frame.skeletons[0].states.tolist() for frame in frames] == [
        [int(row[name]) for name in STATES] for row in rows
    ]
