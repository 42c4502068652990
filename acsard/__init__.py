"""acsard: the hardware interface daemon of a four-wheel differential-drive robot.

One process with one asyncio event loop drives the robot. Below it is a microcontroller on a serial
line, above it a Zenoh bus, and a control step runs between them every 10 ms. TLS connections from
a network end in another process, the gateway.

      one task, every 10 ms (earlier when a fresh command or feedback is in hand)

 serial -> received bytes ---+                          +-> report -> encode -> bus
                             +-> robot.step(inputs) ----+
 bus -> decode -> commands --+         (pure)           +-> line -> guard -> serial

`Robot.step` does, in this order: fold the feedback into odometry, choose one command, gate it by
mode, limit it, invert the kinematics, report. No other function decides anything.

Where to look: each package may import only those below it. `pyproject.toml` states
this order as contracts, and `lint-imports` checks them.

    cli/             one file per subcommand: its options, a call into another package, output
    bench/           `acsard bench`: measures a daemon from outside
    foxglove/        `acsard foxglove`: a live server for Foxglove
    report/          `acsard recording report`: what a recording shows, as a page
    top/             `acsard top`, `acsard drive` and `acsard fleet`: the robot in a terminal
    web/             `acsard web`: the robot's page, in a process of its own
    calibration/     `acsard calibrate`, by a log or a drive of its own, and `acsard accuracy`: how
                     much each cause contributes to the odometry's error
    machine/         what an administrator does with the computer: `acsard doctor`, certificates for
                     other machines, the serial ports, the system service
    client/          follow and drive a robot from Python, synchronous or with asyncio; the
                     follower and the commander hold the rules and time limits of all tools
    daemon/          the process: control loop, latch file, ways down
    daemon/gateway/  `acsard gateway`: the process in which TLS ends
    daemon/bus/      the Zenoh sessions: subscriptions, publications, replies, access rules
    daemon/serial/   the serial port
    recording/       the black box: steps to MCAP and back, a ring of files, replay
    terminal/        tables and output of all tools, by the library rich; questions to the person
                     beside the robot: at a terminal, or through a program in JSON
    host/            what every process uses: clock, timers, threads and the mailboxes between
                     them, child processes, files, rate limits, systemd, logs, errors
    checkup/         `acsard mcu check`: one module for each question to the board
    core/            the robot as a pure function: no clock, no I/O, no thread

Inside `core/`, in the same order:

    core/simulator/  the vehicle, the simulated microcontroller and its faults
    core/robot.py    the order of a step; core/guard.py checks each outgoing line
    core/incoming/   what comes in over the bus: a sample becomes a command, a query a reply
    core/ros/        the two ROS transports: names, hashes, tokens, attachments, parameters
    core/messages/   the published structs, the table of keys, encodings, reports, schemas
    core/motion/     kinematics, odometry, consistency checks, arbiter, freshness, limits, modes
    core/link/       the serial line: codec, checksum, negotiation, sample times, link state
    core/config/     acsard.toml becomes one frozen Config, or errors that name key and mend
    core/values.py   the values in SI units: Instant, Twist, Pose, Command, Inputs, Outputs
    core/formatting.py  safe text, figures, durations and counts for every message
    core/thinning.py    curves and paths of any length in a bounded number of points

Three invariants hold, and each is tested:

1. Nothing in `core/` does I/O, and in the daemon only `host/clock.py` reads a clock.
2. No wheel speed grows unless a fresh command, a live link and mode `driving` agree in the same
   step. Otherwise it only falls, and without a link the command is zero at once. The guard checks
   exactly this, and that each ramp ends in time, with code of its own.
3. No line is held back to be sent later. If it cannot go now, the next line supersedes it.
"""

__version__ = "0.1.0"
