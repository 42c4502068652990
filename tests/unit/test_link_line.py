"""The line to and from the board: written exactly, read strictly in meaning, leniently in form."""

from __future__ import annotations

import itertools
import math
import random
from collections import Counter
from collections.abc import Iterator
from decimal import Decimal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acsard.core.config.settings import WheelMap
from acsard.core.link.codec import Codec, FrameError
from acsard.core.link.lines import MAX_LINE_BYTES, LineReader
from acsard.core.values import WheelSpeeds
from tests.each import each
from tests.vectors.lines import (
    ACCEPTED,
    REFUSED,
    SEED_LINE,
    SEED_MOTORS,
    SEED_REPLY,
    WRITTEN,
    ZERO,
    Motors,
    of_two,
)

law = settings(max_examples=100)
SEED_SPEEDS = WheelSpeeds(*SEED_MOTORS)
CODEC = Codec(WheelMap())
speeds = st.builds(WheelSpeeds, *[st.floats(allow_nan=False, allow_infinity=False)] * 4)
small_speeds = st.builds(WheelSpeeds, *[st.floats(-101.0, 101.0)] * 4)
OF_TWO = WheelMap(right="+a", left="+b")
"""The motors of two wheels, by the letters of the first two of four."""
BOARDS = [
    pytest.param(Codec(WheelMap()), id="four"),
    pytest.param(Codec(OF_TWO), id="two"),
]


def wheel_map(signs: str, letters: str) -> WheelMap:
    """Return the map of four motors, in the order of their wheels, or of `right` and `left`."""
    motors = [sign + letter for sign, letter in zip(signs, letters, strict=True)]
    return WheelMap(*motors) if len(motors) == 4 else WheelMap(right=motors[0], left=motors[1])


def driven(wheels: WheelMap, speeds: WheelSpeeds) -> WheelSpeeds:
    """Return the speeds that a line can say: of two wheels, the rear ones do as the front ones."""
    right, left, *_ = speeds.as_tuple()
    return speeds if len(wheels.names) == 4 else WheelSpeeds(right, left, left, right)


wirings = st.builds(
    wheel_map,
    st.sampled_from(["".join(signs) for signs in itertools.product("+-", repeat=4)]),
    st.permutations("abcd").map("".join),
) | st.builds(
    wheel_map,
    st.sampled_from(["++", "+-", "-+", "--"]),
    st.lists(st.sampled_from("abcdefghijklmoqrstuvwxyz"), min_size=2, max_size=2, unique=True).map(
        "".join
    ),
)


def refusal(line: bytes, codec: Codec = CODEC) -> str:
    with pytest.raises(FrameError) as caught:
        codec.decode(line)
    assert str(caught.value) == f"{caught.value.reason}: {line[:60]!r}"
    return caught.value.reason


# writing


@each(
    ("signs", "letters", "comma", "line"),
    [
        ("++++", "abcd", False, b"ap12.50,bn08.75,cp15.00,dn10.25\r\n"),  # 33 bytes
        ("++++", "abcd", True, b"ap12.50,bn08.75,cp15.00,dn10.25,\r\n"),
        ("-+-+", "abcd", False, b"an12.50,bn08.75,cn15.00,dn10.25\r\n"),
        ("++++", "dcba", False, b"an10.25,bp15.00,cn08.75,dp12.50\r\n"),
        ("++", "rl", False, b"ln08.75,rp12.50\r\n"),  # 17 bytes
        ("-+", "ab", True, b"an12.50,bn08.75,\r\n"),
    ],
)
def test_the_seed_line_and_the_stop_byte_for_byte(
    signs: str, letters: str, comma: bool, line: bytes
) -> None:
    wheels = wheel_map(signs, letters)
    codec = Codec(wheels, comma)
    assert codec.encode(SEED_SPEEDS) == line
    assert codec.decode(line.rstrip()) == driven(wheels, SEED_SPEEDS)
    zeros = ",".join(f"{letter}p00.00" for letter in sorted(letters)).encode()
    assert codec.stop == zeros + b",\r\n"[not comma :]


@each(("speed", "token"), WRITTEN)
def test_a_speed_is_clamped_rounded_and_padded(speed: float, token: bytes) -> None:
    assert CODEC.encode(WheelSpeeds(speed)) == b"a" + token + ZERO[7:] + b"\r\n"
    assert CODEC.encode(WheelSpeeds(rear_right=speed)) == ZERO[:25] + token + b"\r\n"


