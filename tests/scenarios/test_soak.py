"""The robot never moves when it must not, in ten thousand attempts and in a day of faults.

A fault occurs in each minute of the day. Each test prints its result. The short versions run by
default, those marked slow in `.ci/run`, and those with more random cases in the nightly job. The
long ones run with

    pytest -m soak -s tests/scenarios/test_soak.py
"""

from __future__ import annotations

import gc
import random
import sys
import time
import zlib
from collections import Counter, deque

import msgspec
import pytest

from acsard.core.config.settings import CommandsConfig, Config, ControlConfig, McuConfig, Source
from acsard.core.motion.ages import RISE_DIVISOR, SILENT_NS
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.values import NS_PER_S, WHEELS
from tests.each import more
from tests.scenarios.speakers import FOREIGN, SHARED, STAMPED, Speaker, Way, backlog, moved
from tests.scenarios.world import World
from tests.stepped import Outputs

ZERO = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"
DAY_NS = 86_400 * NS_PER_S


def slow(value: float) -> object:
    """Return a parameter for a run that only `.ci/run` does, because it is slow."""
    return pytest.param(value, marks=pytest.mark.slow)


def long(count: int, seconds: int) -> object:
    """Return a parameter for a soak run, which may take this many seconds of real time."""
    return pytest.param(count, marks=[pytest.mark.soak, pytest.mark.timeout(seconds)])


def wheels(line: bytes) -> tuple[float, ...]:
    """Return the wheel speeds in a line of the daemon, rad/s."""
    return tuple(
        float(line[at + 2 : at + 7]) * (1 if line[at + 1 : at + 2] == b"p" else -1)
        for at in (0, 8, 16, 24)
    )


def lines_of(world: World) -> list[bytes]:
    """Return the lines of the daemon that command speeds: not the link's question."""
    return [line for _, line in world.port.sent if line[:1] != b"?"]


def speed(line: bytes) -> float:
    """Return the fastest wheel of a line, rad/s, without its sign."""
    return max(map(abs, wheels(line)))


# a. silence


def refused(world: World, dice: random.Random) -> None:
    """Send a message that the daemon must refuse as a command."""
    match dice.randrange(4):
        case 0:
            world.put("cmd/it", b'{"linear": {"x": ')
        case 1:
            nan = {"linear": {"x": float("nan")}, "angular": {}}
            world.put("cmd/it", msgspec.msgpack.encode(nan))
        case 2:
            world.send(0.5, source="stranger")
        case 3:
            world.put("cmd/it", b'{"linear": {"x": 0.5}, "angular": {}}', put=False)


def silence(world: World, dice: random.Random, timeout: float) -> float:
    """Drive, then send no commands. Return the time from the last one to the first braking, s."""
    linear = dice.choice((-1, 1)) * dice.uniform(0.1, 1.0)
    angular = dice.uniform(-1.5, 1.5)
    pause = min(0.05, timeout * 0.6)
    world.send(0.0, source="it")
    world.run(2 / world.config.rate_hz)
    for _ in range(dice.randint(4, 16)):
        world.send(linear, angular, "it")
        world.run(pause * dice.uniform(0.5, 1.0))
    world.run(dice.random() / world.config.rate_hz)
    world.send(linear, angular, "it")
    last_ns = world.now_ns
    world.port.sent.clear()
    end_ns = last_ns + int((timeout + 3 / world.config.rate_hz) * NS_PER_S)
    while world.now_ns < end_ns:
        if dice.random() < 0.3:
            refused(world, dice)
        world.run(min(0.04, (end_ns - world.now_ns) / NS_PER_S + 1e-9))
    before = 0.0
    for at_ns, line in world.port.sent:
        if line[:1] == b"?":
            continue
        if speed(line) < before:
            took = (at_ns - last_ns) / NS_PER_S
            break
        before = speed(line)
    else:
        return float("inf")
    while world.port.sent[-1][1] != ZERO:
        world.run(0.1)
    return took


