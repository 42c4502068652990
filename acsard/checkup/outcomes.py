"""All printed words of the check, and the findings that are made of them.

A step names its outcome and gives the measured figures that go into the words.
"""

from __future__ import annotations

import re

from msgspec import Struct, convert

from acsard.checkup.findings import Finding, Verdict

# VERDICT step: outcome | figure
#     the meaning
#     -> the remedy
# A "?" after the verdict marks an outcome that a late computer can cause, whatever the board does.
OUTCOMES = """
PASS baud rate: right | {rate} baud
FAIL baud rate: other | {rate}, not {configured} baud
    {heard} at the configured {configured} baud; good lines at {rate}
    -> write mcu.baud_rate = {rate}; the check goes on with it
FAIL baud rate: nothing | nothing heard
    {heard} at {configured} baud, and no good line at any other
    -> is it the right port (`acsard ports`), is it powered, does it answer, are TX and RX crossed?
FAIL baud rate: cut | pieces of lines
    at {configured} baud {heard}; no good line at any other
    -> the firmware cuts its replies short or leaves out the line end: all four values and
    Serial.println() in one reply; is its send buffer too small, does it start anew while it writes?
FAIL baud rate: foreign | other bytes on its lines
    at {configured} baud {heard}; no good line at any other
    -> the baud rate is right, but something else is on the line: a debug print of the firmware or
    a second program at this port; else noise: one ground for board and computer, a short cable away
    from the motors' leads
FAIL baud rate: garbage | only garbage
    at {configured} baud {heard}; no good line at any other
    -> does the firmware speak at 9600 to 115200 baud, at TTL level and not RS-232? is it the right
    port (`acsard ports`), and the board's ground joined to the computer's?
FAIL baud rate: few | hardly a good line
    at {configured} baud {heard}; fewer good lines at any other
    -> a short cable away from the motors' leads, one ground, a lower baud rate at both ends
FAIL baud rate: sparse | good lines, too far apart
    at {configured} baud {heard}, all of them good; no good line at any other
    -> the board must answer each line, or report by its own clock every 0.25 s or sooner; is its
    loop held up by delay() or by a slow print?

PASS identification: named | {short}
    {text}
PASS identification: none | none
    it does not name itself, and need not
FAIL identification: echo | an echo
    what comes back is what was sent: no microcontroller speaks here
    -> are TX and RX joined? is the firmware one that echoes its input?

PASS reply form: right | as documented
WARN reply form: other | {forms}
    replies look like {line!r}: read all the same
    -> nothing to do; `ap00.00,bp00.00,cp00.00,dp00.00` is shorter on the wire, and certain

PASS? reply rate: right | {rate:.0f} Hz, {way}
    longest gap {longest:.0f} ms
WARN? reply rate: lossy | {rate:.0f} Hz, {way}
    only {answered:.0%} of the lines were answered
    -> odometry is as fine as this; whether lines get lost is counted below
FAIL? reply rate: slow | {rate:.0f} Hz, {way}
    one reply in {gap:.0f} ms: the host takes {quiet:.0f} ms of silence for a lost link
    -> write mcu.reply_period = {period:g}, or have every line answered
FAIL? reply rate: rare | {rate:.1f} Hz, {way}
    one reply in {gap:.0f} ms: too seldom for a link by any setting
    -> have every line answered, or reports of its own every {most:g} s or sooner
FAIL? reply rate: none | too few replies
    lines go unanswered
    -> the firmware must answer every line, or by its clock

PASS round trip: right | p50 {middle:.1f} ms, max {longest:.1f} ms
WARN? round trip: slow | p50 {middle:.1f} ms, max {longest:.1f} ms
    news of the wheels come late
    -> firmware that waits? an FTDI chip does, 16 ms unless its latency_timer is 1 (`doctor`)
SKIPPED round trip: own clock
    it answers by its own clock: a reply says nothing of the line before it
SKIPPED? round trip: none
    no line by itself was answered

PASS checked link: in use | {figure}
PASS checked link: off | {figure}
    supported, and not in use: the lines below switch it on
SKIPPED? checked link: plain | plain
    the firmware answers plain: a damaged line can say a wrong speed
FAIL? checked link: required | none
    the firmware answers plain: a damaged line can say a wrong speed
    -> write mcu.link_check = "auto", or give the board firmware that knows the check

PASS lost lines: none | none of {lines}
PASS lost lines: few | {lost} of {lines}
WARN? lost lines: late | none of {lines}, but silent for {silent:.0f} ms
    so long nothing came, then all at once: the host takes that for a lost link, and the robot stops
    -> another USB port without a hub, no power saving of USB; does the firmware wait somewhere?
FAIL? lost lines: back | {share:.0%} of {lines}
    {damaged} came damaged from the board, the last `{last}`
    -> the lead from the board's TX to the computer's RX; a short cable away from the motors' leads,
    one ground, a lower baud rate at both ends
FAIL? lost lines: both | {share:.0%} of {lines}
    {damaged} came damaged from the board, the last `{last}`; others were lost there or back
    -> a short cable away from the motors' leads, one ground, a lower baud rate at both ends
FAIL? lost lines: either | {share:.0%} of {lines}
    so many had no answer: lost on the way there, or the answer on its way back; see below
    -> a short cable away from the motors' leads, one ground, a lower baud rate at both ends
FAIL? lost lines: silent | {share:.0%} of {lines}
    so many of the board's own reports did not come
    -> the lead from the board's TX to the computer's RX; a short cable away from the motors' leads,
    one ground, a lower baud rate at both ends

PASS lost where: not seen | none of {sent} more
FAIL? lost where: there | {there} of {sent} there, {back} back
    lines are lost on the way to the board: the motors did not do what these said
    -> the lead from the computer's TX to the board's RX, ground, a lower baud rate; does the
    firmware read its buffer often enough?
FAIL? lost where: back | {there} of {sent} there, {back} back
    answers are lost on their way back: the motors did what the lines said
    -> the lead from the board's TX to the computer's RX, the ground, a lower baud rate at both ends
FAIL? lost where: both | {there} of {sent} there, {back} back
    lines and answers are lost
    -> the ground of board and computer first, then cable and plugs; a lower baud rate at both ends
SKIPPED? lost where: untold
    the motors cannot show on which way: too slow, too coarsely seen, or too much is lost

PASS motor: right | {figure}
WARN? motor: off | {figure}
    {error:.0%} {which} than the {speed:g} rad/s it was told: the robot will not drive straight
    -> if slower: does the wheel turn freely, are supply and driver enough for it, is the motor
    worn? else counts per turn and gear ratio in the firmware
FAIL? motor: dead, not seen | {figure}
    encoder {here} shows nothing: a dead encoder, or a motor that does not turn
    -> look whether the wheel turns: if it does, the encoder's supply and leads; if not, the
    driver, fuse and leads of motor {here}
FAIL? motor: dead, still | {figure}
    motor {here} does not turn
    -> driver, fuse, enable and leads of motor {here}
FAIL? motor: dead, turns | {figure}
    the wheel turns, and encoder {here} shows nothing: a dead encoder
    -> supply, plug and A and B of encoder {here}
FAIL motor: reversed, not seen | {figure}
    encoder {here} counts against motor {here}; no configuration mends that
    -> swap the two leads of motor {here} if the wheel turns the wrong way, else A and B of
    encoder {here}
FAIL motor: reversed, encoder | {figure}
    encoder {here} counts against motor {here}; no configuration mends that
    -> the motor is right: swap A and B of encoder {here}
FAIL motor: reversed, motor | {figure}
    encoder {here} counts against motor {here}; no configuration mends that
    -> the motor is reversed: swap the two leads of motor {here}
FAIL motor: other, not seen | {shown}
    motor {here} moves encoder {there}: two motors or two encoders are swapped{reversed}
    -> look which wheel turns: if the {wheel} one, swap encoders {here} and {there}, else motors
    {here} and {there}
FAIL motor: other, encoder | {shown}
    motor {here} moves encoder {there}: two motors or two encoders are swapped{reversed}
    -> the motor is right: swap the plugs of encoders {here} and {there}
FAIL motor: other, motor | {shown}
    motor {here} moves encoder {there}: two motors or two encoders are swapped{reversed}
    -> the encoder is right: swap the leads of motors {here} and {there}
FAIL? motor: several | {shown}
    more encoders than {here}'s move, or not the same ones each way
    -> are wheels coupled, or leads of two motors or encoders crossed?
FAIL? motor: one way | {figure}
    motor {here} shows movement one way only
    -> look at the direction output of {here}'s driver, and at A and B of its encoder
FAIL? motor: size | {figure}
    encoder {here} is more than {tolerance:.0%} off the {speed:g} rad/s it was told: every distance
    would be off as much
    -> counts per turn and gear ratio in the firmware; does it control the speed at all?

PASS trailing comma: sent | sent, as configured
PASS trailing comma: not sent | not needed
SKIPPED trailing comma: dead
    nothing was seen of motor d either way: it cannot be told
FAIL? trailing comma: refused | {figure}
    it answers lines {form} a comma at their end only
    -> write mcu.trailing_comma = {comma}; the check goes on with it
FAIL trailing comma: disobeyed | {figure}
    {last} obeys only lines {form} a comma at their end
    -> write mcu.trailing_comma = {comma}; the check goes on with it
FAIL trailing comma: latched | {figure}
    {last} still turns after zeros: the firmware takes a value only when a comma follows it, so
    without the last one this wheel keeps its old speed
    -> write mcu.trailing_comma = {comma}; the check goes on with it

SKIPPED wheel map: not seen
    not seen by a person: which wheel each motor turns, and which way, is as configured
PASS wheel map: right | {map}
FAIL wheel map: other | {map}
    not as configured: {wheels}
    -> write the [mcu.wheels] lines below
FAIL wheel map: twice
    two motors turn the {wheel} wheel by what was seen
    -> mend the motors above, and check again

SKIPPED encoder counts: none
    the firmware sends no counts
SKIPPED encoder counts: damaged
    {share:.1%} of the lines are lost: what the rest says of the counts is no measure
SKIPPED encoder counts: not turned
    too little was turned to measure them
FAIL encoder counts: backward | {measured:.0f} per turn
    counts run against the speeds, or stand: the pose would run backward
    -> the firmware must count up when a motor turns in its p direction
FAIL encoder counts: misnamed | {measured:.0f}
    it names {named} per turn, but by its speeds there are {measured:.0f}
    -> the firmware's counts per turn or speeds
WARN encoder counts: many | {counts} per turn
    more than the {most} the host takes: count fewer edges
PASS encoder counts: right | {counts} per turn
    {how}
FAIL encoder counts: wrong | {counts}, not {configured}
    {how}: every distance would be off by {off:.1%}
    -> write mcu.encoder_counts = {counts}

SKIPPED watchdog: untested
    no motor was seen to turn as told, so none can show it
FAIL? watchdog: weak
    motors {letters} turned one by one, but not together: does the supply give in?
    -> measure the supply under load
FAIL watchdog: none | none within {seconds:.1f} s
    the motors run on when the host falls silent: a pulled cable or a hung computer leaves the
    robot driving
    -> the firmware must stop the motors 300 ms after the last valid line
FAIL? watchdog: late | {figure}
    the robot drives on for {seconds:.1f} s after a pulled cable: at 1 m/s as many metres
    -> set the firmware's watchdog to 300 ms
WARN? watchdog: early | {figure}
    so short that a host that is late once stops the robot
    -> set the firmware's watchdog to 300 ms
WARN? watchdog: unclear | {figure}
    it stops the motors, but whether within 500 ms cannot be told this coarsely
    -> look it up in the firmware: 300 ms is right
FAIL? watchdog: fed | {figure}, but fed by broken lines
    it stops the motors when the line is silent, but not when it brings only lines that are none: a
    robot on a half-broken cable drives on
    -> only a whole valid line may feed the firmware's watchdog
PASS? watchdog: right | {figure}
    contract 300 ms

SKIPPED damaged lines: untested
    no motor was seen to turn as told, so none can show it
PASS? damaged lines: right | {lines} lines, none moved
WARN damaged lines: lenient | {took} of {kinds} kinds moved
    motors turned on lines that are none: {which}
    -> the firmware should take a line whole or not at all
FAIL damaged lines: taken | {took} of {kinds} kinds moved
    motors turned on lines that are none: {which}; on a noisy cable that drives the robot
    -> the firmware must take a line whole or not at all; deploy/firmware does
FAIL wheels: not lifted
    not confirmed to be lifted
FAIL runaway: along | {letter}: told {told:.1f}, seen {seen:.1f} rad/s
    the encoder of {motor} says more than {most:g} rad/s
    -> counts per turn in the firmware too low, or its control loop unstable
FAIL runaway: against | {letter}: told {told:.1f}, seen {seen:.1f} rad/s
    the encoder of {motor} says more than {most:g} rad/s, against the command: the firmware's
    control loop drives it away
    -> swap this motor's two leads, or A and B of its encoder
FAIL stop: turns | turns {seconds:g} s after zeros
    {motors} turns on, by its encoder, whatever zeros are sent
    -> does a hand or a slope turn it? else cut the motors' power: firmware must stop at `p00.00`
FAIL restarts: seen | {times}
    the board started anew {told}
    -> a weak supply (brown-out when motors start, a USB hub): one for the board alone, thicker
    leads, one ground; a second program that opens the port (DTR resets many boards); else its own
    watchdog, or a crash of its firmware
FAIL restarts: supply | {times}
    its supply failed: the board started anew {told}
    -> a supply for the board alone, not from the motors' nor by a USB hub; thicker leads, one
    ground, a capacitor at the driver; a plug that is loose
FAIL restarts: motors | {times}
    the board started anew {told}: each time while motors turned, which a weak supply does
    -> a supply for the board alone, thicker leads, one ground, a capacitor at the driver; if that
    is sound, the firmware's own watchdog, or a crash
FAIL restarts: watchdog | {times}
    its own watchdog restarted it, so its firmware hung: the board started anew {told}
    -> where does the firmware wait: for room to print, for an encoder, in an interrupt? feed the
    watchdog in its main loop only; a supply that dips can hang it too
FAIL restarts: pin | {times}
    something pulled its reset pin: the board started anew {told}
    -> a second program that opens the port (DTR resets many boards): a serial monitor,
    ModemManager, another host; `fuser DEVICE` names it; else a long lead at the pin
FAIL restarts: silence | {times}
    the board started anew {told}: each time this host had sent nothing for {silent:.1f} s or more
    -> the firmware's watchdog restarts the whole board when no line comes: let it stop the motors
    and go on, and restart the board for a hang of its own only
FAIL restarts: gone | {times}
    the board started anew {told}, and did not answer again within {patience:g} s
    -> power it off and on; a bootloader that hangs after a reset by the watchdog? its supply?
FAIL? link: silent | silent for {seconds:.1f} s
    the microcontroller fell silent while {motors} was to turn
    -> does its supply dip when a motor starts, and it restarts? a loose cable?
WARN late: not judged | not judged
    this computer was late by up to {late:.0f} ms: not judged
    -> stop what else runs here (`top`) and check again, or let the check go first, by real-time
    rights: `chrt -f 10 acsard mcu check ...`
FAIL serial line: lost | lost
    {error}
    -> a loose plug? `dmesg | tail`
"""


