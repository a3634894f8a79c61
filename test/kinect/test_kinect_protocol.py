"""The packets of skeleton streaming: reading inverts packing, and everything else is refused."""

from __future__ import annotations

import ast
import math
import os
import random
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from senders import KEY, body

from body_tracking.core.skeleton import N_JOINTS
from body_tracking.kinect import kinect_protocol as protocol
from body_tracking.kinect.kinect_protocol import Body, ClockTimes, Frame, Header, ProtocolError
from draws import draws

HEADER = Header(protocol.FRAME, "kinect1", 2**64 - 1, 1, -5)
NAMES = st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,31}", fullmatch=True)
INT64 = st.integers(-(2**63), 2**63 - 1)
UINT64 = st.integers(0, 2**64 - 1)


@st.composite
def frames(draw: st.DrawFn) -> Frame:
    """Any valid frame: a few numbers are drawn, all others come from a seed."""
    numbers = np.random.default_rng(draw(st.integers(0, 2**32)))
    strange = draw(st.sampled_from([0.0, -0.0, math.nan, math.inf, -math.inf, 3e38, 1e-40]))
    bodies = []
    for index in draw(st.sets(st.integers(0, 5))):
        positions = numbers.normal(scale=3.0, size=(N_JOINTS, 3)).astype(np.float32)
        positions[numbers.integers(N_JOINTS), numbers.integers(3)] = strange
        orientations = numbers.normal(size=(N_JOINTS, 4))
        orientations /= np.linalg.norm(orientations, axis=1, keepdims=True)
        states = numbers.integers(0, 3, size=N_JOINTS)
        rows = (tuple(map(tuple, array.tolist())) for array in (positions, orientations))
        bodies.append(Body(index, draw(UINT64), next(rows), tuple(states.tolist()), next(rows)))
    floor = draw(st.none() | st.tuples(*[st.floats(-10, 10, width=32)] * 4))
    return Frame(draw(INT64), tuple(bodies), floor, draw(st.booleans()))


@settings(max_examples=draws(12, 25), deadline=None)
@given(frames(), NAMES, UINT64, UINT64, INT64, st.binary(min_size=16, max_size=80))
def test_a_frame_comes_out_as_it_went_in(
    frame: Frame, name: str, session: int, sequence: int, sent_ns: int, key: bytes
) -> None:
    packet = protocol.pack_frame(frame, Header(protocol.FRAME, name, session, sequence, sent_ns), key)
    assert protocol.MIN_PACKET <= len(packet) <= protocol.MAX_PACKET
    assert protocol.read_header(packet) == (protocol.FRAME, name, session, sequence, sent_ns)
    protocol.check_signature(packet, key)
    got = protocol.read_frame(packet)
    assert (got.time_ns, got.floor, got.silent) == (frame.time_ns, frame.floor, frame.silent)
    assert len(got.bodies) == len(frame.bodies)
    for given_body, got_body in zip(frame.bodies, got.bodies, strict=True):
        assert got_body[:2] == given_body[:2]
        assert got_body.states == given_body.states
        np.testing.assert_array_equal(np.float32(got_body.positions), np.float32(given_body.positions))
        np.testing.assert_allclose(got_body.orientations, given_body.orientations, atol=0.5 / 32767 + 1e-9)


@given(INT64, INT64, INT64, UINT64)
def test_clock_times_come_out_as_they_went_in(t1: int, t2: int, t3: int, number: int) -> None:
    header = Header(protocol.CLOCK_ANSWER, "a", 1, number, 0)
    packet = protocol.pack_clock(ClockTimes(t1, t2, t3), header, KEY)
    assert protocol.read_header(packet) == header
    assert protocol.read_clock(packet) == (t1, t2, t3)


def test_the_layout_is_the_documented_one() -> None:
    """Sizes and offsets in the module's docstring; a change of them needs another version."""
    packet = protocol.pack_frame(Frame(11, (body(3),), (0.0, 1.0, 0.0, 0.5)), HEADER._replace(sequence=9), KEY)
    assert len(packet) == 690
    assert packet[:4] == b"BTKS"
    assert struct.unpack_from("<BBH", packet, 4) == (1, 1, 690)
    assert packet[8:40] == b"kinect1".ljust(32, b"\0")
    assert struct.unpack_from("<QQq", packet, 40) == (2**64 - 1, 9, -5)
    assert struct.unpack_from("<qBBxx4f", packet, 64) == (11, 1, 1, 0.0, 1.0, 0.0, 0.5)
    assert struct.unpack_from("<B7xQ", packet, 92) == (3, body(3).tracking_id)
    assert struct.unpack_from("<3f4hBx", packet, 108 + 22)[7] == body(3).states[1]
    assert protocol.VERSION == 1
    assert protocol.MAX_PACKET == 64 + 28 + 6 * 566 + 32 < 65507  # of a datagram


