"""acsard: the hardware interface daemon of a four-wheel differential-drive robot.

One process, one asyncio event loop: a serial microcontroller below, a Zenoh bus above, a control
step every 10 ms between. Who comes from the network comes through another process, the door.

      one task, every 10 ms (earlier when a fresh command or feedback is in hand)

 serial -> received bytes ---+                          +-> report -> encode -> bus
                             +-> robot.step(inputs) ----+
 bus -> decode -> commands --+         (pure)           +-> line -> guard -> serial

Inside `Robot.step`, top to bottom: fold the feedback into odometry, choose one command, gate by
mode, limit, invert the kinematics, report. Nothing else decides anything.

Where to look: one room per concern, in the order they may import each other (P: pure, no clock
and no I/O; S: shell). `pyproject.toml` has the order as a contract, `lint-imports` checks it.

    values.py      P  the nouns, SI: Instant, Twist, Pose, WheelSpeeds, Command, Inputs, Outputs
    thinning.py    P  curves, bands and paths in bounded memory: a day in a minute's room
    formatting.py  P  safe text, signed figures, durations, counts and lists, for every message
    config/        P  acsard.toml -> one frozen Config, or errors that name the key and the mend
    mcu/           P  the serial line: codec, the check, link (is the MCU there?), the port
    drive/         P  kinematics, odometry, sanity (can this feedback be true?), arbiter (who is
                      followed?), neutral (who may drive?), freshness (what came too late), words
                      (all that in sentences), limits, modes (the table), tally (the log)
    messages/      P  the published structs, topics (**the** key table), encodings, report,
                      json_schema (of what goes out and comes in)
    ros/           P  the two ROS trees: names and hashes, tokens, attachments, parameters
    incoming/      P  what comes in over the bus: sample -> command, query -> reply or request
    robot.py       P  the order; guard.py: the last look at every outgoing line
    terminal/      S  what every tool prints with, by the library rich: tables (P), output
    sim/           P  the vehicle, the fake microcontroller, its faults
    checkup/       P  what `acsard mcu check` does: one module a question to the board
    error_budget/  P  what `acsard odom` does: drive_log (what the bus told), steps, budget (each
                      cause's share), text
    calibration/   P  what `acsard calibrate` does: table and runs (a log), heading and places (what
                      it shows), fit, solve (the order), report; calibration/guided/ is the
                      drive without a log: the ways, the legs, what a person reads off
    host/          S  the machine: clock, timers, threads, files, systemd, journal, logs, errors
    serial/        S  owns the serial port
    bus/           S  owns the Zenoh sessions: inbox, outlets, replies, access rules, certificates
    record/        S  the black box: steps <-> MCAP, a ring of files, replay (its core is pure)
    runtime/       S  the control loop, the daemon, the latch file; figures of itself
    door/          S  `acsard door`: where TLS ends, a process of its own
    client/        S  drive and follow a robot from Python: synchronous, asynchronous; follower and
                      commander hold the rules and the limits for all that follow and command
    report/        P  `acsard log report`: course (what a recording shows), account (words),
                      figures, page
    bench/ top/    S  `acsard bench` and `acsard top`: they stand outside and look
    foxglove/      S  `acsard foxglove`, outside too: drives (what viewers send), relay (what
                      comes), settings, services, bridge (goes round)
    web/           S  `acsard web`: the robot's page, a process of its own; app has the table of its
                      paths, which admission and openapi follow; a viewer per browser; guide has a
                      check or calibration done, by errands (the command's words)
    doctor/ lan/   S  `acsard doctor`, one module a subject; certificates for other machines
    asking/        S  how a verb asks who stands beside the robot: at a terminal, by a program
    cli/           S  one verb per file

Three invariants, each tested:

1. Only the rooms marked S do I/O; only host/clock.py reads a clock for the daemon.
2. No wheel speed grows unless a fresh command, a live link and mode driving agree in the same
   step; otherwise it only falls, and without a link the command is zero at once. The guard checks
   exactly this, and that each ramp ends in time, with code of its own.
3. No line is held back to be sent later: one that cannot go now is superseded by the next.
"""

__version__ = "0.1.0"
