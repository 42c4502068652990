"""Tests of the conversion between lines and wheel speeds.

Writing is exact. Reading is strict in meaning and lenient in form.
"""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Iterator
from decimal import Decimal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.settings import DriveConfig, Motor, WheelMap
from acsard.core.link.codec import Codec, FrameError
from acsard.core.link.lines import LineReader
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import Twist, WheelSpeeds
from tests.each import each
from tests.vectors.lines import (
    ACCEPTED,
    REFUSED,
    SEED_LINE,
    SEED_MOTORS,
    WRITTEN,
    ZERO,
    Motors,
)

SEED_SPEEDS = WheelSpeeds(*SEED_MOTORS)

speeds = st.builds(WheelSpeeds, *[st.floats(allow_nan=False, allow_infinity=False)] * 4)
small_speeds = st.builds(WheelSpeeds, *[st.floats(-101.0, 101.0)] * 4)


def wheel_map(signs: str, letters: str) -> WheelMap:
    return WheelMap(*(_MOTORS[sign + letter] for sign, letter in zip(signs, letters, strict=True)))


_MOTORS: dict[str, Motor] = {
    "+a": "+a", "-a": "-a", "+b": "+b", "-b": "-b", "+c": "+c", "-c": "-c", "+d": "+d", "-d": "-d",
}  # fmt: skip

wirings = st.builds(
    wheel_map,
    st.sampled_from(["".join(signs) for signs in itertools.product("+-", repeat=4)]),
    st.permutations("abcd").map("".join),
)


@pytest.fixture
def codec() -> Codec:
    return Codec(WheelMap())


# writing


def test_the_seed_line_is_written_byte_for_byte(codec: Codec) -> None:
    line = codec.encode(SEED_SPEEDS)
    assert line == b"ap12.50,bn08.75,cp15.00,dn10.25\r\n"
    assert len(line) == 33


def test_a_trailing_comma_goes_before_the_end_of_the_line() -> None:
    line = Codec(WheelMap(), trailing_comma=True).encode(SEED_SPEEDS)
    assert line == b"ap12.50,bn08.75,cp15.00,dn10.25,\r\n"


def test_the_stop_line_has_plus_zero_for_each_wheel() -> None:
    assert Codec(WheelMap()).stop == ZERO + b"\r\n"
    assert Codec(WheelMap(), trailing_comma=True).stop == ZERO + b",\r\n"
    assert Codec(wheel_map("----", "dcba")).stop == ZERO + b"\r\n"


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("front_right", b"ap01.00,bp00.00,cp00.00,dp00.00\r\n"),
        ("front_left", b"ap00.00,bp01.00,cp00.00,dp00.00\r\n"),
        ("rear_left", b"ap00.00,bp00.00,cp01.00,dp00.00\r\n"),
        ("rear_right", b"ap00.00,bp00.00,cp00.00,dp01.00\r\n"),
    ],
)
def test_each_wheel_has_its_motor(codec: Codec, name: str, line: bytes) -> None:
    wheel = WheelSpeeds(**{name: 1.0})
    assert codec.encode(wheel) == line
    assert codec.decode(line.strip()) == wheel


def test_a_left_turn_drives_a_and_d_forward_and_b_and_c_backward(codec: Codec) -> None:
    # 2 rad/s x 0.15 m / 0.05 m gives 6 rad/s.
    left_turn = Kinematics(DriveConfig()).wheel_speeds(Twist(0.0, 2.0))
    assert codec.encode(left_turn) == b"ap06.00,bn06.00,cn06.00,dp06.00\r\n"


@pytest.mark.parametrize(("speed", "token"), WRITTEN)
def test_a_speed_is_clamped_rounded_and_padded(codec: Codec, speed: float, token: bytes) -> None:
    assert codec.encode(WheelSpeeds(speed)) == b"a" + token + ZERO[7:] + b"\r\n"
    assert codec.encode(WheelSpeeds(rear_right=speed)) == ZERO[:25] + token + b"\r\n"


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["front_right", "front_left", "rear_left", "rear_right"])
def test_a_speed_that_is_not_finite_raises_a_value_error(
    codec: Codec, name: str, bad: float
) -> None:
    with pytest.raises(ValueError, match="not finite"):
        codec.encode(WheelSpeeds(**{name: bad}))


@given(wheels=speeds, wiring=wirings)
def test_every_line_written_has_four_padded_tokens_and_no_negative_zero(
    wheels: WheelSpeeds, wiring: WheelMap
) -> None:
    line = Codec(wiring).encode(wheels)
    tokens = line.removesuffix(b"\r\n").split(b",")
    assert [chr(token[0]) for token in tokens] == list("abcd")
    for token in tokens:
        assert len(token) == 7
        assert token[1:2] in (b"p", b"n")
        assert token[4:5] == b"."
        assert (token[2:4] + token[5:]).isdigit()
        assert token[1:] != b"n00.00"