@pytest.mark.slow
@pytest.mark.parametrize("count", [50, more(200), long(10_000, 1200)])
def test_after_silence_the_ramp_starts_within_the_timeout_and_a_tick(count: int) -> None:
    dice, hits, latest = random.Random(1), 0, 0.0
    for trial in range(count):
        if trial % 25 == 0:
            rate = dice.choice((10.0, 20.0, 50.0, 100.0, 100.0, 200.0))
            timeout = round(dice.uniform(max(0.02, 2 / rate), 0.6), 3)
            source = Source("it", dice.randrange(100), timeout)
            config = Config(
                control=ControlConfig(rate=rate),
                commands=CommandsConfig(sources=(Source("other", 50), source)),
            )
            world = World(config)
            world.run(1.0)
        took = silence(world, dice, timeout)
        late = (took - timeout) * rate
        hits += 0.0 <= late <= 1.0 + 1e-6
        latest = max(latest, late)
    print(
        f"\nsilence: {hits} of {count} ramps within timeout + 1 tick; the latest {latest:.3f} tick"
    )
    assert hits == count


# b. neutral first

STARTS_OVER = (
    "restart", "replug", "new board", "reset", "mute", "stop, clear", "fault, clear", "activate",
)  # fmt: skip


def start_over(world: World, kind: str, dice: random.Random) -> World:
    """Cause an event of this kind, such as a reset, while the commander sends speeds.

    Returns the world after the event, which is a new one after a restart of the daemon.
    """
    fast = dice.uniform(-0.9, 0.9)
    match kind:
        case "restart":
            again = World(world.config, plugged=False)
            again.now_ns = again.next_period_ns = world.now_ns + dice.randrange(3 * NS_PER_S)
            again.mcu = world.mcu
            again.port.plug(world.mcu)
            return again
        case "replug" | "new board":
            world.port.unplug()
            if kind == "new board":
                world.mcu = FakeMcu(world.config, world.now_ns)
            world.hold(fast, seconds=dice.uniform(0.0, 2.0))
            world.mcu.advance(world.now_ns)
            world.port.plug(world.mcu)
        case "reset":
            world.mcu.reset(world.now_ns)
            world.hold(fast, seconds=2.1)
        case "mute":
            with world.mcu.mute():
                world.hold(fast, seconds=dice.uniform(1.2, 3.0))
        case "stop, clear":
            world.put("stop", b"")
            world.hold(fast, seconds=dice.uniform(1.0, 2.0))
            assert world.state.mode == "stopped"
            world.call("clear")
        case "fault, clear":
            with world.mcu.bias(dice.randrange(4), dice.choice((-1.0, 3.0, 9.0))):
                world.hold(0.5, seconds=2.0)
                assert world.state.mode == "fault"
            world.hold(fast, seconds=0.5)
            world.call("clear")
        case "activate":
            world.call("deactivate")
            world.hold(fast, seconds=dice.uniform(1.5, 2.0))
            world.call("activate")
    return world


@pytest.mark.slow
@pytest.mark.parametrize("count", [8, more(48), long(1_000, 1800)])
def test_the_robot_does_not_move_before_neutral_after_any_kind_of_restart(count: int) -> None:
    dice, successes, counts = random.Random(2), 0, Counter[str]()
    world = World()
    world.run(0.3)
    for trial in range(count):
        kind = STARTS_OVER[trial % len(STARTS_OVER)]
        source = dice.choice(("app", "nav", "teleop"))
        # The speed is high enough to reveal every kind of encoder fault.
        linear = dice.choice((-1, 1)) * dice.uniform(0.4, 0.9)
        world.drive(linear, seconds=dice.uniform(0.5, 1.2))
        assert world.state.mode == "driving"
        world = start_over(world, kind, dice)
        world.port.sent.clear()
        hz = dice.choice((5.0, 10.0, 20.0, 50.0))
        world.hold(linear, dice.uniform(-1, 1), 1.5, source, hz)
        lines = lines_of(world)
        still = len(lines) > 100 and lines[0] == ZERO and set(lines) == {ZERO}
        waiting = world.state.mode == "ready" and world.state.code == "neutral"
        successes += still and waiting
        counts[kind] += still and waiting
        world.run(0.3)
        world.drive(linear, seconds=0.2, source=source)
        assert world.state.mode == "driving"  # it is not simply dead
        world.send(0.0, source=source)
        world.run(1.5)
    print(f"\nneutral first: {successes} of {count}; {dict(counts)}")
    assert successes == count


# c. blackholes

NORMAL_NS = 3_000_000
"""The normal delay, which a relative age cannot reveal."""


