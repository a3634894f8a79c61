"""Hostile messages: random fields, valid messages with some fields changed, and random bytes."""

from __future__ import annotations

import copy
import importlib
import math
import random
import re
from array import array
from typing import Any

import numpy as np
from rclpy.serialization import serialize_message

_FLOATS = (0.0, -0.0, 1.0, -1.0, 1e-300, 1e300, -1e300, 1e9, math.nan, math.inf, -math.inf)
_STRINGS = (
    "",
    "kinect1",
    "kinect2",
    "kinect1_optical_frame",
    "kinect2_optical_frame",
    "world",
    "isb",
    "x" * 5000,
    "é\n",
)
_LENGTHS = (0, 0, 1, 2, 5, 26, 100)
_BITS = {"octet": (0, 8), "uint8": (0, 8), "uint16": (0, 16), "uint32": (0, 32), "uint64": (0, 64)} | {
    f"int{bits}": (-(1 << (bits - 1)), bits - 1) for bits in (8, 16, 32, 64)
}
_SEQUENCE = re.compile(r"(?:sequence<(?P<item>[^,>]+)(?:, *(?P<most>\d+))?>|(?P<of>[^\[]+)\[(?P<count>\d+)\])$")


def class_of(type_name: str) -> Any:
    """The class of ``pkg/msg/Name`` or, as a field names it, ``pkg/Name``."""
    package, *_, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def _number(draw: random.Random, kind: str) -> Any:
    if kind in ("double", "float"):
        value = draw.choice(_FLOATS) if draw.random() < 0.5 else draw.gauss(0.0, 10.0 ** draw.randint(-3, 6))
        return value if kind == "double" or not math.isfinite(value) else max(-3e38, min(3e38, value))
    low, bits = _BITS[kind]
    high = (1 << bits) - 1
    return draw.choice((low, 0, 1, 2, 7, high, draw.randint(low, high)))


def value(draw: random.Random, kind: str) -> Any:
    """A value of a field of this kind, as ``get_fields_and_field_types`` names it."""
    found = _SEQUENCE.match(kind)
    if found is not None:
        item = found["item"] or found["of"]
        count = int(found["count"]) if found["count"] else draw.choice(_LENGTHS)
        values = [value(draw, item) for _ in range(count)]
        if item in _BITS or item in ("double", "float"):
            code = {"double": "d", "float": "f", "octet": "B", "uint8": "B", "int8": "b", "uint16": "H"}.get(item)
            if item == "octet":
                return [bytes([each[0]]) for each in values]
            if found["count"]:
                return np.array(values, {"double": "f8", "float": "f4"}.get(item, item))
            return array(code, values) if code else values
        return values
    if kind == "boolean":
        return draw.random() < 0.5
    if kind.startswith("string"):
        return draw.choice(_STRINGS)
    if kind == "octet":
        return bytes([draw.randint(0, 255)])
    return message(draw, class_of(kind)) if "/" in kind else _number(draw, kind)


def message(draw: random.Random, message_class: Any) -> Any:
    """A message with every field drawn."""
    types = message_class.get_fields_and_field_types()
    return message_class(**{name: value(draw, kind) for name, kind in types.items()})


def changed(draw: random.Random, right: Any) -> Any:
    """A valid message with one to three of its fields drawn, at any depth."""
    made = copy.deepcopy(right)
    for _ in range(draw.randint(1, 3)):
        place = made
        while True:
            name, kind = draw.choice(list(place.get_fields_and_field_types().items()))
            inner = getattr(place, name)
            if hasattr(inner, "get_fields_and_field_types"):
                place = inner
            elif isinstance(inner, list) and inner and hasattr(inner[0], "get_fields_and_field_types"):
                place = draw.choice(inner)
            elif isinstance(inner, (array, np.ndarray)) and len(inner) and draw.random() < 0.7:
                item = kind.removeprefix("sequence<").partition("[")[0].rstrip(">")
                inner[draw.randrange(len(inner))] = _number(draw, item)
                break
            else:
                setattr(place, name, value(draw, kind))
                break
    return made


def garbage(draw: random.Random, right: Any) -> bytes:
    """Damaged bytes of a message: truncated, changed in places, or random."""
    data = bytearray(serialize_message(right))
    way = draw.randrange(4)
    if way == 0:
        return bytes(data[: draw.randrange(len(data))])
    if way == 1:
        return draw.randbytes(draw.choice((0, 1, 4, 60, 500, 5000)))
    if way == 2:
        return bytes(data[:4]) + draw.randbytes(len(data))
    for _ in range(draw.randint(1, 8)):
        data[draw.randrange(4, len(data))] = draw.choice((0, 1, 0x7F, 0x80, 0xFF, draw.randrange(256)))
    return bytes(data)


def hostile(draw: random.Random, right: Any) -> Any:
    """A random message, a changed one or damaged bytes, of the same type as a valid message."""
    way = draw.random()
    if way < 0.5:
        return changed(draw, right)
    return message(draw, type(right)) if way < 0.75 else garbage(draw, right)
