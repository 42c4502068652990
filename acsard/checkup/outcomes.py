"""Contains the texts of all findings of the check. `find` inserts the measured values into them."""

from __future__ import annotations

from typing import Literal

from msgspec import convert

from acsard.checkup.findings import Finding, Verdict
from acsard.core.tables.finding_table import code_of, table

Outcome = Literal[
    "baud rate: right", "baud rate: other", "baud rate: other motors", "identification: named",
    "identification: none", "identification: echo", "reply form: right", "reply form: other",
    "reply form: text", "reply form: only text between", "replies: echo", "replies: set points",
    "reply rate: right", "reply rate: lossy", "reply rate: slow", "reply rate: rare",
    "reply rate: none", "reply times: even", "reply times: bunched", "round trip: right",
    "round trip: slow", "round trip: own clock", "round trip: none", "checked link: in use",
    "checked link: off", "checked link: plain", "checked link: missing", "lost lines: none",
    "lost lines: few", "lost lines: late", "lost lines: back", "lost lines: both",
    "lost lines: either", "lost lines: silent", "motor: right", "motor: off", "motor: loose",
    "motor: dead, not seen", "motor: dead, still", "motors: still", "motor: dead, turns",
    "motor: reversed, not seen", "motor: reversed, encoder", "motor: reversed, motor",
    "motor: other, not seen", "motor: other, encoder", "motor: other, motor", "motor: several",
    "motor: one way", "motor: last edge", "motor: no sign", "motor: size", "trailing comma: sent",
    "trailing comma: not sent", "trailing comma: dead", "trailing comma: refused",
    "trailing comma: disobeyed", "trailing comma: latched", "measured speeds: set points",
    "wheel map: not seen", "wheel map: partly", "wheel map: faulty", "wheel map: right",
    "wheel map: other", "wheel map: twice", "least speed: small", "least speed: large",
    "least speed: untested", "top speed: reached", "top speed: short", "top speed: overflow",
    "top speed: backward", "top speed: no watchdog", "top speed: damaged lines",
    "top speed: not chosen", "top speed: untested", "encoder counts: none",
    "encoder counts: coarse", "encoder counts: damaged", "encoder counts: not turned",
    "encoder counts: unequal", "encoder counts: backward", "encoder counts: misnamed",
    "encoder counts: many", "encoder counts: right", "encoder counts: wrong", "watchdog: untested",
    "watchdog: weak", "watchdog: none", "watchdog: late", "watchdog: early", "watchdog: unclear",
    "watchdog: fed", "watchdog: right", "damaged lines: untested", "damaged lines: right",
    "damaged lines: lenient", "damaged lines: inverted", "damaged lines: taken", "inputs: none",
    "inputs: not pressed", "inputs: right", "inputs: missing", "inputs: wrong",
    "wheels: not lifted", "stall: seen", "runaway: along", "runaway: against", "stop: turns",
    "restarts: seen", "restarts: supply", "restarts: motors", "restarts: watchdog",
    "restarts: pin", "restarts: silence", "restarts: gone", "link: stops", "link: stops at zeros",
    "late: not judged", "serial line: lost",
]  # fmt: skip

