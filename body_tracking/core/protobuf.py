"""Protocol buffers' wire format, read without a schema (protobuf.dev, "Encoding")."""

from __future__ import annotations

import struct
from typing import Final

from body_tracking.core.errors import BodyTrackingError

Value = int | float | bytes
Fields = dict[int, list[Value]]
"""Values by the number of their field, in their order."""

_VARINT, _DOUBLE, _BYTES, _FLOAT = 0, 1, 2, 5
_LONGEST: Final = 10
"""Bytes of a 64-bit variable-length integer."""


class ProtobufError(BodyTrackingError):
    """Bytes that are no message, or one that is cut off."""


def fields(data: bytes) -> Fields:
    """The fields of a message: integers, floats of 32 and 64 bits, and bytes (texts, messages within).

    Raises:
        ProtobufError: cut off, or of no wire type in use.
    """
    found: Fields = {}
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        number, kind = key >> 3, key & 7
        if number == 0:
            raise ProtobufError(f"field number 0 at byte {at}")
        value: Value
        if kind == _VARINT:
            value, at = _varint(data, at)
        elif kind in (_DOUBLE, _FLOAT):
            layout = "<d" if kind == _DOUBLE else "<f"
            end = at + struct.calcsize(layout)
            if end > len(data):
                raise ProtobufError(f"cut off at byte {at}")
            (value,), at = struct.unpack(layout, data[at:end]), end
        elif kind == _BYTES:
            size, at = _varint(data, at)
            if at + size > len(data):
                raise ProtobufError(f"cut off at byte {at}: {size} bytes announced, {len(data) - at} there")
            value, at = data[at : at + size], at + size
        else:
            raise ProtobufError(f"wire type {kind} at byte {at}")
        found.setdefault(number, []).append(value)
    return found


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """An integer and where it ends."""
    value = 0
    for count in range(_LONGEST):
        if at + count >= len(data):
            raise ProtobufError(f"cut off at byte {at}")
        byte = data[at + count]
        value |= (byte & 0x7F) << (7 * count)
        if byte < 0x80:
            return value, at + count + 1
    raise ProtobufError(f"an integer of more than 64 bits at byte {at}")


def message(of: Fields, number: int) -> Fields:
    """The last message in a field; empty without one.

    Raises:
        ProtobufError: the field is a number.
    """
    value = of.get(number, [b""])[-1]
    if not isinstance(value, bytes):
        raise ProtobufError(f"field {number} is a number, expected a message")
    return fields(value)


def number(of: Fields, field: int) -> float:
    """The last number in a field; 0 without one, as numbers that are 0 are not written.

    Raises:
        ProtobufError: it is no number.
    """
    value = of.get(field, [0])[-1]
    if isinstance(value, bytes):
        raise ProtobufError(f"field {field} is no number")
    return float(value)


def signed(of: Fields, field: int) -> int:
    """The last ``sint32`` (zigzag) in a field; 0 without one; errors as of :func:`number`."""
    value = int(number(of, field))
    return (value >> 1) ^ -(value & 1)