def blackhole(dice: random.Random, slow: bool, seconds: float) -> tuple[int, int, int]:
    """Run a network that stores all commands for `seconds` and then delivers them.

    A command that is stale on arrival asks for backward motion, and every other one for forward
    motion. Returns the number of stale commands, of lines with backward motion, and of accepted
    stale commands. Afterwards the robot drives by the fresh commands; after 10 s without an
    accepted one, only after a new zero.
    """
    timeout_ns, pause_ns = NS_PER_S // 4, int(NS_PER_S / dice.choice((20, 30, 50)))
    world = World()
    world.run(0.3)
    clock_ns = dice.randrange(2 * DAY_NS)
    queue: deque[int] = deque()
    start_ns = world.now_ns
    hole_ns = start_ns + dice.randrange(NS_PER_S // 2, NS_PER_S)
    end_ns = hole_ns + int(seconds * NS_PER_S)
    # For each line that is sent, the drain delivers this many.
    pace = dice.uniform(1.2, 6.0)
    next_ns, credit, stale, accepted, drained_ns = start_ns, 0.0, 0, 0, 0
    counters = world.loop.robot.counters
    first, known, accepted_ns, silent_ns = True, 0, world.now_ns, 0
    while not drained_ns or world.now_ns < drained_ns + NS_PER_S:
        queue.append(next_ns)
        next_ns += pause_ns
        if not hole_ns <= world.now_ns < end_ns:
            credit = min(credit + (pace if slow else 1e9), len(queue))
            while queue and credit >= 1.0:
                credit -= 1.0
                sent_ns = queue.popleft()
                # Two clocks may have drifted since the last command before the hole.
                drift_ns = max(0, world.now_ns - hole_ns + pause_ns) // RISE_DIVISOR
                old = world.now_ns - sent_ns > timeout_ns + NORMAL_NS + drift_ns
                obeyed = counters["commands"]
                world.send(0.0 if first else -0.5 if old else 0.5, stamp_ns=sent_ns + clock_ns)
                first = False
                if old and (slow or dice.random() < 0.5):  # one by one, or all in one step
                    world.loop.step(world.instant)
                    accepted += counters["commands"] - obeyed
                stale += old
            if world.now_ns >= end_ns and not queue and not drained_ns:
                drained_ns = world.now_ns
        world.run((max(next_ns, world.now_ns) - world.now_ns) / NS_PER_S + 1e-9)
        if counters["commands"] > known:
            known = counters["commands"]
            silent_ns = max(silent_ns, world.now_ns - accepted_ns)
            accepted_ns = world.now_ns
    backward = sum(min(wheels(line)) < 0 for line in lines_of(world))
    if silent_ns > SILENT_NS + 2 * pause_ns:
        assert world.state.code == "neutral", world.state.reason
        world.send(0.0, stamp_ns=world.now_ns + clock_ns)
        world.run(0.05)
        world.send(0.5, stamp_ns=world.now_ns + clock_ns)
        world.run(0.05)
    if not SILENT_NS - 2 * pause_ns <= silent_ns <= SILENT_NS + 2 * pause_ns:
        assert world.state.mode == "driving", world.state.reason
    return stale, backward, accepted


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, more(10), long(200, 1800)])
def test_no_stale_command_is_obeyed_after_a_blackhole(count: int) -> None:
    dice, stale, backward, accepted = random.Random(3), 0, 0, 0
    for trial in range(count):
        stale_count, moved, counted = blackhole(dice, trial % 2 == 1, dice.uniform(0.3, 15.0))
        stale, backward, accepted = stale + stale_count, backward + moved, accepted + counted
    print(
        f"\nblackholes: {count}, {stale} stale commands held back, {accepted} accepted, "
        f"{backward} lines moved by them"
    )
    assert stale > 10 * count
    assert (accepted, backward) == (0, 0)


# d. a day

MODES = {"inactive", "waiting", "ready", "driving", "stopped", "fault"}
TROUBLES = (
    "mute", "reset", "noise", "partial_line", "unplug", "block", "stall", "stuck", "bias",
    "bad commands", "clock", "stop",
)  # fmt: skip

# After more than 3 s, the state also names what was received.
SILENT_CODES = {
    "mute": "received_nothing",
    "noise": "received_foreign",
    "partial_line": "received_cut",
}
WHEEL_CODES = "wheel_reversed", "wheel_runaway", "wheel_too_fast"


