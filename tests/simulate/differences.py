"""The deliberate differences between two checkouts, which a paired run does not report.

A change that is meant to alter the daemon's behaviour is named here. Its entry goes when the older
checkout is compared no more. The present lists belong to the commit before the simulator; the
section on the simulator in `tests/README.md` says how to compare with it.

- `DIFFERENCES` rewrites both sides before they are compared. Each entry is a field of the step, a
  regular expression, its replacement, and the reason. Fields are `mode`, `reason`, `lines` and
  `odometry`; for the last two the whole text of the step's is taken.
- `CORRECTED` names the changes that `before_the_simulator.patch` brings to the older checkout.
- `LEFT_OUT` takes events out of the plans if no entry above is possible: a field of the event, its
  value and the reason.
"""

from __future__ import annotations

REWORDED: tuple[tuple[str, str], ...] = (
    (" is new here: ", " is new: "),
    (
        r"come too late, by more than ([\d.]+) s: the network holds them up",
        r"arrive more than \1 s too late: the network delays them",
    ),
    ("; if this goes on, check the network, then restart the sender", ""),
    (
        "it drives once its delays have been steady for",
        "the robot follows it when its commands have arrived with steady delays for",
    ),
    ("nothing but zeros", "only zeros"),
    ("which sends only zeros", "which has sent only zeros"),
    ("is kept waiting", "must wait"),
    (r", and no speed for ([\d.]+) s after it,", r", and then no speed for \1 s,"),
    (
        r"of a speed sends none: (.*) in (\S+) has tools that do",
        r"with a speed never sends a zero; the section \1 of \2 lists tools that send one",
    ),
    ("has the higher priority: until", "has priority: wait until"),
    (
        "of the same priority, came first: until",
        "has the same priority and came first: wait until",
    ),
    (", has the same priority", " has the same priority"),
    (
        "more of its senders: the first until it is",
        "more of this source's senders must wait until the first one is",
    ),
    (r"\(told (.*), saw ", r"(commanded \1, measured "),
    (
        "look at cable, motor and encoder; if it is motor d, at",
        "check cable, motor and encoder, and for motor d also the setting",
    ),
    (
        "look at the motor's leads, its encoder's A and B, and its",
        "check the leads of its motor, the wires A and B of its encoder, and the wheel's",
    ),
    (
        "the motor driver or its encoder is at fault",
        "check the motor driver and the encoder",
    ),
    ("reports one and the same speed", "reports a speed that never changes"),
    (
        "reported no emergency-stop input for 0.5 s, which counts",
        "has not reported its emergency stop for 0.5 s, so it counts",
    ),
    (
        "reported no bumpers for 0.5 s, which counts",
        "has not reported its bumpers for 0.5 s, so they count",
    ),
    (
        r"(\w+) from (\S+) to (\S+) rad/s is over",
        r"\1 jumps from \2 to \3 rad/s, which is over",
    ),
    ("impossible feedback: ", "the board reports impossible speeds: "),
    (r"impossible speeds: (\w+) (-?\d)", r"impossible speeds: \1 at \2"),
    ("release it there", "release it at the robot"),
    ("charge it to", "charge the battery to"),
    ("mend it, or switch", "repair the driver, or switch"),
    (
        "no motion leads away, so the robot stands until the release",
        "no straight motion leads away from the pressed bumpers, so the robot stands still until "
        "the bumpers are released",
    ),
    (": only straight", ": the robot drives only straight"),
    ("stopped at the start, because", "stopped when the daemon started, because"),
    ("a stop cannot be kept over a restart", "a stop would not survive a restart"),
    (
        "a stop would not survive a restart: (?!the latch file)(.+?): ",
        r"a stop would not survive a restart: the latch file (\1) cannot be written: ",
    ),
    ("it is of another version", "another version of acsard wrote the file"),
    (
        r"what else runs here\? \(`top`; as a service it goes first\)",
        "the Linux command `top` shows which other program uses the processor; acsard has priority "
        "if it runs as the systemd service",
    ),
    ("this computer did not run for", "this computer did not run the daemon for"),
    (
        "the built-in simulator, a part of this program, is late",
        "a fault in sim.faults silences the built-in simulator, or the simulator, which is a part "
        "of the daemon, is late",
    ),
    ("and this daemon reads", "but this daemon reads format"),
    ("and heard nothing of the", "so it received nothing from the"),
    ("heard nothing of the", "received nothing from the"),
    ("and heard too little for a link", "so it received too little for a link"),
    (
        "sends nothing: its driver accepts no bytes; replug the adapter",
        "sends nothing, because its driver accepts no bytes: "
        "unplug the adapter and plug it in again",
    ),
    (
        "come damaged; asking it for the check again",
        "arrive damaged, so the daemon asks it for the checksum again; check cable and ground",
    ),
    ("nothing at all heard", "nothing was received"),
    (
        "is it powered, is this its port and mcu.baud_rate its own, are TX and RX crossed",
        "does the board have power, is mcu.port its port, is mcu.baud_rate right, are TX and RX "
        "swapped",
    ),
    (
        r"does the line from this computer \(TX\) reach the board's RX",
        "is TX of this computer connected to RX of the board",
    ),
    ("^the microcontroller: ", "no link to the microcontroller: "),
    (
        "does it cut its lines short, or leave out their ends",
        "does the board cut its lines short, or omit the line ends",
    ),
    (
        "what disturbs the cable, or prints on it too",
        "is there noise on the cable, or does another program send on the cable too",
    ),
    ("is mcu.baud_rate the board's own", "is mcu.baud_rate the baud rate of the board"),
    ("look at cable, ground and baud rate", "check the cable, the ground and the baud rate;"),
    (
        "if its lines are further apart than ours, say so by mcu.reply_period",
        "if the board reports by its own clock, set mcu.reply_period to the seconds between its "
        "lines;",
    ),
    ("`acsard mcu check` looks closer", "`acsard mcu check` finds out more"),
    (
        "bytes heard but no line end, the last `",
        "bytes received but no line end; the last bytes are `",
    ),
    ("good, the last `", "good, the last one is `"),
    ("good, the last other `", "good, the last bad one is `"),
    (r"\b1 bytes received", "1 byte received"),
    ("lines heard, ", "lines received, "),
    (r"\b1 lines received", "1 line received"),
    ("good, all good, but too few", "good, all of them good, but too few for a link"),
    ("received, all good, but too few", "received, all of them good, but too few for a link"),
    (
        r"the microcontroller's lines come ([\d.]+) s apart: too seldom for a link by any setting; "
        r"firmware that reports by its own clock must do so every ([\d.]+) s or sooner",
        r"the microcontroller sends a line only every \1 s, and no value of mcu.reply_period "
        r"allows that; firmware that reports by its own clock must send a line at least every \2 s",
    ),
    (
        "what is sent comes back: TX and RX are joined, or the terminal echoes, or the RS-485 "
        "adapter, or the board reports the speeds it was sent, not those it measures; mend that, "
        "then replug it",
        "the daemon's own lines come back: TX and RX are connected to each other, or a terminal or "
        "the RS-485 adapter echoes, or the board reports the commanded speeds instead of "
        "the measured ones; remove the cause, then unplug the board and plug it in again",
    ),
    (
        "answered with a check before and now does not: its replies are damaged on the way "
        r"\(look at cable and baud rate\), or it has other firmware \(then replug it\)",
        "answered with a checksum before and now answers without one: either its replies are "
        "damaged (check cable and baud rate), or it runs other firmware "
        "(then unplug it and plug it in again)",
    ),
    (
        'answers without a check, and mcu.link_check = "require" drives only with one: give it '
        "firmware that has it, or write mcu",
        'answers without a checksum, but mcu.link_check = "require" lets the robot drive '
        "only with one: install firmware that supports the checksum, or write mcu",
    ),
    ("serial lines being asked for", "serial lines not checked yet"),
)
"""Words of reasons that mean the same: the old ones as a regular expression, and the new ones."""

