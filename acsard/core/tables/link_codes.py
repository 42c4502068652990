"""The codes of the link: the serial port, the bytes received there, and the board behind it."""

from __future__ import annotations

from typing import Literal

from acsard.core.tables.finding_table import table

# Bytes without a link. identity: acsard's firmware has named itself, and sends no replies.
# statuses: only status lines. text, form: most bad lines are text, or replies in another form. cut:
# pieces of valid lines, or no line ends. foreign: valid lines within other bytes. garbage: nothing
# like a line. few: good lines, and bad ones. sparse: too few lines.
ReceivedCode = Literal[
    "received_nothing", "received_statuses", "received_text", "received_form", "received_letters",
    "received_cut", "received_foreign", "received_garbage", "received_few", "received_sparse",
    "received_brownout", "received_boot", "received_nmea", "received_identity",
]  # fmt: skip

# States of the link.
LinkCode = Literal[
    "port_closed", "port_trouble", "port_released", "port_blocked", "booting", "link_up",
    "link_silent", "host_late", "simulator_fault", "echo", "set_points", "no_checksum",
    "replies_damaged", "lines_too_rare", "reply_period", ReceivedCode,
]  # fmt: skip

# Of a link that may be up.
LineCode = Literal[
    "lines_unanswered", "lines_rejected", "link_lost", "link_lost_late", "periods_run",
    "periods_missed", "port_simulated", "port_missing", "port_not_serial", "port_orphan",
    "port_open", "port_denied", "port_held_by_simulator", "port_held_by_acsard", "port_held",
    "port_unknown_board", "port_slow",
]  # fmt: skip

# This computer or the built-in simulator is to blame.
HOST_CODES: tuple[LinkCode, ...] = ("host_late", "simulator_fault")