def trouble(world: World, kind: str, dice: random.Random) -> str:
    """Cause one fault and end it.

    Returns an error text if the `state` has another code than expected during the fault, else "".
    """
    seconds, wheel, linear = dice.uniform(0.5, 4.0), dice.randrange(4), 0.5
    if kind in SILENT_CODES:
        with getattr(world.mcu, kind)():
            world.hold(linear, seconds=seconds)
            return _wrong_code(world, "link_silent", SILENT_CODES[kind])
    if kind == "reset":
        world.mcu.reset(world.now_ns)
        world.hold(linear, seconds=1.0)
        return _wrong_code(world, "link_silent")
    if kind == "unplug":
        world.port.unplug()
        world.hold(linear, seconds=seconds)
        wrong = _wrong_code(world, "port_closed")
        world.mcu = FakeMcu(world.config, world.now_ns)
        world.port.plug(world.mcu)
        return wrong
    if kind == "block":
        world.port.blocked = True
        world.hold(linear, seconds=seconds)
        world.port.blocked = False
        return _wrong_code(world, "port_blocked")
    if kind == "stall":
        world.send(linear)
        world.stall(seconds / 4)
        return ""
    if kind == "stuck":
        with world.mcu.stuck_encoder(wheel):
            world.hold(linear, seconds=2.5)
            # The other wheel of its side turns, so this one is no reason to stop.
            text = f"{WHEELS[wheel]} wheel is left out of the pose"
            said = world.state.wheel_fault
            return _wrong_code(world, "commanded") or ("" if text in said else f"says {said!r}")
    if kind == "bias":
        gain = dice.choice((-1.0, 3.0, 9.0))
        with world.mcu.bias(wheel, gain):
            world.hold(linear, seconds=2.5)
            return _wrong_code(world, *(("impossible_speeds",) if gain == 9.0 else WHEEL_CODES))
    if kind == "bad commands":
        world.put("cmd/app", b"{")
        world.put("cmd/*", b"{}")
        world.put("wheel_cmd/app", b"\x80")
        world.send(1e300, -1e300, source="stranger")
        world.run(seconds)
        return _wrong_code(world, "no_command")
    if kind == "clock":
        world.wall_offset_ns += dice.choice((-1, 1)) * dice.randrange(DAY_NS)
        world.hold(linear, seconds=seconds)
        return _wrong_code(world, "commanded")
    world.put("stop", b"")
    world.hold(linear, seconds=seconds)
    return _wrong_code(world, "stopped")


def _wrong_code(world: World, *codes: str) -> str:
    state = world.state
    return "" if state.code in codes else f"{codes}, not {state.mode}: {state.reason!r}"


def recover(world: World) -> None:
    """Recover from any fault: clear it, send a zero, and check that the robot drives and stops."""
    world.run(3.0)  # a board that was reset boots for 2 s
    if world.state.mode in ("stopped", "fault"):
        assert world.call("clear").success
    world.drive(0.3, seconds=0.5)
    assert world.state.mode == "driving", world.state.reason
    world.send(0.0)
    world.run(1.0)
    assert world.state.mode == "ready", world.state.reason


def empty(world: World) -> int:
    """Delete the messages that only the test stores. Return the number of memory blocks in use."""
    for messages in (world.events, world.bus.replies, world.bus.finished, world.port.sent):
        messages.clear()
    world.mcu.heard.clear()
    gc.collect()
    return sys.getallocatedblocks()