@given(speed=st.floats(-120.0, 120.0))
def test_a_written_speed_is_at_most_half_a_hundredth_off(speed: float) -> None:
    token = Codec(WheelMap()).encode(WheelSpeeds(speed))[1:7]
    value = Decimal(token[1:].decode()) * (1 if token[:1] == b"p" else -1)
    clamped = max(Decimal("-99.99"), min(Decimal("99.99"), Decimal(speed)))
    assert abs(value - clamped) <= Decimal("0.005000001")


# reading


@pytest.mark.parametrize(("line", "motors"), ACCEPTED)
def test_a_line_is_read_in_every_accepted_form(codec: Codec, line: bytes, motors: Motors) -> None:
    assert codec.decode(line).as_tuple() == motors


@each(("line", "motors"), ACCEPTED)
def test_the_dialect_written_does_not_change_what_is_read(line: bytes, motors: Motors) -> None:
    assert Codec(WheelMap(), trailing_comma=True).decode(line).as_tuple() == motors


@pytest.mark.parametrize(("line", "reason"), REFUSED)
def test_a_line_is_refused_whole_and_for_its_reason(codec: Codec, line: bytes, reason: str) -> None:
    with pytest.raises(FrameError) as caught:
        codec.decode(line)
    assert caught.value.reason == reason


def test_a_refusal_contains_its_reason_and_the_beginning_of_the_line(codec: Codec) -> None:
    with pytest.raises(FrameError) as caught:
        codec.decode(b"x" * 70)
    assert str(caught.value) == f"malformed: {b'x' * 60!r}"


@pytest.mark.parametrize("order", ["".join(order) for order in itertools.permutations("abcd")])
def test_the_wheels_may_come_in_any_order(codec: Codec, order: str) -> None:
    token = {chr(token[0]): token for token in SEED_LINE.split(b",")}
    assert codec.decode(b",".join(token[letter] for letter in order)) == SEED_SPEEDS


@each(
    "letters",
    ["".join(w) for w in itertools.product("abcd", repeat=4) if len(set(w)) < 4],
)
def test_each_wheel_must_be_there_exactly_once(codec: Codec, letters: str) -> None:
    line = ",".join(f"{letter}p01.00" for letter in letters).encode()
    with pytest.raises(FrameError) as caught:
        codec.decode(line)
    assert caught.value.reason == "duplicate_wheel"


# the wiring


def test_signs_are_applied_when_writing() -> None:
    codec = Codec(wheel_map("-+-+", "abcd"))
    assert codec.encode(SEED_SPEEDS) == b"an12.50,bn08.75,cn15.00,dn10.25\r\n"


def test_signs_are_applied_when_reading() -> None:
    codec = Codec(wheel_map("-+-+", "abcd"))
    assert codec.decode(SEED_LINE).as_tuple() == (-12.5, -8.75, -15.0, -10.25)


def test_motor_letters_are_mapped_to_wheels_when_writing_and_reading() -> None:
    codec = Codec(wheel_map("++++", "dcba"))
    assert codec.encode(SEED_SPEEDS) == b"an10.25,bp15.00,cn08.75,dp12.50\r\n"
    assert codec.decode(SEED_LINE).as_tuple() == SEED_MOTORS[::-1]


@given(wheels=small_speeds, wiring=wirings, trailing_comma=st.booleans())
def test_a_written_speed_is_read_back_within_half_a_hundredth(
    wheels: WheelSpeeds, wiring: WheelMap, trailing_comma: bool
) -> None:
    codec = Codec(wiring, trailing_comma)
    back = codec.decode(codec.encode(wheels).removesuffix(b"\r\n"))
    for speed, read in zip(wheels.as_tuple(), back.as_tuple(), strict=True):
        assert read == pytest.approx(max(-99.99, min(99.99, speed)), abs=0.005 + 1e-9)


@given(wheels=small_speeds, wiring=wirings)
def test_a_line_that_was_read_back_is_written_identically(
    wheels: WheelSpeeds, wiring: WheelMap
) -> None:
    codec = Codec(wiring)
    line = codec.encode(wheels)
    assert codec.encode(codec.decode(line.removesuffix(b"\r\n"))) == line


# damage


def independent(line: bytes) -> Motors | None:
    """Parse a line with code that shares nothing with acsard.

    Return None if the line is not well-formed.
    """
    tokens = line.split(b",")
    if len(tokens) == 5 and not tokens[4].strip(b" "):
        tokens.pop()
    if len(tokens) != 4:
        return None
    values: dict[int, float] = {}
    for number, token in enumerate(tokens):
        if number:
            token = token.lstrip(b" ")
        whole, point, decimals = token[2:].partition(b".")
        digits = whole + decimals
        if len(token) < 5 or not point or any(byte not in b"0123456789" for byte in digits):
            return None
        if not 1 <= len(whole) <= 2 or not 1 <= len(decimals) <= 3:
            return None
        thousandths = int(whole) * 1000 + int(decimals.ljust(3, b"0"))
        if token[0] not in b"abcd" or token[1] not in b"pn" or thousandths > 99_990:
            return None
        values[token[0]] = (thousandths if token[1] == ord("p") else -thousandths) / 1000
    if len(values) != 4:
        return None
    return values[97], values[98], values[99], values[100]