def test_any_changed_bit_is_noticed() -> None:
    packet = protocol.pack_frame(Frame(11, (body(),)), HEADER, KEY)
    for bit in random.Random(1).sample(range(8 * len(packet)), 500):
        changed = bytearray(packet)
        changed[bit // 8] ^= 1 << bit % 8
        with pytest.raises(ProtocolError):
            protocol.read_header(bytes(changed))
            protocol.check_signature(bytes(changed), KEY)


@pytest.mark.parametrize("key", [b"", b"another key another key another", KEY[:-1], KEY + b"\0" * 33])
def test_another_key_does_not_do(key: bytes) -> None:
    packet = protocol.pack_frame(Frame(11, (body(),)), HEADER, KEY)
    protocol.check_signature(packet, KEY)
    with pytest.raises(ProtocolError, match="another key"):
        protocol.check_signature(packet, key)


def test_signed_packets_with_invalid_content_are_refused() -> None:
    packet = protocol.pack_frame(Frame(11, (body(0), body(1))), HEADER, KEY)
    with pytest.raises(ProtocolError, match=f"more than {protocol.MAX_PACKET} bytes"):
        protocol.read_header(packet + bytes(protocol.MAX_PACKET))
    for cut in (0, 1, 63, protocol.MIN_PACKET - 1):
        with pytest.raises(ProtocolError) as caught:
            protocol.read_header(packet[:cut])
        assert caught.value.reason == "too short"
    for change, reason in (
        ({64 + 9: 1}, "wrong size"),  # bodies
        ({64 + 9: 255}, "wrong size"),
        ({92: 6}, "out of range"),  # the index
        ({92: 1}, "out of range"),  # twice
        ({108 + 20: 3}, "out of range"),  # a tracking state
    ):
        changed = bytearray(packet)
        for at, value in change.items():
            changed[at] = value
        with pytest.raises(ProtocolError) as caught:
            protocol.read_frame(bytes(changed))
        assert caught.value.reason == reason


@pytest.mark.parametrize("name", ["", "1a", "a/b", "ä", "a" * 33, "a\0b", " a"])
def test_invalid_names_are_refused(name: str) -> None:
    with pytest.raises(ProtocolError):
        protocol.sensor_bytes(name)


def test_invalid_content_is_not_packed() -> None:
    with pytest.raises(ProtocolError, match="7 bodies"):
        protocol.pack_frame(Frame(0, tuple(body(k % 6) for k in range(7))), HEADER, KEY)
    with pytest.raises(ProtocolError, match="24 joints"):
        protocol.pack_frame(Frame(0, (body()._replace(positions=body().positions[:24]),)), HEADER, KEY)


# --- keys


def test_a_key_is_read_without_its_line_end_and_never_shown(tmp_path: Path) -> None:
    file = tmp_path / "key"
    file.write_bytes(KEY + b"\r\n")
    file.chmod(0o600)
    assert protocol.read_key(str(file)) == KEY
    file.write_bytes(b"short secret")
    with pytest.raises(ProtocolError, match="12 bytes, expected 16") as caught:
        protocol.read_key(str(file))
    assert "secret" not in str(caught.value)
    with pytest.raises(ProtocolError, match=f"{tmp_path / 'none'}: cannot be read"):
        protocol.read_key(str(tmp_path / "none"))


def test_a_key_that_others_may_read_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "kinect.key"
    file.write_bytes(KEY)
    for mode in (0o640, 0o604, 0o620, 0o610):
        file.chmod(mode)
        with pytest.raises(ProtocolError, match="others may read or write it"):
            protocol.read_key(str(file))
    os.mkfifo(tmp_path / "pipe", 0o600)
    with pytest.raises(ProtocolError, match="no regular file"):
        protocol.read_key(str(tmp_path / "pipe"))


# --- on Windows


def test_it_needs_nothing_but_an_old_pythons_standard_library() -> None:
    for name in ("kinect_protocol", "kinect_sender"):
        path = Path(protocol.__file__).with_name(f"{name}.py")
        tree = ast.parse(path.read_text(encoding="utf-8"), feature_version=(3, 8))
        for statement in ast.walk(tree):
            modules = [each.name for each in statement.names] if isinstance(statement, ast.Import) else []
            if isinstance(statement, ast.ImportFrom):
                modules = [str(statement.module)]
            for module in modules:
                known = module.partition(".")[0] in sys.stdlib_module_names
                assert known or (name, module) == ("kinect_sender", "body_tracking.kinect"), module