@pytest.mark.parametrize("minutes", [slow(5), long(24 * 60, 3600)])
def test_a_day_with_a_fault_every_minute_is_explained_and_leaks_no_memory(
    minutes: int,
) -> None:
    # the silence is not that of a late simulator
    board = Config(mcu=McuConfig(port="/dev/a-board"))
    dice, world, unexplained = random.Random(4), World(board), list[str]()
    kinds, modes = Counter[str](), Counter[str]()
    # Each kind of fault may fill a bounded history for the first time.
    settled, faults = (60, minutes) if minutes > 60 else (len(TROUBLES), 2 * len(TROUBLES))
    baseline = last = 0
    began = time.perf_counter()

    def watch(outputs: Outputs) -> None:
        modes[outputs.mode] += 1
        if outputs.mode not in MODES or len(outputs.reason) < 6:
            unexplained.append(f"{outputs.mode}: {outputs.reason!r}")
        if (outputs.mode == "driving") != (outputs.code == "commanded"):
            unexplained.append(f"{outputs.mode} says {outputs.reason!r}")

    world.watch = watch
    world.run(0.3)
    for minute in range(faults):
        start_ns = world.now_ns
        world.drive(dice.uniform(0.5, 0.9), dice.uniform(-0.5, 0.5), dice.uniform(1.5, 20.0))
        kind = TROUBLES[minute % len(TROUBLES)]
        kinds[kind] += 1
        wrong = trouble(world, kind, dice)
        if wrong:
            unexplained.append(f"minute {minute}, {kind}: {wrong}")
        recover(world)
        world.run(60.0 * minutes / faults - (world.now_ns - start_ns) / NS_PER_S)
        last = empty(world)
        if minute + 1 == settled:
            baseline = last
    drift = last / baseline - 1
    print(
        f"\na day: {minutes} min with {kinds.total()} faults in {time.perf_counter() - began:.0f} s"
        f", memory drift {drift:+.3%} ({baseline} -> {last} blocks), "
        f"{len(unexplained)} unexplained states; steps by mode {dict(modes)}"
    )
    assert not unexplained
    assert world.state.mode == "ready"
    assert abs(drift) < 0.01


# e. the wall clock


def walk(count: int, jumps: bool) -> tuple[int, int, list[int], object]:
    """Drive at random while the wall clock jumps `count` times, or does not jump at all.

    Returns the number of control periods and of missed ones, digests of poses and lines, and the
    counters.
    """
    dice, clock = random.Random(5), random.Random(6)
    world, ticks, trace = World(), 0, [0, 0]

    def watch(outputs: Outputs) -> None:
        nonlocal ticks
        ticks += outputs.due
        for estimate in outputs.estimates:
            values = (estimate.at.mono_ns, msgspec.to_builtins(estimate.pose), estimate.positions)
            trace[0] = zlib.crc32(repr(values).encode(), trace[0])
        if outputs.line is not None:
            trace[1] = zlib.crc32(b"%d %s" % (outputs.now.mono_ns, outputs.line), trace[1])

    world.watch = watch
    world.run(0.3)
    world.send(0.0, stamp_ns=world.now_ns)
    for _ in range(count):
        linear, angular = dice.uniform(-1, 1), dice.uniform(-3, 3)
        for _ in range(dice.randint(1, 12)):
            world.send(linear, angular, stamp_ns=world.now_ns)
            world.run(dice.uniform(0.01, 0.1))
        step_ns = clock.choice((-DAY_NS, DAY_NS, clock.randrange(-DAY_NS, DAY_NS)))
        world.wall_offset_ns += step_ns if jumps else 0
    world.run(1.0)
    missed = world.loop.robot.counters["missed_periods"]
    return ticks, missed, trace, world.state.counters


@pytest.mark.slow
@pytest.mark.parametrize("count", [30, long(5_000, 1800)])
def test_a_wall_clock_that_jumps_a_day_loses_no_tick_and_moves_no_odometry(count: int) -> None:
    undisturbed, disturbed = walk(count, jumps=False), walk(count, jumps=True)
    ticks, missed = disturbed[:2]
    print(
        f"\nwall clock: {count} jumps of up to a day, {undisturbed[0] - ticks + missed} of {ticks} "
        f"ticks lost, odometry {'identical' if disturbed[2] == undisturbed[2] else 'DIFFERENT'}"
    )
    assert missed == 0
    assert disturbed == undisturbed


# f. backlogs


def poured_out(dice: random.Random, way: Way, running: bool) -> bool:
    """Return whether the delayed backlog of a sender that has ended moves the robot."""
    world = World()
    world.run(0.3)
    ahead = dice.choice((0.0, 0.3, -0.3, -2.0, 2.0, -3600.0, 86400.0))
    # Zenoh's own stamp does not survive being ahead: its sender is unstamped then.
    speaker = Speaker(world, way, ahead=min(0.0, ahead) if way == "zenoh" else ahead)
    if running:
        speaker.open()
        speaker.hold(0.0, 1.0)
        if dice.random() < 0.5:
            world.call("stop")
            world.call("clear")
    world.run(1.0)
    while True:
        age, span, poured = (dice.uniform(*limits) for limits in ((0.3, 60), (0.3, 60), (0.1, 20)))
        if abs(span / poured - 1) > 0.011:
            break  # otherwise it looks like a clock that is behind: the test below
    since_ns = world.now_ns
    # The backlog begins after the last earlier command: stamps that go back are a clock set back.
    world.run(age + span if running else 0.0)
    backlog(dice, speaker, age, span, poured)
    return moved(world, since_ns)


