"""acsard: the hardware interface daemon of a differential-drive robot.

One process, the daemon, drives the robot with one asyncio event loop. The daemon exchanges lines
with a microcontroller on a serial port, and messages with clients on a Zenoh bus. It runs a control
step every 10 ms. A second process, the gateway, terminates TLS connections from the network.

 serial -> lines --> robot.hear(now, heard) --> estimates, events, answers --> bus
 bus ----> decode ->        |
                            v
 timer ------------> robot.drive(now) --> line --> guard --> port --> robot.sent(at_ns, line)

`hear` updates the odometry from the feedback, chooses one command and checks that the mode allows
it. `drive`, in each control period and at once for another speed, limits it and returns the line
for the board. `sent` says which line really left, and `core/link/link_output.py` remembers it. No
other function decides how the robot moves.

Where to look: each package may import only the packages below it in this list.
`pyproject.toml` states this order as contracts, and `lint-imports` checks the contracts.

    cli/             one file per subcommand: its options, a call into another package, output
    foxglove/        `acsard foxglove`: a live server for Foxglove
    top/             `acsard top`, `acsard drive` and `acsard fleet`: the robot in a terminal
    web/             `acsard web`: the robot's page, in a separate process
    calibration/     `acsard calibrate`: calibrates from a recorded drive or a new one
    machine/         tools for the administrator of the computer: `acsard doctor`, certificates for
                     other machines, the serial ports, the system service
    client/          follows and drives a robot from Python, synchronously or with asyncio; its
                     `Follower` and `Ride` have the rules and time limits that all tools use
    daemon/          the daemon's process: control loop, shutdown, and the file that keeps a stop
                     or a fault latched over a restart
    daemon/gateway/  `acsard gateway`: the process that terminates TLS connections
    daemon/bus/      the robot's keys: subscriptions, publications, replies to queries
    daemon/serial/   the serial port: pyserial-asyncio reads it, the daemon writes it
    recording/       the black box: writes the steps to files, deletes old files, reads the
                     files, and replays them
    bus/             Zenoh for every process: addresses, sessions, access rules, certificates,
                     subscriptions, discovery of robots
    terminal/        prints tables and output of all tools with the library rich; asks the person
                     near the robot questions
    host/            the parts that every process uses: clock, timers, threads and the mailboxes
                     between them, child processes, files, systemd, logs, errors
    checkup/         `acsard mcu check`: one module for each check of the board
    core/            the robot as a pure function: no clock, no I/O, no thread

Inside `core/`, in the same order:

    core/simulator/  the vehicle, the simulated microcontroller and its faults
    core/summary.py  what `state` and `diagnostics` say about a robot
    core/robot.py    hear, drive and sent; core/guard.py checks each outgoing line
    core/robot_memory.py  all that the robot knows between two steps; a recording stores it as it is
    core/reasons.py  the text in `reason`
    core/board_inputs.py  emergency stop, bumpers and battery, as the board reports them
    core/incoming/   input from the bus: turns samples into commands, and answers queries
    core/ros/        the two ROS transports: names, hashes, tokens, attachments, parameters
    core/messages/   the published structs, the table of keys, encodings, reports, schemas
    core/motion/     kinematics, odometry, consistency checks, arbiter, ages, limits, modes
    core/link/       the serial line: codec, checksum, question, output, sample times, late steps,
                     state
    core/config/     turns acsard.toml into one frozen Config, or into errors that name the key
                     and the remedy
    core/values.py   the values in SI units: Instant, Twist, Pose, Command, Heard, News
    core/throttle.py  the limit of a rate: of log lines, requests, reports
    core/formatting.py  safe text, numbers, durations and counts for every message

Three invariants hold, and each is tested:

1. Nothing in `core/` does I/O, and in the daemon only `host/clock.py` reads a clock.
2. A wheel speed grows only in a step with a fresh command, a live link and the mode `driving`.
   In every other step it stays the same or falls. Without a link the commanded speed is zero
   immediately. The guard checks this rule with its own code, and also checks that each ramp to
   rest ends in time.
3. No line for the board is queued. If the serial port cannot take a line now, the daemon drops
   that line, and the next line replaces it.
"""

__version__ = "0.3.0"