DIFFERENCES: tuple[tuple[str, str, str, str], ...] = (
    ("mode", "^leaving$", "shutdown", "the mode of a daemon that goes down has another name"),
    *(("reason", old, new, "the same in other words") for old, new in REWORDED),
)

MOTION, LINK, SIMULATOR = "acsard/drive/", "acsard/mcu/", "acsard/sim/"

CORRECTED: tuple[tuple[str, tuple[str, ...]], ...] = (
    (
        "a kept stop waits for a clear without a number by the monotonic clock, not the wall clock",
        (MOTION + "lifecycle.py", "acsard/robot.py"),
    ),
    (
        "each deactivate is a new latch, and an activate can name the latch that it releases",
        (
            MOTION + "lifecycle.py",
            "acsard/incoming/commands.py",
            "acsard/messages/json_schema.py",
            "acsard/messages/report.py",
            "acsard/messages/schema.py",
            "acsard/robot.py",
            "acsard/values.py",
        ),
    ),
    (
        "a start with a latch file that cannot be written gives each latch a new number",
        ("acsard/runtime/kept_latches.py",),
    ),
    (
        "an echo is found up to seven lines later, beside the replies of a board, and also of "
        "checked lines without samples; a board that repeats only a steady ramp is none",
        (LINK + "echo.py", LINK + "negotiation.py", LINK + "session.py"),
    ),
    (
        "two starts with a latch file that cannot be written give different numbers, also if the "
        "wall clock went back, and so does a stop that arrives as the daemon crashes",
        ("acsard/runtime/kept_latches.py",),
    ),
    (
        "one stamp that goes back or stands shows no adjustment until the next command confirms it",
        (MOTION + "freshness.py",),
    ),
    (
        "a clock is proven by fewer rules, its proof does not end inside a burst, and a silence "
        "does not make a steady clock forget its lowest delay",
        (MOTION + "freshness.py",),
    ),
    (
        "a speed that came before a zero of an unproven clock never counts by that zero",
        (MOTION + "neutral.py",),
    ),
    (
        "commands that were dropped unread end the wait of a shared identity for its zero",
        (
            MOTION + "neutral.py",
            MOTION + "arbiter.py",
            "acsard/incoming/bus.py",
            "acsard/runtime/control_loop.py",
            "tests/scenarios/world.py",
        ),
    ),
    (
        "lines of a backlog are as far apart as their stamps",
        (LINK + "clock_of_reports.py",),
    ),
    (
        "replies that are lost soon after the board became faster cost no distance",
        (LINK + "clock_of_answers.py",),
    ),
    (
        "a sender that is armed later does not take the robot from one of the same priority that "
        "drives",
        (MOTION + "arbiter.py",),
    ),
    (
        "neither one feedback line after a stall, nor a wheel that follows sooner than its "
        "response time, nor one that sped up during a stall is a wheel fault",
        (MOTION + "sanity.py",),
    ),
    (
        "a board that answers each line again is assigned no line from before it seemed to report",
        (LINK + "clock_of_answers.py", LINK + "feedback.py"),
    ),
    (
        "after a second without an answer a zero counts only once the board answers again",
        (LINK + "session.py",),
    ),
    (
        "the simulated robot moves in fewer steps, so the last bits of its gyro differ",
        (
            SIMULATOR + "fake_mcu.py",
            SIMULATOR + "faults.py",
            SIMULATOR + "protocol.py",
            SIMULATOR + "vehicle.py",
            MOTION + "path.py",
        ),
    ),
)
"""Each correction that the patch brings to the older checkout, with the files that it changes."""

LEFT_OUT: tuple[tuple[str, object, str], ...] = ()
