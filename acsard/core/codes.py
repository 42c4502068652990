"""The codes of reasons: one table `code -> (text, advice)`.

Programs read the code, and people the text. State, sources, events and latches carry a code. A text
or an advice is a format string, into which `reason` or `sentence` inserts the values. The advice,
behind `->`, says what the operator can do. To add a code, add its entry to the table and its name
to one of the types below.
"""

from __future__ import annotations

import re
from typing import Literal, get_args

from msgspec import Struct
from msgspec.structs import replace

# For which `core/motion/ages.py` refuses a command.
AgeCode = Literal[
    "no_echo", "other_run", "from_future", "too_old", "round_trip", "not_newer", "copied",
    "stalled", "unproven", "early", "stale", "set_back", "stamps", "too_many_clocks",
]  # fmt: skip

ObjectionCode = Literal["unknown_source", "not_finite", "too_many_senders"]

# Conditions that a command source waits for (`values.Wait`)
WaitCode = Literal[
    "nothing", "command", AgeCode, "neutral", "zeros", "higher", "equal", "senders",
]  # fmt: skip

# States of the link.
LinkCode = Literal[
    "port_closed", "port_trouble", "port_released", "port_blocked", "booting", "link_up",
    "link_silent", "host_late", "simulator_fault", "echo", "set_points", "no_checksum",
    "replies_damaged", "lines_too_rare", "reply_period", "received_nothing", "received_statuses",
    "received_text", "received_form", "received_letters", "received_cut", "received_foreign",
    "received_garbage", "received_few", "received_sparse", "received_brownout", "received_boot",
    "received_nmea",
]  # fmt: skip

# Why the pose may be far off although the link is up.
PoseCode = Literal[
    "counts_and_speeds_differ", "wheels_and_commands_differ", "encoder_counts_missing",
    "coarse_encoder", "gyro_disagrees", "not_calibrated",
]  # fmt: skip

# This computer or the built-in simulator is to blame.
HOST_CODES: tuple[LinkCode, ...] = ("host_late", "simulator_fault")

# Causes of a latched stop.
StopCode = Literal[
    "stopped", "stopped_by_others", "stopped_at_start", "emergency_stop", "emergency_stop_silent",
    "bumper", "bumpers_silent", "battery_empty",
]  # fmt: skip

# For which the guard replaces a line; each is a defect of acsard.
GuardCode = Literal[
    "guard_line_damaged", "guard_too_fast", "guard_no_link", "guard_no_checksum",
    "guard_no_command", "guard_too_long",
]  # fmt: skip

GUARD_CODES: tuple[GuardCode, ...] = get_args(GuardCode)

# Causes of a latched fault.
FaultCode = Literal[
    GuardCode, "driver_fault", "impossible_speeds", "wheel_reversed", "wheel_runaway",
    "wheel_too_fast", "wheels_swapped", "no_wheel_moves", "no_wheel_begins",
]  # fmt: skip

# Trouble of a wheel that does not stop the robot.
WheelCode = Literal["wheel_blocked", "wheel_slow", "wheel_fast"]

StateCode = Literal[
    StopCode, FaultCode, LinkCode, WaitCode, "switched_off", "other_version", "shutting_down",
    "emergency_stop_missing", "bumpers_missing", "commanded", "limits_zero", "no_command",
    "bumper_away", "bumper_blocks",
]  # fmt: skip

# Reasons for which a message of a client is refused.
RefusalCode = Literal[
    ObjectionCode, AgeCode, "malformed",
    "wrong_shape", "wrong_wheels", "unknown_encoding", "too_big", "not_a_put", "wildcard",
    "displaced", "other_certificate", "second_sender", "no_rate", "out_of_range", "no_attachment",
    "bad_attachment", "bad_echo", "unknown_format",
]  # fmt: skip

Code = Literal[StateCode, PoseCode, RefusalCode, WheelCode]