@each("bad", [math.nan, math.inf, -math.inf])
@each("name", ["front_right", "front_left", "rear_left", "rear_right"])
def test_a_speed_that_is_not_finite_raises_a_value_error(name: str, bad: float) -> None:
    with pytest.raises(ValueError, match="not finite"):
        CODEC.encode(WheelSpeeds(**{name: bad}))


@law
@given(wheels=speeds | small_speeds, wiring=wirings, comma=st.booleans())
def test_each_line_has_a_padded_token_for_each_motor_and_is_read_back_within_half_a_hundredth(
    wheels: WheelSpeeds, wiring: WheelMap, comma: bool
) -> None:
    codec = Codec(wiring, comma)
    line = codec.encode(wheels)
    tokens = line.removesuffix(b",\r\n" if comma else b"\r\n").split(b",")
    assert [chr(token[0]) for token in tokens] == list(codec.letters)
    for token in tokens:
        assert len(token) == 7
        assert token[1:2] in (b"p", b"n")
        assert token[4:5] == b"."
        assert (token[2:4] + token[5:]).isdigit()
        assert token[1:] != b"n00.00"
    back = codec.decode(line.removesuffix(b"\r\n"))
    said = driven(wiring, wheels).as_tuple()
    for speed, read in zip(said, back.as_tuple(), strict=True):
        clamped = max(Decimal("-99.99"), min(Decimal("99.99"), Decimal(speed)))
        assert abs(Decimal(str(read)) - clamped) <= Decimal("0.005000001")
    assert codec.encode(back) == line


# reading


@each(("line", "motors"), ACCEPTED)
def test_a_line_is_read_in_every_accepted_form(line: bytes, motors: Motors) -> None:
    speeds = WheelSpeeds(*motors)
    for comma in (False, True):
        assert Codec(WheelMap(), comma).decode(line) == speeds
        assert Codec(OF_TWO, comma).decode(of_two(line)) == driven(OF_TWO, speeds)
    assert independent(line, "abcd") == motors
    assert independent(of_two(line), "ab") == motors[:2]


@each(("line", "reason"), [*REFUSED, (b"x" * 70, "malformed")])
def test_a_line_is_refused_whole_and_for_its_reason(line: bytes, reason: str) -> None:
    assert refusal(line) == reason
    assert independent(line, "abcd") is None


@each(
    ("line", "reason"),
    [
        *((of_two(line), reason) for line, reason in REFUSED if line.endswith(b",cp15.00,dn10.25")),
        (SEED_LINE, "malformed"), (b"ap12.50", "malformed"), (b"ap12.50,cp15.00", "malformed"),
    ],
)  # fmt: skip
def test_a_line_of_two_motors_is_refused_for_the_same_reasons_and_for_other_motors(
    line: bytes, reason: str
) -> None:
    assert refusal(line, Codec(OF_TWO)) == reason
    assert independent(line, "ab") is None


# damage


def independent(line: bytes, letters: str) -> tuple[float, ...] | None:
    """Parse a line with code that shares nothing with acsard; None if it is not well-formed."""
    tokens = line.split(b",")
    if len(tokens) == len(letters) + 1 and not tokens[-1].strip(b" "):
        tokens.pop()
    if len(tokens) != len(letters):
        return None
    values: dict[str, float] = {}
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
        motor = chr(token[0])
        if motor not in letters or token[1] not in b"pn" or thousandths > 99_990:
            return None
        values[motor] = (thousandths if token[1] == ord("p") else -thousandths) / 1000
    return tuple(values[motor] for motor in letters) if len(values) == len(letters) else None


def valid(dice: random.Random, letters: str) -> bytes:
    """Return a random well-formed line in one of the accepted forms."""
    form = dice.choice(("%05.2f", "%05.2f", "%.2f", "%.3f"))
    speeds = [dice.choice((0.0, 9.99, 99.99, dice.random() * 99.9)) for _ in letters]
    tokens = [
        f"{a}{dice.choice('pn')}{form % speed}" for a, speed in zip(letters, speeds, strict=True)
    ]
    return (dice.choice((",", ", ")).join(tokens) + dice.choice(("", "", "", ","))).encode()