@pytest.mark.slow
@pytest.mark.parametrize("count", [3, more(24), long(500, 1800)])
def test_no_backlog_moves_the_robot_for_a_new_or_a_known_sender(
    count: int,
) -> None:
    dice, successes, counts = random.Random(7), 0, Counter[str]()
    for trial in range(count):
        way, running = STAMPED[trial % len(STAMPED)], trial % 8 >= 4
        still = not poured_out(dice, way, running)
        successes += still
        counts[f"{way}, {'running' if running else 'fresh'}"] += not still
    print(f"\nbacklogs: {count - successes} of {count} moved the robot {dict(+counts)}")
    assert successes == count


@pytest.mark.slow
@pytest.mark.parametrize("way", STAMPED)
def test_a_replay_in_real_time_by_a_new_sender_looks_like_a_clock_that_is_behind(
    way: Way,
) -> None:
    """A delayed stream of a new sender without an echo, delivered in real time, moves the robot.

    The daemon cannot distinguish it from a sender whose clock is behind. It knows the delays of an
    earlier sender, so the stream of such a sender does not move the robot. Neither does a stream
    with an echo, whose age it measures by its own clock.
    """
    for known in (False, True):
        world = World()
        world.run(0.3)
        speaker, messages = Speaker(world, way), []
        if known:
            speaker.open()
            world.run(1.0)
        for number in range(80):
            messages.append(speaker.message(0.0 if number < 20 else 0.4))
            world.run(0.05)
        world.run(5.0)
        since_ns = world.now_ns
        for message in messages:
            speaker.deliver(message)
            world.run(0.05)
        assert moved(world, since_ns) is (not known and way in FOREIGN)


# g. clocks of senders


def driving_again(world: World, speaker: Speaker, within: float = 3.0) -> bool:
    """Send speeds for `within` s, zeros, and speeds again. Return whether the robot drives."""
    speaker.hold(0.4, within)
    # A zero of an identity that programs may share counts after a second. So does one whose stamp
    # Zenoh replaced because its clock is ahead.
    speaker.hold(0.0, 1.2 if speaker.way in SHARED else 0.5)
    for _ in range(5):
        speaker.hold(0.4, 0.1)
        if world.state.mode == "driving":
            return True
    return False


def drives_on_or_again(world: World, speaker: Speaker) -> bool:
    """Return whether the robot drives on for 4 s, or drives again within 3 s after it stopped.

    The 3 s include the zeros that the sender must send.
    """
    for _ in range(40):
        speaker.hold(0.4, 0.1)
        if world.state.mode != "driving":
            return driving_again(world, speaker, 1.5)
    return True


def stale_moves(world: World, speaker: Speaker, cut: float) -> bool:
    """Return whether backward commands that a network delays by up to `cut` s move the robot.

    If the sender's clock has gained time, its commands look fresher by that time, so the newest
    commands are left out.
    """
    messages, end_ns = [], world.now_ns + int(cut * NS_PER_S)
    while world.now_ns < end_ns:
        messages.append(speaker.message(-0.5))
        world.run(0.05)
    since_ns = world.now_ns
    for message in messages[: -6 - round(20 * max(0.0, speaker.gained))]:
        speaker.deliver(message)
        world.run(0.001)
    world.run(0.1)
    sent = [(at, line) for at, line in world.port.sent if line[:1] != b"?"]
    return any(at >= since_ns and min(wheels(line)) < 0 for at, line in sent)


