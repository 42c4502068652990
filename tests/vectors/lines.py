"""Lines of the MCU protocol.

The tables have lines that acsard reads, lines that it refuses with the reason, and lines that it
writes.
"""

from __future__ import annotations

Motors = tuple[float, float, float, float]

SEED_LINE = b"ap12.50,bn08.75,cp15.00,dn10.25"
"""The line every description of this protocol shows; with CR LF it is 33 bytes."""

SEED_REPLY = b"ap15.23, bn12.45, cp14.67, dn13.89"
"""The reply they show with it: a space follows each comma."""

SEED_MOTORS: Motors = (12.5, -8.75, 15.0, -10.25)
"""What SEED_LINE says of the motors a, b, c, d, in rad/s."""

ZERO = b"ap00.00,bp00.00,cp00.00,dp00.00"

ACCEPTED: list[tuple[bytes, Motors]] = [
    (SEED_LINE, SEED_MOTORS),
    (SEED_REPLY, (15.23, -12.45, 14.67, -13.89)),
    (ZERO, (0.0, 0.0, 0.0, 0.0)),
    (b"an00.00,bn00.00,cn00.00,dn00.00", (0.0, 0.0, 0.0, 0.0)),
    (b"ap99.99,bn99.99,cp99.990,dn99.99", (99.99, -99.99, 99.99, -99.99)),
    # a trailing comma, bare or with spaces
    (b"ap12.50,bn08.75,cp15.00,dn10.25,", SEED_MOTORS),
    (b"ap12.50,bn08.75,cp15.00,dn10.25, ", SEED_MOTORS),
    (b"ap12.50, bn08.75, cp15.00, dn10.25,", SEED_MOTORS),
    # any number of spaces after any comma
    (b"ap12.50,  bn08.75,cp15.00,     dn10.25", SEED_MOTORS),
    # one integer digit, one to three decimals, as unpadded sketches print them
    (b"ap12.5,bn8.75,cp15.0,dn10.25", SEED_MOTORS),
    (b"ap12.500,bn8.750,cp15.000,dn10.250,", SEED_MOTORS),
    (b"ap0.001,bn0.1,cp1.25,dn9.999", (0.001, -0.1, 1.25, -9.999)),
    # the wheels in any order
    (b"dn10.25,cp15.00,bn08.75,ap12.50", SEED_MOTORS),
    (b"cp15.00,ap12.50,dn10.25,bn08.75,", SEED_MOTORS),
]
"""Line without its end -> rad/s of the motors a, b, c, d."""