def wire(dice: random.Random, letters: str, count: int) -> Iterator[bytes]:
    """Yield `count` lines in random pieces. One in six lines is undamaged."""
    buffer, other = b"", valid(dice, letters)
    for _ in range(count):
        line, place = valid(dice, letters), dice.randrange(len(other) // 2)
        before, after = line[:place], line[place:]
        buffer += dice.choice(
            (
                line,
                before + after[dice.randint(1, 19) :],  # bytes are missing
                line + other[dice.randrange(20) :],  # it runs into the next one
                before + other[place + dice.choice((0, 0, 3)) :],  # the rest is another line's
                before
                + bytes([dice.choice(b"abcdpn0123456789.,- \r\x00")])
                + after[dice.randrange(2) :],
                before + bytes([after[0] ^ 1 << dice.randrange(8)]) + after[1:],
            )
        )
        buffer += dice.choice((b"\r\n", b"\r\n", b"\n"))
        other, cut = line, dice.randrange(len(buffer) + 1)
        yield buffer[:cut]
        buffer = buffer[cut:]
    yield buffer


SOAK = pytest.param(1_000_000, marks=[pytest.mark.soak, pytest.mark.timeout(900)])


@pytest.mark.parametrize("codec", BOARDS)
@pytest.mark.parametrize("count", [3000, SOAK])
def test_a_damaged_line_is_rejected_whole_or_is_itself_a_well_formed_line(
    count: int, codec: Codec
) -> None:
    reader, tally, letters = LineReader(), Counter[str](), codec.letters
    for piece in wire(random.Random(20_240_229), letters, count):
        for line, _ in reader.feed(piece):
            found = independent(line, letters)
            if found is None:
                tally[refusal(line, codec)] += 1
            else:
                assert codec.decode(line).as_tuple()[: len(found)] == found, line
                tally["read"] += 1
    assert sum(tally.values()) > 0.95 * count
    assert set(tally) == {"read", "malformed", "duplicate_wheel", "over_range"}


# lines from bytes, however these are cut

pieces = st.one_of(
    st.sampled_from([SEED_LINE + b"\r\n", SEED_REPLY + b"\n", ZERO + b"\r\n"]),
    st.sampled_from([b"\n", b"\r\n", b"\r", b"\r\r\n", b"a\rb\r\n", SEED_LINE[:17], b"\x00\xff"]),
    st.integers(MAX_LINE_BYTES - 3, 3 * MAX_LINE_BYTES).map(lambda n: b"x" * n),
    st.binary(max_size=40),
)
"""Anything that a wire may carry: lines, line ends, halves, runs near the maximum length, noise."""


def feed(reader: LineReader, *chunks: bytes) -> list[bytes]:
    return [line for chunk in chunks for line, _ in reader.feed(chunk)]


@law
@given(st.lists(pieces, max_size=12).map(b"".join), st.sets(st.integers(0, 500)))
def test_the_lines_are_the_text_split_at_newlines_wherever_it_is_cut(
    data: bytes, places: set[int]
) -> None:
    *ended, _ = (data + b"\n").split(b"\n")
    whole = [line for line in ended if len(line) + 1 <= MAX_LINE_BYTES]
    expected = [line for each in whole if (line := each.strip(b"\r"))]
    ends = [place for place in sorted(places) if place <= len(data)]
    cut = [data[a:b] for a, b in zip([0, *ends], [*ends, len(data)], strict=True)]
    for chunks in (cut, [data[i : i + 1] for i in range(len(data))]):
        reader, found, before = LineReader(), list[bytes](), b""
        for chunk in (*chunks, b"\n"):
            for line, following in reader.feed(chunk):
                upto = before + chunk[: len(chunk) - following]
                assert upto.removesuffix(b"\n").rstrip(b"\r").endswith(line)
                found.append(line)
            before += chunk
        assert found == expected
        assert reader.too_long == len(ended) - len(whole)


@each("length", [1, 7, 127, 128, 129, 1000])
def test_after_an_over_long_line_the_next_newline_resynchronises(length: int) -> None:
    reader, noise = LineReader(), b"x" * 1000
    chunks = [noise[i : i + length] for i in range(0, 1000, length)]
    assert feed(reader, *chunks, SEED_LINE + b"\r\n", SEED_REPLY + b"\r\n") == [SEED_REPLY]
    assert reader.too_long == 1
    assert feed(reader, b"x" * 127 + b"\n", b"x" * 126 + b"\r\n") == [b"x" * 127, b"x" * 126]
    assert feed(reader, b"x" * 128 + b"\n", b"x" * 127 + b"\r\n") == []