def stepped(dice: random.Random, way: Way, ahead: float, step: float) -> str:
    """Step the sender's clock by `step` seconds while it drives, and later interrupt the network.

    After a step back the sender may have to wait for `activate`.

    Returns a description of the failure, or "".
    """
    world = World()
    world.run(0.3)
    speaker = Speaker(world, way, ahead=ahead)
    speaker.open()
    speaker.ahead += step
    if not driving_again(world, speaker):
        if step > 0 or world.state.code != "set_back":
            return f"does not drive again: {world.state.reason}"
        world.call("activate")
        if not driving_again(world, speaker):
            return f"does not drive after activate: {world.state.reason}"
    # The commands that the network holds now are stale, whatever the clock was before.
    if stale_moves(world, speaker, dice.uniform(0.6, 8.0)):
        return "what was stale moved it"
    speaker.hold(0.4, 0.3)
    return "" if driving_again(world, speaker) else f"after the cut: {world.state.reason}"


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, more(16), long(400, 1800)])
def test_a_sender_s_clock_may_have_any_offset_and_be_adjusted_at_any_time(count: int) -> None:
    dice, wrong = random.Random(8), Counter[str]()
    for trial in range(count):
        way = FOREIGN[trial % len(FOREIGN)]
        ahead = dice.choice((-1, 1)) * dice.choice((0.0, 0.3, 2.0, 3600.0, 86400.0))
        step = dice.choice((-1, 1)) * dice.choice((0.1, 0.3, 1.0, dice.uniform(0.1, 10.0)))
        if way == "zenoh":  # one that is ahead is unstamped, as Zenoh replaces it
            ahead = -abs(ahead) - 10.0
        error = stepped(dice, way, ahead, step)
        wrong[error] += bool(error)
    print(f"\nclocks set: {count} by 0.1 to 10 s, wrong: {dict(+wrong)}")
    assert not +wrong


@pytest.mark.slow
@pytest.mark.parametrize("way", FOREIGN)
def test_a_sender_whose_clock_is_slewed_forward_keeps_driving_or_drives_again_after_a_zero(
    way: Way,
) -> None:
    world = World()
    world.run(0.3)
    speaker = Speaker(world, way)
    speaker.open()
    speaker.slew(1.08)
    assert drives_on_or_again(world, speaker), world.state.reason
    # A sender that is cut off meanwhile may have to wait until its clock goes evenly again, because
    # a network that holds commands back looks the same.
    for cut in (0.6, 2.0, 5.0):
        assert not stale_moves(world, speaker, cut), cut
        speaker.hold(0.4, 0.5)
    speaker.slew(1.0)
    assert driving_again(world, speaker), world.state.reason


@pytest.mark.slow
@pytest.mark.parametrize("set_back", [0.0, 1.0, 86400.0])
@pytest.mark.parametrize("way", FOREIGN)
def test_a_sender_whose_clock_is_slewed_or_set_back_is_refused_until_activate_and_a_zero(
    way: Way, set_back: float
) -> None:
    """Commands that wait longer and longer in a queue look the same, so no time proves the clock.

    Without a step back, the clock is slewed back by 80 ms per second for 10 s.
    """
    world = World()
    world.run(0.3)
    speaker = Speaker(world, way)
    speaker.open()
    if set_back:
        speaker.ahead -= set_back
    else:
        speaker.slew(0.92)
    speaker.hold(0.4, 10.0)
    speaker.slew(1.0)
    since_ns = world.now_ns
    speaker.hold(0.4, 3.0)
    assert world.state.code == "set_back", world.state.reason
    for cut in (0.6, 2.0):
        assert not stale_moves(world, speaker, cut), cut
        assert not driving_again(world, speaker), cut
    assert world.state.code == "set_back", world.state.reason
    assert world.call("activate").success
    speaker.hold(0.4, 2.0)
    assert world.state.code == "neutral", world.state.reason
    assert not moved(world, since_ns)
    assert driving_again(world, speaker), world.state.reason
    assert not stale_moves(world, speaker, 2.0)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["signed", "rmw", "zenoh"])
def test_a_new_sender_id_drives_after_a_zero_although_the_clock_was_set_back(way: Way) -> None:
    world = World()
    world.run(0.3)
    speaker = Speaker(world, way)
    speaker.open()
    speaker.ahead -= 5.0
    speaker.hold(0.4, 5.0)
    assert world.state.code == "set_back", world.state.reason
    Speaker(world, way, "b", speaker.ahead).open()