REFUSED: list[tuple[bytes, str]] = [
    (b"", "malformed"),
    (b"hello", "malformed"),
    (b"\x00\xf8\xff~boot", "malformed"),
    # too few wheels, too many, an empty place
    (b"ap12.50", "malformed"),
    (b"ap12.50,bn08.75,cp15.00", "malformed"),
    (b"ap12.50,bn08.75,cp15.00,", "malformed"),
    (b"ap12.50,bn08.75,cp15.00,dn10.25,ap12.50", "malformed"),
    (b"ap12.50,,bn08.75,cp15.00,dn10.25", "malformed"),
    (b",ap12.50,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"ap12.50,bn08.75,cp15.00,dn10.25,,", "malformed"),
    # two lines run together, half a line, a line begun twice
    (b"ap12.50,bn08.75,cp15.00,dn10.25ap12.50,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"ap12.50,bn08.7ap12.50,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"p12.50,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"ap12.50,bn08.75,cp15.00,dn10", "malformed"),
    (b"ap12.50,bn08.75,cp15.00,dn10.", "malformed"),
    # letters that name neither a motor nor a direction
    (b"ep12.50,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"Ap12.50,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"ax12.50,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"aP12.50,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"a12.50,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"a+12.50,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"ap-2.50,bn08.75,cp15.00,dn10.25", "malformed"),
    # numbers of another shape
    (b"ap100.00,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"ap012.50,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"ap12.5000,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"ap12,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"ap.50,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"ap1_2.50,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"ap1e1.50,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"apnan,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"apinf,bn08.75,cp15.00,dn10.25", "malformed"),
    ("ap\u0661\u0662.50,bn08.75,cp15.00,dn10.25".encode(), "malformed"),  # Arabic digits
    # spaces where they do not belong, other separators, left-over ends
    (b" ap12.50,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"ap12.50,bn08.75,cp15.00,dn10.25 ", "malformed"),
    (b"ap12.50 ,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"a p12.50,bn08.75,cp15.00,dn10.25", "malformed"),
    (b"ap12.50,\tbn08.75,cp15.00,dn10.25", "malformed"),
    (b"ap12.50;bn08.75;cp15.00;dn10.25", "malformed"),
    (b"ap12.50 bn08.75 cp15.00 dn10.25", "malformed"),
    (b"ap12.50,bn08.75,cp15.00,dn10.25\r", "malformed"),
    (b"ap12.50,bn08.75,cp15.00,dn10.25\n", "malformed"),
    (b"ap12.50,bn08.75,cp15.00,dn10.25\x00", "malformed"),
    # four good wheels, but one of them is there twice
    (b"ap12.50,ap12.50,cp15.00,dn10.25", "duplicate_wheel"),
    (b"ap12.50,bn08.75,cp15.00,cn10.25", "duplicate_wheel"),
    (b"dp00.00,dp00.00,dp00.00,dp00.00", "duplicate_wheel"),
    # more than two digits and two decimals can say
    (b"ap99.991,bn08.75,cp15.00,dn10.25", "over_range"),
    (b"ap12.50,bn08.75,cp15.00,dn99.999", "over_range"),
]
"""Line without its end -> the reason it is refused for."""


def of_two(line: bytes) -> bytes:
    """Return a line of `ACCEPTED` or `REFUSED` for a board that has only the motors a and b."""
    values = [value for value in line.split(b",") if value.strip()[:1] not in (b"c", b"d")]
    return b",".join(values)


WRITTEN: list[tuple[float, bytes]] = [
    (0.0, b"p00.00"),
    (-0.0, b"p00.00"),
    (12.5, b"p12.50"),
    (-8.75, b"n08.75"),
    # too small to say: nothing, and nothing has no minus
    (0.004, b"p00.00"),
    (-0.001, b"p00.00"),
    (-0.00499, b"p00.00"),
    (5e-324, b"p00.00"),
    (-5e-324, b"p00.00"),
    # half a hundredth is one
    (0.005, b"p00.01"),
    (-0.005, b"n00.01"),
    (-0.01, b"n00.01"),
    # where naive formatting writes one character too many
    (9.99, b"p09.99"),
    (9.994, b"p09.99"),
    (9.996, b"p10.00"),
    (9.999, b"p10.00"),
    (-9.999, b"n10.00"),
    (10.0, b"p10.00"),
    # the top of the scale
    (99.984, b"p99.98"),
    (99.986, b"p99.99"),
    (99.99, b"p99.99"),
    (99.994, b"p99.99"),
    (99.995, b"p99.99"),
    (99.999, b"p99.99"),
    (-99.999, b"n99.99"),
    (100.0, b"p99.99"),
    (1e308, b"p99.99"),
    (-1e308, b"n99.99"),
]
"""rad/s -> the six characters after the motor's letter."""

WIRE = [
    # baud, (ms, max Hz) of 33 B, of 36 B, of 41 B: the table of MCU section 2, rates rounded down
    (9600, (34.4, 29), (37.5, 26), (42.7, 23)),
    (19200, (17.2, 58), (18.8, 53), (21.4, 46)),
    (38400, (8.59, 116), (9.38, 106), (10.7, 93)),
    (57600, (5.73, 174), (6.25, 160), (7.12, 140)),
    (115200, (2.86, 349), (3.13, 320), (3.56, 280)),
]