TABLE = """
commanded
    commanded by {source}
limits_zero
    commanded by {source}, but the robot cannot move: limits.linear_speed and limits.angular_speed
    are 0;
    -> set a higher limit
no_command
    waiting for a command: no source has sent a usable one within its timeout
    -> send commands, for example with `acsard drive`; if your program sends them, `acsard top`
    shows why they are refused
nothing
command
    a command
no_echo
    a command of {source} has no echo although its sender has echoed before;
    -> copy the newest message of the key beat into each command
other_run
    commands of {source} echo a beat of another run of the daemon;
    -> copy the newest message of the key beat into each command
from_future
    commands of {source} echo a beat that the daemon has not published yet;
    -> copy the message of the key beat unchanged
too_old
    a command of {source} came {note} s after the beat that it echoes, but at most {seconds:g} s
    count: the network delays it
round_trip
    the round trip to {source} takes {note} s, but its timeout allows at most {seconds:g} s;
    -> echo the newest beat, not an old one; if the network is as slow, raise the timeout of the
    source in commands.sources
not_newer
    a command of {source} is not newer than the last accepted one of its sender: the network
    repeated or swapped commands, or the sender's stamps or numbers do not rise
copied
    a command of {source} is refused, because two programs send with this sender id: their numbers
    fall and come back;
    -> give each program a sender id of its own, and choose it anew at each start
unproven
    {source} is new: the robot follows it when the delays of its commands have not fallen for
    {seconds:g} s; this is not an error
early
    commands of {source} arrive earlier than ever before, by their stamps: the robot follows it when
    this has lasted for {seconds:g} s
stale
    commands of {source} arrive more than {seconds:g} s later than its earliest ones, by their
    stamps: the network delays them;
    -> if this goes on, check the network
set_back
    commands of {source} arrive {seconds:g} s later than its earliest ones, by their stamps: its
    computer's clock was slewed or set back by as much, or they wait in a queue, and stamps do not
    show which;
    -> did the clock change (`chronyc tracking` or `timedatectl` there)? Then restart the sender or
    type `acsard call activate`. Otherwise look for the queue, or for another program on this key
    whose clock is ahead: without a `sender` they share one
stamps
    the stamps of {source} do not advance with time ({note});
    -> is use_sim_time on, or are the stamps copied from another message? Send the time of the
    command, or no stamp
too_many_clocks
    a new sender of {source} is refused, because the commands of {note} others came too late, which
    the daemon remembers for an hour;
    -> check their network, or type `acsard call activate`, which forgets them
stalled
    the daemon stalled: waiting for the next command of {source}
neutral
    send a zero first: {source} must send a zero{alone} before it can drive{lasts}{ros}
zeros
    {source} commands zero speed: it has sent only zeros for over 3 s{note}
higher
    {source} has priority:
    -> wait until it is silent
equal
    {source} has the same priority and came first:
    -> wait until it is silent
senders
    {others} of this source must wait until the sender that drives falls silent
bumper_away
    {bumpers}:
    -> the robot drives only straight {direction}, at most {speed:g} m/s
bumper_blocks
    {bumpers}:
    -> no straight motion leads away from the pressed bumpers, so the robot stands still until the
    bumpers are released

shutting_down
    the daemon is shutting down
switched_off
    switched off by {by}
    -> type `acsard call activate`
other_version
    {cause} ({named})
stopped
    stopped by {by}
    -> look at the robot, and type `acsard call clear`
stopped_by_others
    stopped by {by} and maybe by others, because more clients stopped the robot than it lists
    -> look at the robot, and type `acsard call clear`
stopped_at_start
    stopped when the daemon started, because {cause}
    -> look at the robot, and type `acsard call clear`
emergency_stop
    emergency stop pressed at the robot
    -> release it at the robot
emergency_stop_silent
    the board has not reported its emergency stop for {seconds:g} s, so it counts as pressed
    -> check the board and its cable
emergency_stop_missing
    safety.estop = "required", but the microcontroller has not reported an emergency-stop input:
    -> does its firmware send status lines with `estop=`?
bumper
    {bumpers}
    -> release it at the robot
bumpers_silent
    the board has not reported its bumpers for {seconds:g} s, so they count as pressed
    -> check the board and its cable
bumpers_missing
    safety.bumpers has {places}, but the microcontroller has not reported {bumpers}:
    -> does its firmware send status lines with `bumpers={dots}`?
battery_empty
    battery below {threshold}
    -> charge the battery to {charged}

driver_fault
    the board reports a fault of a motor driver
    -> repair the driver, or switch the robot off and on
impossible_speeds
    the board reports impossible speeds ({cause})
wheel_reversed
    {wheel} wheel does not obey its command: it turns the wrong way {figures}:
    -> check the leads of its motor, the wires A and B of its encoder (an encoder with one channel
    has no direction), and the wheel's sign in mcu.wheels
wheel_runaway
    {wheel} wheel does not obey its command: it rolls on, or too far {figures}:
    -> check the motor driver, the encoder, and whether the firmware keeps the last speed of a wheel
    that stops
wheel_too_fast
    {wheel} wheel turns faster than the limiter allows {figures}:
    -> check the speed controller of the board
wheels_swapped
    {wheels} wheels do not obey their commands: each turns as the other one is commanded {figures}:
    -> check whether their motors or encoders are swapped, or reversed
no_wheel_moves
    all wheels turned, and for {seconds:g} s none has shown any motion {figures}:
    -> is the robot blocked, have the encoders or the motors lost their supply, or does the board
    report no speeds any more?
no_wheel_begins
    no wheel has begun to move for {seconds:.1f} s {figures}:
    -> is the robot blocked, have the motors or the encoders no supply, or is the speed too small
    for the motors?
wheel_blocked
    {wheel} wheel is blocked, or has no power:
    -> check cable, motor and encoder, and for the last motor of a line also the setting
    mcu.trailing_comma
wheel_slow
    {wheel} wheel reaches {share} of its expected speed:
    -> check the load, the battery, limits.wheel_speed and feedback.response_time
wheel_fast
    {wheel} wheel reaches {share} of its expected speed:
    -> check the speed controller of the board and feedback.response_time
guard_line_damaged
    the daemon's guard replaced a line for the board with zeros: the line is not complete, or does
    not have the speed of each wheel
guard_too_fast
    the daemon's guard replaced a line for the board with zeros: the line moves a wheel faster than
    limits.wheel_speed
guard_no_link
    the daemon's guard replaced a line for the board with zeros: the line moves a wheel while the
    serial link is not up
guard_no_checksum
    the daemon's guard replaced a line for the board with zeros: the line moves a wheel without the
    checksum that mcu.link_check requires
guard_no_command
    the daemon's guard replaced a line for the board with zeros: the line speeds up a wheel although
    no command is fresh, or although the mode is not driving
guard_too_long
    the daemon's guard replaced a line for the board with zeros: the line still moves a wheel
    although the longest ramp to zero has ended

port_closed
    the serial port is closed
port_trouble
    {trouble}
port_released
    the serial port is released to another program:
    -> type `acsard call activate` to open it again (before it `acsard call clear`, if the robot is
    stopped or in fault)
booting
    the port is open; waiting for the microcontroller's first good lines
link_up
    the link to the microcontroller is up
link_silent
    the microcontroller has fallen silent
host_late
    this computer did not run the daemon for {seconds:.2f} s, so the daemon received {received}:
    -> the Linux command `top` shows which other program uses the processor; acsard has priority if
    it runs as the systemd service
simulator_fault
    the built-in simulator is silent because of a fault in sim.faults, or because the daemon, which
    runs the simulator, is late:
    -> the Linux command `top` shows which other program uses the processor; acsard has priority if
    it runs as the systemd service
port_blocked
    the serial port sends nothing, because its driver accepts no bytes:
    -> unplug the adapter and plug it in again
echo
    the daemon's own lines come back: TX and RX are connected to each other, or a terminal or the
    RS-485 adapter echoes;
    -> remove the cause, then unplug the board and plug it in again
set_points
    the board reports the commanded speeds instead of the measured ones, so nothing would show a
    wheel that does not turn;
    -> let the firmware report the speeds of the encoders, or write feedback.encoders = false if the
    robot has none; then start the daemon again
no_checksum
    the microcontroller answers without a checksum, but mcu.link_check = "on" lets the robot drive
    only with one:
    -> flash the C firmware of deploy/firmware (for four motors), or write mcu.link_check = "off"
replies_damaged
    the microcontroller's replies arrive damaged:
    -> check cable and ground
lines_too_rare
    the microcontroller sends a line only every {interval} s, and no value of mcu.reply_period
    allows that;
    -> firmware that reports by its own clock must send a line at least every {longest:g} s
reply_period
    the microcontroller's lines come {interval} s apart;
    -> if it reports by its own clock, set mcu.reply_period = {interval}
received_nothing
    no link to the microcontroller: {received};
    -> does the board have power, is mcu.port its port, is mcu.baud_rate right, does mcu.wheels name
    its motors, are TX and RX swapped, does another program read the port
    (`acsard doctor`){firmware}? `acsard mcu check` finds out more
received_statuses
    no link to the microcontroller: {received};
    -> is TX of this computer connected to RX of the board? `acsard mcu check` finds out more
received_text
    no link to the microcontroller: {received};
    -> is mcu.port the port of the board (`acsard ports`)? Then its firmware prints other text:
    remove its Serial.print or debug output, and let it send replies such as
    `ap00.00,bp00.00,cp00.00,dp00.00`, with the letters of mcu.wheels
received_form
    no link to the microcontroller: {received};
    -> the lines are whole, but in another form: the firmware must send
    `ap00.00,bp00.00,cp00.00,dp00.00` with the letters of mcu.wheels, p or n as the sign, and two
    digits, a point and two digits in each figure, without spaces
received_letters
    no link to the microcontroller: {received};
    -> the lines are whole, but do not name each motor of mcu.wheels once: {wheels}; `acsard mcu
    check` then finds out which motor turns which wheel
received_cut
    no link to the microcontroller: {received};
    -> does the board cut its lines short, or omit the line ends? `acsard mcu check` finds out more
received_foreign
    no link to the microcontroller: {received};
    -> is there noise on the cable, or does another program send on the cable too? `acsard mcu
    check` finds out more
received_garbage
    no link to the microcontroller: {received};
    -> is mcu.baud_rate the baud rate of the board, and mcu.port its port (`acsard ports`)? `acsard
    mcu check` finds out more
received_brownout
    the microcontroller starts again and again, because its supply voltage is too low: {received};
    -> give the board a supply of its own or a thicker cable: starting motors pull down the voltage
received_boot
    the microcontroller starts again and again: {received};
    -> does its supply break down when motors start, or does an error in its firmware restart it?
received_nmea
    no link to the microcontroller: {received}; this is what a GPS receiver sends;
    -> write the port of the board into mcu.port: `acsard ports` lists all
received_few
    no link to the microcontroller: {received};
    -> check the cable, the ground and the baud rate; `acsard mcu check` finds out more
received_sparse
    no link to the microcontroller: {received};
    -> if the board reports by its own clock, set mcu.reply_period to the seconds between its lines;
    `acsard mcu check` finds out more

counts_and_speeds_differ
    the board's counts and its speeds contradict each other, so mcu.encoder_counts is wrong, or the
    firmware computes wrong speeds; the pose uses the counts, and its uncertainty the difference:
    -> write the counts per turn of a wheel that `acsard mcu check` shows; if they are right,
    correct the speeds in the firmware
wheels_and_commands_differ
    the wheels report another motion than was commanded, so the motors are blocked, too weak or too
    strong, or the board reports wrong speeds; the pose follows the wheels:
    -> repair the wheel that a fault has named. Else measure a straight drive with a tape: if the
    pose is wrong, correct the encoders or the speeds in the firmware, else the speed control of
    the motors. Then type `acsard call set_pose`, which ends this warning
encoder_counts_missing
    the speeds jump as those of coarse encoders do, and mcu.encoder_counts is not set, so the
    heading drifts, and damaged lines are not noticed:
    -> write the counts per turn of a wheel; `acsard mcu check` shows about how many they are
gyro_disagrees
    gyro and wheels measure different turns, so the heading is far less certain:
    -> does the gyro's z axis point up, does it send rad/s, do the wheels slip? If the robot is not
    calibrated, type `acsard calibrate`
not_calibrated
    the robot is not calibrated, so the heading by its wheels is uncertain:
    -> type `acsard calibrate`
coarse_encoder
    the encoders are coarse, and lines get lost or come after varying delays, so the pose may be far
    off:
    -> flash the C firmware of deploy/firmware, and write mcu.link_check = "on" and
    mcu.encoder_counts: its lines have counts, which no lost or late line can falsify

unknown_source
    this source is not in commands.sources
not_finite
    the command contains NaN or infinity
too_many_senders
    {seconds:g} other senders of this source are active;
    -> end one first
malformed
    the payload is not valid JSON, msgpack or CDR
wrong_shape
    the payload is not a message of the type of its key
wrong_wheels
    the message does not have one velocity for each wheel
unknown_encoding
    the payload is not a JSON object, a msgpack map or CDR
unknown_format
    the message has no form in the requested format
too_big
    the payload is too long
not_a_put
    the message is a DELETE
    -> send a PUT
wildcard
    a command came on a key with a wildcard
displaced
    messages came too fast, so older ones were dropped
other_certificate
    another certificate already uses this sender id
second_sender
    the daemon already uses the gyro of another sender
no_rate
    the IMU does not measure the angular velocity
out_of_range
    the turn rate or its variance is out of range
no_attachment
    a ROS message has no attachment
bad_attachment
    a ROS message has a damaged attachment
bad_echo
    the echo in the attachment is not a beat, or there is no sequence beside it
    -> copy the newest message of the key beat into the field `echo`, and number the commands in
    `sequence`
"""


