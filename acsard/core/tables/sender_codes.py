"""The codes of command sources and their senders: why one drives, waits or is refused."""

from __future__ import annotations

from typing import Literal

from acsard.core.tables.finding_table import table

# For which `core/motion/ages.py` refuses a command.
AgeCode = Literal[
    "no_echo", "other_run", "from_future", "too_old", "round_trip", "not_newer", "copied",
    "stalled", "unproven", "early", "stale", "set_back", "stamps", "too_many_clocks",
]  # fmt: skip

# Conditions that a command source waits for (`values.Wait`)
WaitCode = Literal[
    "nothing", "command", AgeCode, "neutral", "zeros", "higher", "equal", "senders",
]  # fmt: skip

SenderCode = Literal[WaitCode, "commanded", "limits_zero", "no_command"]

# Of all sources together in `diagnostics`.
SourcesCode = Literal["refused", "shared_source", "command_gaps", "never_zero"]

SENDERS = table(
    Literal[SenderCode, SourcesCode],
    """
OK commanded
    commanded by {source}
WARN limits_zero
    commanded by {source}, but the robot cannot move: limits.linear_speed and limits.angular_speed
    are 0
    -> set a higher limit
OK no_command
    waiting for a command: no source has sent a usable one within its timeout
    -> send commands, for example with `acsard drive`; if your program sends them, `acsard top`
    shows why they are refused
OK nothing
OK command
    a command
WARN no_echo
    a command of {source} has no echo although its sender has echoed before
    -> copy the newest message of the key beat into each command
WARN other_run
    commands of {source} echo a beat of another run of the daemon
    -> copy the newest message of the key beat into each command
WARN from_future
    commands of {source} echo a beat that the daemon has not published yet
    -> copy the message of the key beat unchanged
WARN too_old
    a command of {source} came {note} s after the beat that it echoes, but at most {seconds:g} s
    count: the network delays it
    -> if this goes on, check the network between the program and the robot (`ping`), or raise the
    timeout of the source in commands.sources
WARN round_trip
    the round trip to {source} takes {note} s, but its timeout allows at most {seconds:g} s
    -> echo the newest beat, not an old one; if the network is as slow, raise the timeout of the
    source in commands.sources
WARN not_newer
    a command of {source} is not newer than the last accepted one of its sender: the network
    repeated or swapped commands, or the sender's stamps or numbers do not rise
    -> let only one program use a sender id, and let it number its commands upward
WARN copied
    a command of {source} is refused, because two programs send with this sender id: their numbers
    fall and come back
    -> give each program a sender id of its own, and choose it anew at each start
OK unproven
    {source} is new: the robot follows it when the delays of its commands have not fallen for
    {seconds:g} s; this is not an error
OK early
    commands of {source} arrive earlier than ever before, by their stamps: the robot follows it when
    this has lasted for {seconds:g} s
WARN stale
    commands of {source} arrive more than {seconds:g} s later than its earliest ones, by their
    stamps: the network delays them
    -> if this goes on, check the network
WARN set_back
    commands of {source} arrive {seconds:g} s later than its earliest ones, by their stamps: its
    computer's clock was slewed or set back by as much, or they wait in a queue, and stamps do not
    show which
    -> did the clock change (`chronyc tracking` or `timedatectl` there)? Then restart the sender or
    type `acsard call activate`. Otherwise look for the queue, or for another program on this key
    whose clock is ahead: without a `sender` they share one
WARN stamps
    the stamps of {source} do not advance with time ({note})
    -> is use_sim_time on, or are the stamps copied from another message? Send the time of the
    command, or no stamp
WARN too_many_clocks
    a new sender of {source} is refused, because the commands of {note} others came too late, which
    the daemon remembers for an hour
    -> check their network, or type `acsard call activate`, which forgets them
WARN stalled
    the daemon stalled: waiting for the next command of {source}
    -> if this goes on, `acsard doctor` looks for what keeps this computer busy
OK neutral
    send a zero first: {source} must send a zero{alone} before it can drive{lasts}{ros}
OK zeros
    {source} commands zero speed: it has sent only zeros for over 3 s{note}
OK higher
    {source} has priority:
    -> wait until it is silent
OK equal
    {source} has the same priority and came first:
    -> wait until it is silent
WARN senders
    {others} of this source must wait until the sender that drives falls silent
    -> end all but one of these programs, or give each its own source
WARN refused
    refused: {refused}
    -> correct the program that sends it: `acsard echo events` has each refusal with its reason and
    its sender
WARN command_gaps
    usable commands of {source} came up to {seconds:.1f} s apart, but count for {timeout:g} s: the
    robot braked in between
    -> look in `acsard top` whether commands were refused between them, and why. If the program
    pauses, let a timer of its own repeat the last command; if the network delays or loses commands,
    run the program on the robot; `acsard echo state` shows longest_gap of each source
WARN never_zero
    {source} sends {linear:.3f} m/s and {angular:.3f} rad/s, and no zero for over 3 s
    -> if nobody moves it, this is the offset of the stick: let its program send zeros below it (a
    dead zone)
WARN shared_source
    {senders} programs send as {source}, and the robot follows one of them
    -> end the other programs, or give each program its own source
""",
)