@pytest.mark.variations(3)
@pytest.mark.parametrize(
    "ahead",
    [slow(-86400.0), slow(-3600.0), -2.0, slow(-0.3), 0.3, slow(2.0), slow(3600.0), 86400.0],
)
@pytest.mark.parametrize("way", ["signed", "rmw", "header", "zenoh"])
def test_two_senders_never_arm_each_other_whatever_their_clocks(way: Way, ahead: float) -> None:
    world = World()
    world.run(0.3)
    holding, other = Speaker(world, way, "a", ahead), Speaker(world, way, "b", ahead)
    holding.open()
    for verb in ("stop", "clear"):
        holding.hold(0.4, 1.0)
        assert world.call(verb).success
    since_ns = world.now_ns
    for number in range(60):
        holding.send(0.4)
        if number in (5, 6, 7, 30):
            other.send(0.0)
        world.run(0.05)
    assert not moved(world, since_ns)


# h. the neutral-first rule

RATES_HZ = (3.8, 5.0, 10.0, 50.0)
KINDS = ("steady", "stalls", "cuts", "another")


def stuck(dice: random.Random, way: Way, hz: float, kind: str) -> bool:
    """Return whether a sender that sends only speeds moves the robot after a stop and a clear."""
    world = World()
    world.run(0.3)
    speaker = Speaker(world, way)
    speaker.open(hz=10.0)
    speaker.hold(0.5, 2.0, hz)
    for verb in ("stop", "clear"):
        speaker.hold(0.5, dice.uniform(0.5, 2.0), hz)
        assert world.call(verb).success
    since_ns = world.now_ns
    other = Speaker(world, way, "a" if way in ("plain", "bridge") else "b")
    for _ in range(dice.randrange(2, 5)):
        speaker.hold(0.5, dice.uniform(0.5, 2.0), hz)
        if kind == "stalls":
            world.run(dice.uniform(0.1, 0.9))
        elif kind == "cuts":
            for _ in range(max(1, int(dice.uniform(0.3, 10.0) * hz))):
                speaker.message(0.5)  # lost
                world.run(1 / hz)
        elif kind == "another":
            zeros = dice.randrange(1, 6)
            for number in range(round(3 * hz)):
                speaker.send(0.5)
                at = dice.uniform(0.0, 1.0) / hz
                world.run(at)
                if zeros > number:
                    other.send(0.0)
                world.run(1 / hz - at)
    speaker.hold(0.5, 1.5, hz)
    return moved(world, since_ns)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "count"),
    [
        *((kind, 1) for kind in KINDS),
        *(more(kind, 6 if kind == "cuts" else 2) for kind in KINDS),
        *(
            pytest.param(kind, 100, marks=[pytest.mark.soak, pytest.mark.timeout(1800)])
            for kind in KINDS
        ),
    ],
)
def test_a_sender_that_never_returns_to_neutral_never_drives_again(kind: str, count: int) -> None:
    dice, failures = random.Random(9), Counter[str]()
    ways: tuple[Way, ...] = (*STAMPED, "plain", "bridge")
    for trial in range(count * len(RATES_HZ)):
        way, hz = ways[trial % len(ways)], RATES_HZ[trial % len(RATES_HZ)]
        failures[f"{way} at {hz:g} Hz"] += stuck(dice, way, hz, kind)
    print(
        f"\n{kind}: {failures.total()} of {count * len(RATES_HZ)} moved the robot {dict(+failures)}"
    )
    assert not +failures


@pytest.mark.slow
@pytest.mark.variations(3)
@pytest.mark.parametrize("way", SHARED)
@pytest.mark.parametrize("count", [4, more(12)])
def test_zeros_of_another_sender_do_not_arm_a_stalled_sender_that_looks_the_same(
    count: int, way: Way
) -> None:
    dice, failures = random.Random(10), 0
    for trial in range(count):
        world = World()
        world.run(0.3)
        speaker, hz = Speaker(world, way), RATES_HZ[trial % 4]
        speaker.open(hz=10.0)
        speaker.hold(0.5, 2.0, hz)
        for verb in ("stop", "clear"):
            speaker.hold(0.5, 1.0, hz)
            assert world.call(verb).success
        since_ns = world.now_ns
        speaker.hold(0.5, 0.5, hz)
        stall = dice.uniform(0.3, 0.9)
        world.run(stall * 0.9)
        speaker.send(0.0)
        world.run(stall * 0.1)
        speaker.hold(0.5, 1.5, hz)
        failures += moved(world, since_ns)
    assert failures == 0