class Entry(Struct, frozen=True):
    """The text of a code, and the advice to the operator; "" if there is none."""

    text: str
    advice: str


class Reason(Struct, frozen=True, gc=False):
    """A code with its text for people."""

    code: Code
    text: str
    advice: str = ""
    part: str = ""  # such as a wheel; it distinguishes reasons of the same code


def _parse(table: str) -> dict[str, Entry]:
    entries = {}
    for entry in re.split(r"\n+(?! )", table.strip()):
        code, *lines = entry.splitlines()
        text, _, advice = " ".join(line.strip() for line in lines).partition("-> ")
        entries[code] = Entry(text.strip(), advice)
    return entries


CODES: dict[str, Entry] = _parse(TABLE)


def reason(code: Code, part: str = "", **values: object) -> Reason:
    """Return the reason of a code, with the values in its text and its advice."""
    entry = CODES[code]
    return Reason(code, entry.text.format(**values), entry.advice.format(**values), part)


def sentence(code: Code, **values: object) -> Reason:
    """Return the reason of a code, with its advice at the end of its text."""
    entry = CODES[code]
    text = f"{entry.text} {entry.advice}" if entry.advice else entry.text
    return Reason(code, text.format(**values))


def received_text(code: str, text: str) -> str:
    """Return the text of a received reason, with its code if only a later version knows it."""
    return f"{text} ({code})" if code and code not in CODES else text


def joined(why: Reason) -> Reason:
    """Return a reason with its advice at the end of its text."""
    return replace(why, text=f"{why.text} {why.advice}", advice="") if why.advice else why