LINK = table(
    Literal[LinkCode, LineCode],
    """
FAIL port_closed
    the serial port is closed
FAIL port_trouble
    {trouble}
FAIL port_released
    the serial port is released to another program:
    -> type `acsard call activate` to open it again (before it `acsard call clear`, if the robot is
    stopped or in fault)
FAIL booting
    the port is open; waiting for the microcontroller's first good lines
OK link_up
    the link to the microcontroller is up
FAIL link_silent
    the microcontroller has fallen silent
FAIL host_late
    this computer did not run the daemon for {seconds:.2f} s, so the daemon received {received}:
    -> the Linux command `top` shows which other program uses the processor; acsard has priority if
    it runs as the systemd service
FAIL simulator_fault
    the built-in simulator is silent because of a fault in sim.faults, or because the daemon, which
    runs the simulator, is late:
    -> the Linux command `top` shows which other program uses the processor; acsard has priority if
    it runs as the systemd service
FAIL port_blocked
    the serial port sends nothing, because its driver accepts no bytes:
    -> unplug the adapter and plug it in again
FAIL echo
    the daemon's own lines come back: TX and RX are connected to each other, or a terminal or the
    RS-485 adapter echoes
    -> remove the cause, then unplug the board and plug it in again
FAIL set_points
    the board reports the commanded speeds instead of the measured ones, so nothing would show a
    wheel that does not turn
    -> let the firmware report the speeds of the encoders, or write feedback.encoders = false if the
    robot has none; then start the daemon again
FAIL no_checksum
    the microcontroller answers without a checksum, but mcu.link_check = "on" lets the robot drive
    only with one:
    -> flash the C firmware of deploy/firmware (for four motors), or write mcu.link_check = "off"
FAIL replies_damaged
    the microcontroller's replies arrive damaged:
    -> check cable and ground
FAIL lines_too_rare
    the microcontroller sends a line only every {interval} s, and no value of mcu.reply_period
    allows that
    -> firmware that reports by its own clock must send a line at least every {longest:g} s
FAIL reply_period
    the microcontroller's lines come {interval} s apart
    -> if it reports by its own clock, set mcu.reply_period = {interval}
FAIL received_nothing | nothing received
    no link to the microcontroller: {received}
    -> does the board have power, is mcu.port its port (`acsard ports`), is mcu.baud_rate right,
    does mcu.wheels name its motors, are TX and RX swapped, does another program read the port
    (`acsard doctor`){firmware}?
FAIL received_statuses | only status lines
    no link to the microcontroller: {received}
    -> the board hears nothing: connect TX of this computer to RX of the board
FAIL received_text | text instead of replies
    no link to the microcontroller: {received}
    -> is mcu.port the port of the board (`acsard ports`)? Then its firmware prints other text:
    remove its debug output, and let it answer each line with a reply such as
    `ap00.00,bp00.00,cp00.00,dp00.00`, with the letters of mcu.wheels
FAIL received_form | replies in another form
    no link to the microcontroller: {received}
    -> the lines are whole, but in another form: the firmware must send
    `ap00.00,bp00.00,cp00.00,dp00.00` with the letters of mcu.wheels, p or n as the sign, and two
    digits, a point and two digits in each figure, without spaces
FAIL received_letters | other motors
    no link to the microcontroller: {received}
    -> the lines are whole, but do not name each motor of mcu.wheels once: {wheels}; `acsard mcu
    check` then finds out which motor turns which wheel
FAIL received_cut | pieces of lines
    no link to the microcontroller: {received}
    -> the firmware must send all values and Serial.println() in one reply: does it cut its replies
    short or omit the line end, is its send buffer too small, does it restart while it writes?
FAIL received_foreign | other bytes in the lines
    no link to the microcontroller: {received}
    -> is it a debug print of the firmware, or does a second program write to this port? If it is
    neither, it is noise: use one ground for board and computer, and a short cable away from the
    motors' leads
FAIL received_garbage | only garbage
    no link to the microcontroller: {received}
    -> is mcu.baud_rate the baud rate of the board, and mcu.port its port (`acsard ports`)? Does it
    send at TTL level and not RS-232, and is its ground connected to the computer's?
FAIL received_brownout | the board starts again and again
    the microcontroller starts again and again, because its supply voltage is too low: {received}
    -> give the board a supply of its own or a thicker cable: starting motors pull down the voltage
FAIL received_boot | the board starts again and again
    the microcontroller starts again and again: {received}
    -> does its supply break down when motors start, or does an error in its firmware restart it?
FAIL received_nmea | another device
    no link to the microcontroller: {received}; this is what a GPS receiver sends
    -> write the port of the board into mcu.port: `acsard ports` lists all
FAIL received_identity | a name, but no replies
    no link to the microcontroller: {received}
    -> acsard's firmware is there, but answers no line. Does mcu.wheels name as many motors as it
    has (the sketch of a Nano, an Uno, an ESP32 or a Pico has two: right = "+a", left = "+b"), is TX
    of this computer connected to RX of the board{firmware}?
FAIL received_few | few good lines
    no link to the microcontroller: {received}
    -> use a short cable away from the motors' leads, a common ground, or a lower baud rate at both
    ends
FAIL received_sparse | good lines, but too seldom
    no link to the microcontroller: {received}
    -> the board must answer each line, or report by its own clock (then set mcu.reply_period to the
    seconds between its lines) at least every 0.25 s; does delay() or a slow print block its loop?
WARN lines_unanswered
    the board does not answer each line
    -> {check}
WARN lines_rejected
    lines of the board were rejected: {kinds}
    -> {check}
WARN link_lost
    lost {times} since the start
    -> {check}
WARN link_lost_late
    lost {times}, because this computer did not run the daemon
    -> {busy}
OK periods_run
    {missed} of {periods} periods missed in the last minute
WARN periods_missed
    {missed} of {periods} periods missed in the last minute
    -> {busy}

WARN port: simulated
    this is the simulator, no real wheel turns
    -> to drive a robot, set mcu.port to the board's serial port; `acsard ports` lists the ports
FAIL port: missing
    {path} does not exist; the ports are: {ports}
    -> plug the board in. The board's name in /dev/serial/by-id stays the same when you plug the
    board in again: it is the best value of mcu.port (`acsard ports` lists the names)
FAIL port: not serial
    {path} is not a serial device
    -> `acsard ports` lists the serial devices: write one of them as mcu.port
FAIL port: orphan
    {path} is there, but no device is behind it: was it plugged in again? A container keeps the file
    of the old one: pass /dev/serial/by-id into it, or restart it
    -> `acsard ports` lists the serial devices
OK port: open
    {path} is readable and writable
FAIL port: denied
    {why}
    -> {advice}
OK port: held by simulator
    {path} is in use by {holder}, which simulates the board
OK port: held by acsard
    {path} is in use by {holder}
FAIL port: held
    {path} is in use by {holder}
    -> {advice}
WARN port: unknown board
    the port's USB id {usb} is not that of a common board ({known})
    -> if this is your microcontroller, add its USB id to deploy/udev/70-acsar.rules, and copy that
    file to /etc/udev/rules.d
WARN port: slow
    the FTDI chip of the port delays bytes by {timer} ms
    -> until its plug or this computer restarts: `echo 1 | sudo tee {file}`; for good, install
    deploy/udev/70-acsar.rules
""",
)