@each(("line", "motors"), ACCEPTED)
def test_the_independent_reader_accepts_every_accepted_line(line: bytes, motors: Motors) -> None:
    assert independent(line) == motors


@each("line", [line for line, _ in REFUSED])
def test_the_independent_reader_refuses_every_refused_line(line: bytes) -> None:
    assert independent(line) is None


def valid(rng: random.Random) -> bytes:
    """Return a random well-formed line in one of the accepted forms."""
    letters = "abcd" if rng.random() < 0.9 else "".join(rng.sample("abcd", 4))
    form = rng.choice(("%05.2f", "%05.2f", "%05.2f", "%.2f", "%.3f"))
    comma = rng.choice((",", ",", ", "))
    speeds = [rng.choice((0.0, 9.99, 99.99, *[rng.random() * 99.9] * 9)) for _ in letters]
    tokens = [
        f"{letter}{rng.choice('pn')}{form % speed}"
        for letter, speed in zip(letters, speeds, strict=True)
    ]
    return (comma.join(tokens) + rng.choice(("", "", "", ","))).encode()


def damaged(rng: random.Random, line: bytes, other: bytes) -> bytes:
    """Return `line` as a bad wire might deliver it."""
    kind, place = rng.randrange(8), rng.randrange(len(line))
    match kind:
        case 0:  # the start or the end is missing
            return line[place:] if rng.random() < 0.5 else line[:place]
        case 1:  # some bytes are missing inside
            return line[:place] + line[place + rng.randint(1, 9) :]
        case 2:  # the line runs into the next one, whole or in part
            return line + rng.choice((b"", b",", b"\r", other)) + other[rng.randrange(30) :]
        case 3:  # the rest is another line's
            return line[:place] + other[place:]
        case 4:  # the rest is another line's, shifted
            return line[:place] + other[rng.randrange(len(other)) :]
        case 5:  # one additional byte
            return line[:place] + bytes([rng.randrange(256)]) + line[place:]
        case 6:  # a wrong byte of the most harmful kind
            return (
                line[:place]
                + bytes([rng.choice(b"abcdpn0123456789.,- \r\x00")])
                + line[place + 1 :]
            )
        case _:  # flipped bits
            broken = bytearray(line)
            for _ in range(rng.randint(1, 2)):
                broken[rng.randrange(len(broken))] ^= 1 << rng.randrange(8)
            return bytes(broken)


def wire(rng: random.Random, count: int) -> Iterator[bytes]:
    """Yield `count` lines in random pieces. One in five lines is undamaged."""
    other, buffer = valid(rng), b""
    for _ in range(count):
        line = valid(rng)
        sent = line if rng.random() < 0.2 else damaged(rng, line, other)
        buffer += sent + rng.choice((b"\r\n", b"\r\n", b"\n"))
        other = line
        cut = rng.randrange(len(buffer) + 1)
        yield buffer[:cut]
        buffer = buffer[cut:]
    yield buffer


@pytest.mark.parametrize(
    "count",
    [
        20_000,
        pytest.param(100_000, marks=pytest.mark.slow),
        pytest.param(1_000_000, marks=[pytest.mark.soak, pytest.mark.timeout(900)]),
    ],
)
def test_a_damaged_line_is_rejected_whole_or_is_itself_a_well_formed_line(count: int) -> None:
    rng, reader, codec = random.Random(20_240_229), LineReader(), Codec(WheelMap())
    tally = {"read": 0, "malformed": 0, "duplicate_wheel": 0, "over_range": 0}
    for piece in wire(rng, count):
        for line, _ in reader.feed(piece):
            expected = independent(line)
            try:
                values = codec.decode(line).as_tuple()
            except FrameError as error:
                tally[error.reason] += 1
                assert expected is None, line
            else:
                tally["read"] += 1
                assert values == expected, line
    assert sum(tally.values()) > 0.95 * count
    assert all(tally.values()), tally


def test_motor_values_are_put_in_the_order_of_the_wheels_with_their_signs() -> None:
    codec = Codec(WheelMap("-d", "+c", "-b", "+a"))
    assert codec.wheels((1.0, 2.0, 3.0, 4.0)) == (-4.0, 3.0, -2.0, 1.0)


@given(wiring=wirings, motors=st.tuples(*[st.floats(0.0, 99.0)] * 4))
def test_motor_values_map_to_wheels_in_the_same_way_as_a_line(
    wiring: WheelMap, motors: Motors
) -> None:
    rounded = tuple(round(motor, 2) for motor in motors)
    tokens = zip("abcd", rounded, strict=True)
    line = ",".join(f"{letter}p{speed:05.2f}" for letter, speed in tokens).encode()
    codec = Codec(wiring)
    a, b, c, d = rounded
    assert codec.decode(line).as_tuple() == codec.wheels((a, b, c, d))