# A "?" after the verdict marks an outcome that this computer can cause by running the check too
# late, even if the board works correctly.
OUTCOMES = """
PASS baud rate: right | {rate} baud
FAIL baud rate: other | {rate}, not {configured} baud
    {heard} at the configured {configured} baud; good lines at {rate}
    -> write mcu.baud_rate = {rate}; the check goes on with it
FAIL baud rate: other motors | {rate} baud, but {motors} motors
    the board answers lines of {motors} values such as `{line}`, and none of {configured}
    -> write {entries} into [mcu.wheels]; the check goes on with it, and finds out which motor turns
    which wheel

PASS identification: named | {short}
    {text}
PASS identification: none | none
    the board does not name itself, which is optional
FAIL identification: echo | an echo
    the sent lines come back: no microcontroller answers here
    -> are TX and RX connected to each other? does the firmware echo its input?

PASS reply form: right | as documented
WARN reply form: other | {forms}
    replies look like {line!r}; the daemon reads them
    -> nothing to do; `{example}` is shorter on the wire, and unambiguous
WARN reply form: text | also text
    the firmware also prints text, such as `{text}`: {texts} of {lines} lines
    -> remove its Serial.print, because such lines delay the replies
FAIL reply form: only text between | also text
    the firmware prints text between its replies, such as `{text}`: {texts} of {lines} lines. The
    daemon drives only after {least} replies in a row
    -> remove its Serial.print
FAIL replies: echo | each command comes back
    the board sends each command back, then its reply follows: the daemon takes the command for the
    measured speeds, and does not drive
    -> remove the echo from the firmware
FAIL replies: set points | no measured speeds
    the board reports exactly the commanded speeds from the first line on, so these are not
    measurements: nothing would show a motor that does not turn, and the daemon does not drive
    -> let the firmware report the speeds of the encoders, or write feedback.encoders = false if the
    robot has none

PASS? reply rate: right | {rate:.0f} Hz, {way}
    longest gap {longest:.0f} ms
WARN? reply rate: lossy | {rate:.0f} Hz, {way}
    only {answered:.0%} of the lines were answered
    -> mend what the row `lost lines` of this check names: odometry has only the lines that arrive
FAIL? reply rate: slow | {rate:.0f} Hz, {way}
    one reply every {gap:.0f} ms, but the daemon takes {quiet:.0f} ms of silence for a lost link
    -> write mcu.reply_period = {period:g}, or let the firmware answer every line
FAIL? reply rate: rare | {rate:.1f} Hz, {way}
    one reply every {gap:.0f} ms, which is too seldom for any setting
    -> let the firmware answer every line, or report by its own clock at least every {most:g} s
FAIL? reply rate: none | too few replies
    the board leaves lines unanswered
    -> the firmware must answer every line, or report by its own clock

PASS reply times: even | p50 {middle:.0f} ms, p99 {high:.0f} ms, max {longest:.0f} ms apart
WARN? reply times: bunched | p50 {middle:.0f} ms, p99 {high:.0f} ms, max {longest:.0f} ms apart
    {share:.0%} of the replies come in bunches behind silences of up to {longest:.0f} ms, so the
    pose is less certain, and commands may wait as long: either the firmware's loop waits, or a USB
    adapter, a hub or their driver holds the bytes back
    -> try another USB port without a hub; for a slow FTDI adapter `acsard doctor` prints the
    command. If the bunches stay: which library, delay() or print in the loop takes so long? Let the
    loop never wait

PASS round trip: right | p50 {middle:.1f} ms, max {longest:.1f} ms
WARN? round trip: slow | p50 {middle:.1f} ms, max {longest:.1f} ms
    the wheel speeds arrive late
    -> does the firmware wait? an FTDI chip waits for 16 ms unless its latency_timer is 1: if it is
    not, `acsard doctor` prints the command
SKIPPED round trip: own clock
    the board reports by its own clock, so its replies do not answer single lines
SKIPPED? round trip: none
    no single line was answered

PASS checked link: in use | {figure}
PASS checked link: off | {figure}
    the firmware supports the checked link, but mcu.link_check is off: the lines below switch it on
SKIPPED? checked link: plain | plain
    the firmware answers without a check, so a damaged line can carry a wrong speed
FAIL? checked link: missing | none
    the firmware answers without a check, but mcu.link_check is on: the robot will not drive
    -> flash the C firmware of deploy/firmware (for four motors), or write mcu.link_check = "off"

PASS lost lines: none | none of {lines}
PASS lost lines: few | {lost} of {lines}
WARN? lost lines: late | {lost} of {lines} lost, but nothing arrived for {silent:.0f} ms
    afterward all lines arrived together: the daemon takes such a silence for a lost link, and the
    robot stops
    -> use another USB port without a hub, and no USB power saving; does the firmware wait
    somewhere?
FAIL? lost lines: back | {share:.0%} of {lines}
    {damaged} arrived damaged from the board, the last one is `{last}`
    -> check the lead from the board's TX to the computer's RX; use a short cable away from the
    motors' leads, a common ground, or a lower baud rate at both ends
FAIL? lost lines: both | {share:.0%} of {lines}
    {damaged} arrived damaged from the board, the last one is `{last}`; other lines or their replies
    were lost
    -> use a short cable away from the motors' leads, a common ground, or a lower baud rate at both
    ends
FAIL? lost lines: either | {share:.0%} of {lines}
    these lines had no answer: either the line or its answer was lost
    -> use a short cable away from the motors' leads, a common ground, or a lower baud rate at both
    ends
FAIL? lost lines: silent | {share:.0%} of {lines}
    this share of the board's own reports did not arrive
    -> check the lead from the board's TX to the computer's RX; use a short cable away from the
    motors' leads, a common ground, or a lower baud rate at both ends

PASS motor: right | {figure}
WARN? motor: off | {figure}
    {error:.0%} {which} than the commanded {speed:g} rad/s: the robot will not drive straight
    -> if slower: does the wheel turn freely, are supply and driver strong enough, is the motor
    worn? Otherwise check counts per turn and gear ratio in the firmware
FAIL motor: loose | {figure}
    encoder {here} follows motor {here}, but you saw no wheel turn: the robot would count a distance
    that it does not drive
    -> is the wheel loose on its shaft, or a gear, coupling or belt of motor {here} broken? If a
    wheel did turn, check again and name it
FAIL? motor: dead, not seen | {figure}
    encoder {here} shows nothing: the encoder is dead, or the motor does not turn
    -> watch the wheel: if it turns, check the encoder's supply and leads; if not, check the
    driver, fuse and leads of motor {here}
FAIL? motor: dead, still | {figure}
    motor {here} does not turn
    -> check the driver with its enable input, the fuse and the leads of motor {here}
FAIL motors: still | no wheel turns
    the board answers, but no encoder shows that a motor turns
    -> is the motors' supply on, the emergency stop released, the drivers' enable input connected?
    If the wheels do turn, check the supply and the ground of the encoders
FAIL? motor: dead, turns | {figure}
    the wheel turns, but encoder {here} shows nothing: the encoder is dead
    -> check the supply, the plug and the A and B leads of encoder {here}
FAIL motor: reversed, not seen | {figure}
    encoder {here} counts backward when motor {here} is commanded to turn forward; no configuration
    can fix that
    -> swap the two leads of motor {here} if the wheel turns the wrong way, otherwise A and B of
    encoder {here}
FAIL motor: reversed, encoder | {figure}
    encoder {here} counts backward when motor {here} is commanded to turn forward; no configuration
    can fix that
    -> the motor is right: swap A and B of encoder {here}
FAIL motor: reversed, motor | {figure}
    encoder {here} counts backward when motor {here} is commanded to turn forward; no configuration
    can fix that
    -> the motor is reversed: swap the two leads of motor {here}
FAIL motor: other, not seen | {shown}
    motor {here} moves encoder {there}: two motors or two encoders are swapped{reversed}
    -> watch which wheel turns: if it is the {wheel} wheel, swap encoders {here} and {there},
    otherwise motors {here} and {there}
FAIL motor: other, encoder | {shown}
    motor {here} moves encoder {there}: two motors or two encoders are swapped{reversed}
    -> the motor is right: swap the plugs of encoders {here} and {there}
FAIL motor: other, motor | {shown}
    motor {here} moves encoder {there}: two motors or two encoders are swapped{reversed}
    -> the encoder is right: swap the leads of motors {here} and {there}
FAIL? motor: several | {shown}
    other encoders than {here} move too, or different encoders move in the two directions
    -> are wheels coupled, or are leads of two motors or encoders swapped?
FAIL? motor: one way | {figure}
    motor {here} shows movement in one direction only
    -> check the direction output of {here}'s driver, and A and B of its encoder
WARN motor: last edge | {figure}
    at each of several reversals of motor {here}, the reported speed jumps over zero, although the
    reports show that the motor slows down: either the firmware gives all edges of a report the
    direction of the last edge, or it takes the direction from the command. Then each reversal makes
    the pose wrong
    -> count edges up and down by the direction of each edge, as the sketch of deploy/firmware does
FAIL? motor: no sign | {figure}
    encoder {here} reports the same direction when motor {here} turns forward and backward
    -> is one of the two channels A and B of encoder {here} missing, or does the firmware lose the
    sign?
FAIL? motor: size | {figure}
    encoder {here} is more than {tolerance:.0%} off the commanded {speed:g} rad/s: every distance
    would be wrong by as much
    -> check counts per turn and gear ratio in the firmware; does it control the speed at all?

PASS trailing comma: sent | sent, as configured
PASS trailing comma: not sent | not needed
SKIPPED trailing comma: dead
    motor {last} showed no movement with or without the comma, so the check cannot decide
    -> fix motor {last}, and check again
FAIL? trailing comma: refused | {figure}
    the board answers only lines {form} a comma at their end
    -> write mcu.trailing_comma = {comma}; the check goes on with it
FAIL trailing comma: disobeyed | {figure}
    {last} obeys only lines {form} a comma at their end
    -> write mcu.trailing_comma = {comma}; the check goes on with it
FAIL trailing comma: latched | {figure}
    {last} still turns after zeros: the firmware reads a value only if a comma follows it, so
    without the last comma this wheel keeps its old speed
    -> write mcu.trailing_comma = {comma}; the check goes on with it

WARN measured speeds: set points | none
    the board reports the commanded speeds, as feedback.encoders = false says: the rows above do not
    show whether the motors turn
    -> watch each wheel while its motor turns
SKIPPED wheel map: not seen
    no person watched: the check assumes the configured wheel and direction of each motor
WARN wheel map: partly
    nobody said which wheel these turn: {motors}; the others turn the configured wheels
    -> check again, and watch all wheels
WARN wheel map: faulty
    you saw {answers}, which differs from the configuration, but these motors have faults (see
    above)
    -> fix the motors above, and check again
PASS wheel map: right | {map}
FAIL wheel map: other | {map}
    this differs from the configuration: {wheels}
    -> write the [mcu.wheels] lines below
FAIL wheel map: twice
    according to your answers, two motors turn the {wheel} wheel
    -> fix the motors above, and check again

PASS least speed: small | {least:g} rad/s
WARN? least speed: large | {least:g} rad/s
    at {ignored:g} rad/s, which is {linear:.2f} m/s, this motor or these do not turn: {motors}. A
    planner's small speeds have no effect then, and its goals are reached late or never
    -> let the firmware control the speed of the motors (the sketch does), or raise the least speed
    of the planner above this
SKIPPED least speed: untested
    no motor turned forward as commanded
    -> fix the motors above, and check again
PASS top speed: reached | {top:.1f} rad/s
WARN? top speed: short | {most:.1f} of {speed:.1f} rad/s
    the limits allow {top:.1f} rad/s, which is {linear:.2f} m/s at the wheel, but this motor or
    these stay behind, with the wheels in the air: {motors}. The daemon then says that the wheel is
    slow
    -> write a lower limits.linear_speed or limits.angular_speed, or check the supply of the motors
FAIL top speed: overflow | {most:.1f} at {speed:.1f} rad/s
    up to {below:.1f} rad/s the board reports the right direction; on the way to {speed:.1f} rad/s
    this motor or these are reported backward: {motors}. The daemon would take that for a wheel
    that turns the wrong way. Either a number in the firmware overflows, or its interrupts miss
    edges of the encoders at this speed, or the motor does turn backward
    -> watch the wheel. If it turns forward, compute and send speeds in a wider type (float, or 32
    bits), and count the edges in hardware, or fewer per turn; if not, check the driver and its
    supply. Until then lower the limits, so that no wheel turns faster than {below:.1f} rad/s, which
    is {below_linear:.2f} m/s at the wheel
FAIL top speed: backward | {most:.1f} at {speed:.1f} rad/s
    alone this motor or these turned forward as commanded, but together they are reported backward:
    {motors}. Either lines or a driver reversed them meanwhile, or their encoders disturb each other
    -> watch the wheels. If one turns backward, check the driver and its direction input, and let
    the firmware set the direction from the sign of each whole line; if none does, check the leads
    of the encoders
SKIPPED top speed: no watchdog
    the row of the watchdog does not show that it stops the motors in time and in every case, so the
    check does not turn them fast
    -> do what the row of the watchdog says, and check again
SKIPPED top speed: damaged lines
    the row of the damaged lines does not show that the motors are safe from them, so the check does
    not turn them fast
    -> do what the row of the damaged lines says, and check again
SKIPPED top speed: not chosen
    the configuration file does not set the highest speed of the motors, and no person confirmed
    it: with the defaults it would be {top:.1f} rad/s
    -> write limits.linear_speed and limits.angular_speed, or limits.wheel_speed, into the
    configuration file; or leave --yes out: then the check asks
SKIPPED top speed: untested
    no motor turned alone and at the commanded speed
    -> fix the motors above, and check again
SKIPPED encoder counts: none
    the firmware sends no counts
WARN? encoder counts: coarse | about {about:.0f} per turn
    the firmware sends no counts, and its speeds jump by one count of a coarse encoder from line to
    line: unless the daemon knows the counts, the heading is wrong by several degrees after the
    robot has driven one square
    -> write mcu.encoder_counts = the exact counts that the firmware makes per wheel turn: its
    COUNTS_PER_TURN, or the pulses times the gear ratio times the edges of a pulse that it counts
SKIPPED encoder counts: damaged
    {share:.1%} of the lines are lost, so the counts of the rest cannot be measured
    -> fix the lost lines above, and check again
SKIPPED encoder counts: not turned
    the wheels turned too little to measure the counts
FAIL encoder counts: unequal | {shown} per turn
    the counts of the motors do not agree, but the daemon uses the same counts per turn for all
    -> the firmware must compute counts and speeds of every motor with the same counts per turn
FAIL encoder counts: backward | {measured:.0f} per turn
    the counts of {names} run against the speeds, or do not change: the pose would be wrong
    -> the firmware must count up when a motor turns in its p direction
FAIL encoder counts: misnamed | {measured:.0f}
    the firmware states {named} counts per turn, but its speeds give {measured:.0f}
    -> correct the counts per turn or the speeds in the firmware
WARN encoder counts: many | {counts} per turn
    the daemon accepts at most {most}
    -> count fewer edges in the firmware
PASS encoder counts: right | {counts} per turn
    {how}
FAIL encoder counts: wrong | {counts}, not {configured}
    {how}. With the configured number, every distance would be wrong by {off:.1%}
    -> write mcu.encoder_counts = {counts}

SKIPPED watchdog: untested
    no encoder showed a motor that turns forward when commanded, so none can show whether the
    watchdog works
    -> fix the motors above, and check again
FAIL? watchdog: weak
    motors {letters} turned one by one, but not together: is the supply too weak?
    -> measure the supply under load
FAIL watchdog: none | none within {seconds:.1f} s
    the motors run on when the computer is silent: with a pulled cable or a hung computer the
    robot drives on
    -> do not put this robot on the floor: flash the sketch of deploy/firmware, or let your firmware
    stop the motors 300 ms after the last valid line
FAIL? watchdog: late | {figure}
    when the cable is pulled, the robot drives on for {seconds:.1f} s, which is {seconds:.1f} m at
    1 m/s
    -> set the firmware's watchdog to 300 ms
WARN? watchdog: early | {figure}
    this is so short that a single delay of the computer stops the robot
    -> set the firmware's watchdog to 300 ms
WARN? watchdog: unclear | {figure}
    the watchdog stops the motors, but the encoders are too coarse to show whether it does so
    within 500 ms
    -> look the time up in the firmware: 300 ms is right
FAIL? watchdog: fed | {figure}, but damaged lines keep it from acting
    the watchdog stops the motors when no lines arrive, but not when only broken lines arrive: a
    robot with a half-broken cable drives on
    -> only a whole valid line may feed the firmware's watchdog
PASS? watchdog: right | {figure}
    300 ms is right

SKIPPED damaged lines: untested
    no motor turned forward as commanded, so none can show whether the board obeys damaged lines
    -> fix the motors above, and check again
PASS? damaged lines: right | {lines} lines, no motor moved
WARN damaged lines: lenient | {took} of {kinds} kinds obeyed
    motors followed broken lines: {which}
    -> the firmware should accept a line whole or not at all
FAIL damaged lines: inverted | {names} no longer turned forward
    after damaged lines, the last one cut behind its sign, good lines turn this motor or these
    backward or not at all: {names}. Either the firmware keeps a part of a line, so that a single
    lost byte can do that while the robot drives, or a driver or its supply has cut out
    -> do not put this robot on the floor: flash the sketch of deploy/firmware, or let your firmware
    set the direction from the sign of each whole line, and never toggle it. If the motor stands,
    check its driver, fuse and supply, too
FAIL damaged lines: taken | {took} of {kinds} kinds obeyed
    motors followed broken lines: {which}; noise on a cable would drive the robot
    -> the firmware must accept a line whole or not at all, like deploy/firmware

SKIPPED inputs: none
    no emergency stop and no bumpers are reported or configured
SKIPPED inputs: not pressed | not checked
    nobody pressed the inputs of the board: {listed}
    -> check again at the robot, in a terminal and without --yes
PASS inputs: right | {listed}
    each press and each release was reported
FAIL inputs: missing | not reported
    the configuration has inputs that the board does not report: {listed}
    -> let the firmware send `!status {fields}` ten times a second, or correct [safety]
FAIL inputs: wrong | {figure}
    {wrong}
    -> check the leads of these inputs, their pins in the firmware, and the order in safety.bumpers

FAIL wheels: not lifted
    the operator did not confirm that the wheels are lifted
    -> lift the wheels, start the check again and confirm it
FAIL stall: seen | stood still for {seconds:.1f} s
    this program did not run for that time. The operator may have left the robot meanwhile, so the
    check does not turn a motor again
    -> was the computer suspended or overloaded, or did the terminal stall? Try again when the
    computer is idle, and stay at the robot
FAIL runaway: along | {letter}: commanded {told:.1f}, measured {seen:.1f} rad/s
    the encoder of {motor} reports more than {most:g} rad/s
    -> are the counts per turn in the firmware too low, or is its control loop unstable?
FAIL runaway: against | {letter}: commanded {told:.1f}, measured {seen:.1f} rad/s
    the encoder of {motor} reports more than {most:g} rad/s, against the command: the firmware's
    control loop makes the motor run away
    -> swap this motor's two leads, or A and B of its encoder
FAIL stop: turns | turns {seconds:g} s after zeros
    the encoders report that {motors} did not stop although this computer sends zeros
    -> does a hand or a slope turn it? If it turns by itself, cut the motors' power: the firmware
    must stop a motor at `p00.00`. If it stands, the firmware must report `p00.00`, not its last
    speed
FAIL restarts: seen | {times}
    the board restarted {events}
    -> is the supply weak (a USB hub, a battery that sags)? Use a separate supply for the
    board, thicker leads, a common ground. Does a second program open the port (DTR resets many
    boards)?
    Otherwise its own watchdog or a crash of its firmware restarts it
FAIL restarts: supply | {times}
    the supply of the board failed. The board restarted {events}
    -> use a separate supply for the board, not the motors' supply or a USB hub; use thicker leads,
    a common ground and a capacitor at the driver; is a plug loose?
FAIL restarts: motors | {times}
    the board restarted {events}. Motors turned at each restart, so the supply may be weak
    -> use a separate supply for the board, thicker leads, a common ground and a capacitor at the
    driver. If the supply is good, the firmware's own watchdog or a crash restarts the board
FAIL restarts: watchdog | {times}
    the board's own watchdog restarted it, so the firmware hung. The board restarted {events}
    -> where does the firmware wait: for room to print, for an encoder, in an interrupt? Feed the
    watchdog only in the main loop. A supply that dips can also hang the firmware
FAIL restarts: pin | {times}
    something pulled the board's reset pin. The board restarted {events}
    -> does a second program open the port (DTR resets many boards): a serial monitor,
    ModemManager, another computer? `fuser DEVICE` names it. Otherwise, is a long lead connected to
    the reset pin?
FAIL restarts: silence | {times}
    the board restarted {events}. Before each restart, this computer had sent nothing for
    {silent:.1f} s or more
    -> the firmware's watchdog restarts the whole board when no line comes: let that watchdog only
    stop the motors, and restart the board only when the firmware hangs
FAIL restarts: gone | {times}
    the board restarted {events}, and did not answer again within {patience:g} s
    -> switch it off and on; does its bootloader hang after a reset by the watchdog, or does its
    supply fail?
FAIL? link: stops | silent for {seconds:.1f} s
    the microcontroller stopped replying while it had to turn {motors}
    -> does its supply dip when a motor starts, so that it restarts? is a cable loose?
FAIL? link: stops at zeros | silent for {seconds:.1f} s
    the microcontroller stopped replying while this computer sent it only zeros
    -> is a cable or plug loose? did its supply fail, or does its firmware hang?
WARN late: not judged | not judged
    this computer ran the check up to {late:.0f} ms too late, so the check does not judge this step
    -> stop other programs here (`top`) and check again, or give the check real-time priority:
    `chrt -f 10 acsard mcu check ...`
FAIL serial line: lost | lost
    {error}
    -> is a plug loose? `dmesg | tail` shows the kernel's messages
"""