class Unsure(Finding, frozen=True):
    """A finding that may be caused by the lateness of this computer, whatever the board does.

    `margin_s` is how far the measurement is beyond its bound. A smaller delay cannot have caused
    the finding.
    """

    margin_s: float = 0.0


class Outcome(Struct, frozen=True):
    """One outcome. `figure`, `text` and `mend` are templates for the measured values."""

    verdict: Verdict
    unsure: bool
    figure: str
    text: str
    mend: str


def _read(manual: str) -> dict[str, Outcome]:
    found = {}
    for entry in re.split(r"\n+(?! )", manual.strip()):
        head, *rest = entry.splitlines()
        verdict, _, head = head.partition(" ")
        outcome, _, figure = head.partition(" | ")
        text, _, mend = " ".join(line.strip() for line in rest).partition("-> ")
        parts = {"verdict": verdict.rstrip("?"), "unsure": verdict.endswith("?"), "figure": figure}
        found[outcome] = convert(parts | {"text": text.strip(), "mend": mend}, Outcome)
    return found


MANUAL = _read(OUTCOMES)


def find(outcome: str, keys: dict[str, object] | None = None, **seen: object) -> Finding:
    """Return the finding of this outcome with the measured values filled in.

    Args:
        outcome: a key of `MANUAL`; the part before the colon is the finding's name.
        keys: configuration values that the finding suggests.
        seen: the measured values. `name` replaces the name; `margin_s` is the margin of an
            `Unsure`.
    """
    entry = MANUAL[outcome]
    name = str(seen.get("name", outcome.partition(":")[0]))
    figure, text, mend = (s.format(**seen) for s in (entry.figure, entry.text, entry.mend))
    if not entry.unsure:
        return Finding(name, entry.verdict, figure, text, mend, keys or {})
    margin_s = float(str(seen.get("margin_s", 0.0)))
    return Unsure(name, entry.verdict, figure, text, mend, keys or {}, margin_s)


def plain(found: Finding) -> Finding:
    """Return the finding as it is reported, without its margin."""
    return Finding(*(getattr(found, name) for name in Finding.__struct_fields__))
