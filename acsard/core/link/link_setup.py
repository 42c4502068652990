"""What the configuration declares about the board and its lines, computed once.

The state of the link contains no configuration: each of its functions gets this as an argument.
"""

from __future__ import annotations

import math

from msgspec import Struct

from acsard.core.config.settings import MAX_REPLY_PERIOD_S, FeedbackConfig, McuConfig
from acsard.core.config.wire_time import plain_bytes, wire_ns
from acsard.core.link.checked_line import SAMPLE_REQUEST
from acsard.core.link.codec import Codec
from acsard.core.values import NS_PER_S, Ns, Seconds

# Firmware counts for at least 4 ms, and repeats its last speeds in a reply before that. More
# frequent replies must have its counts: if a board does not send them, a repeated speed looks like
# a new one, and would count twice.
MIN_COMMAND_INTERVAL_NS = 9_000_000

# A board may report its last instant or the mean since its last line. With a longer time than that
# of a line and this, the difference is a doubt: at 1 m/s2, it is 0.6 mm for 50 ms.
MAX_UNCOVERED_S = 0.05

LATE_STEP_FRACTION = 0.5  # of `quiet_ns`, between two steps: the second is late


class LinkSetup(Struct, frozen=True):
    mcu: McuConfig
    codec: Codec
    checked: bool  # `mcu.checked`
    letters: bytes  # that end a checked command
    rest: bytes  # begin of every line with speed zero
    period_ns: Ns  # of a free-running board; 0: it answers commands
    command_interval_ns: Ns  # between two commands
    line_s: Seconds  # that a line covers for sure
    covered_s: Seconds  # and for which it may count
    soonest_ns: Ns  # a command and its reply on the wire
    quiet_ns: Ns  # silence after which the link is stale
    late_step_ns: float  # time between two steps that makes the second late
    count: float  # rad of one encoder count; 0 if unknown
    shows_counts: bool  # speeds of plain lines show whole counts
    fastest: float  # counts per ms at `feedback.wheel_speed`
    encoders: bool  # `feedback.encoders`
    longest_reply: float  # highest value that `mcu.reply_period` may have, s

    @classmethod
    def of(
        cls,
        mcu: McuConfig,
        rate_hz: float,
        feedback: FeedbackConfig = FeedbackConfig(),  # noqa: B008
        longest_reply: float = MAX_REPLY_PERIOD_S,
    ) -> LinkSetup:
        codec, counts = Codec(mcu.wheels, mcu.trailing_comma), mcu.encoder_counts
        quiet_ns = int(NS_PER_S * max(0.1, 4 / rate_hz, 3 * mcu.reply_period))
        command_interval_ns = round(NS_PER_S / rate_hz)
        line_s = mcu.reply_period or 1 / rate_hz
        return cls(
            mcu,
            codec,
            checked=mcu.checked,
            letters=SAMPLE_REQUEST if mcu.wants_samples else b"",
            rest=codec.stop.rstrip(b",\r\n"),
            period_ns=0 if mcu.checked else round(NS_PER_S * mcu.reply_period),
            command_interval_ns=command_interval_ns,
            line_s=line_s,
            covered_s=line_s + MAX_UNCOVERED_S,
            soonest_ns=wire_ns(2 * plain_bytes(len(codec.letters)), mcu.baud_rate),
            quiet_ns=quiet_ns,
            late_step_ns=LATE_STEP_FRACTION * quiet_ns,
            count=math.tau / counts if counts else 0.0,
            shows_counts=mcu.reply_period > 0.0 or command_interval_ns >= MIN_COMMAND_INTERVAL_NS,
            fastest=feedback.wheel_speed / math.tau * counts / 1000,
            encoders=feedback.encoders,
            longest_reply=longest_reply,
        )