class TimingFinding(Finding, frozen=True):
    """A finding that may be wrong if this computer ran the check too late.

    A delay of less than half of `margin_s`, by which the measurement exceeds its limit, cannot have
    caused it.
    """

    margin_s: float = 0.0


OUTCOMES_BY_CODE = table(Outcome, OUTCOMES)


def find(outcome: Outcome, keys: dict[str, object] | None = None, **values: object) -> Finding:
    """Return the finding for an outcome such as "baud rate: right", with the values in its texts.

    The value `name` replaces the name of the finding, and `margin_s` is stored if the outcome is
    unsure.
    """
    code = code_of(outcome)
    entry = OUTCOMES_BY_CODE[code]
    name, verdict = str(values.get("name", entry.subject)), convert(entry.mark, Verdict)
    figure, text, mend = (s.format(**values) for s in (entry.figure, entry.text, entry.advice))
    if not entry.unsure:
        return Finding(name, verdict, figure, text, mend, keys or {}, code)
    margin_s = float(str(values.get("margin_s", 0.0)))
    return TimingFinding(name, verdict, figure, text, mend, keys or {}, code, margin_s)


def plain(finding: Finding) -> Finding:
    """Return the finding as a `Finding`, without the `margin_s` of a `TimingFinding`."""
    return Finding(*(getattr(finding, name) for name in Finding.__struct_fields__))
