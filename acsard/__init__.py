"""acsard: the hardware interface daemon of a four-wheel differential-drive robot.

One process, one asyncio event loop: a serial microcontroller below, a Zenoh bus above, a control
step every 10 ms between.

      one task, every 10 ms (earlier when a fresh command or feedback is in hand)

 serial -> received bytes ---+                          +-> report -> encode -> bus
                             +-> robot.step(inputs) ----+
 bus -> decode -> commands --+         (pure)           +-> line -> guard -> serial

Inside `Robot.step`, top to bottom: fold the feedback into odometry, choose one command, gate by
mode, limit, invert the kinematics, report. Nothing else decides anything.

Where to look, in the order the modules may import each other:

    values.py         the nouns, SI: Instant, Twist, Pose, WheelSpeeds, Command, Inputs, Outputs
    settings.py       the keys of acsard.toml; validation.py, rules.py, config.py: file -> Config,
                      or why not
    figures.py        what the daemon measures of itself, in histograms of fixed size
    mcu/              wire time, pace (when a line may go), round trip, lines, frames (the
                      protocol), session (is the MCU there?)
    drive/            kinematics, odometry, sanity (can this feedback be true?), arbiter (who
                      commands?), limits, modes (the table), lifecycle (what latched it)
    messages/         schema (the published structs), topics (**the** key table), cdr, encodings,
                      incoming (sample -> command), report (outputs -> messages), queries
    ros/              the two ROS trees: names and hashes, tokens, attachments, what stands for
                      which native key, the configuration as parameters
    access.py         who may do what: the topic table -> Zenoh's access rules
    robot.py          the order; guard.py: the last look at every outgoing line
    sim/              the vehicle, the fake microcontroller, its faults
    checkup/          what `acsard mcu check` does: one module a question to the board
    matching.py       which message belongs to which line: what `acsard bench` measures
    runtime/          clock, ticker, real_time, serial device and port, Zenoh bus (inbox, outlets,
                      replies), systemd and its journal, logs, control loop, daemon, the bench's rig
    client.py         drive and follow a robot from Python
    cli/              one verb per file

Three invariants, each tested:

1. Only runtime/, cli/ and client.py do I/O; only runtime/clock.py reads a clock for the daemon.
2. No wheel speed grows unless a fresh command, a live link and mode driving agree in the same
   step; otherwise it only falls, and without a link the command is zero at once. The guard checks
   exactly this, with code of its own.
3. No line is held back to be sent later: one that cannot go now is superseded by the next.
"""

__version__ = "0.1.0"
