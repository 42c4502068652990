"""Lists mutants that no test can notice, and the reason for each.

A mutant's key is its printed description without the line number.
"""

# ruff: noqa: E501 - as they are printed

from __future__ import annotations

EQUIVALENT: dict[str, str] = {
    "acsard/core/motion/limits.py _approach: 'slope = slope if slope * wanted > 0 else 0.0' -> 'slope = slope if slope * wanted >= 0 else 0.0'": "where the product is 0 the slope is",
    "acsard/core/guard.py Memory: 'ramp_ns: Ns = 0' -> 'ramp_ns: Ns = -1'": "a guard without a last line takes the ramps of its limits",
    "acsard/core/guard.py Memory: 'stop_ramp_ns: Ns = 0' -> 'stop_ramp_ns: Ns = -1'": "a guard without a last line takes the ramps of its limits",
    "acsard/core/link/codec.py Codec.wheels: 'wheel[index] = motor * sign' -> 'wheel[index] = motor / sign'": "the sign is 1 or -1",
    "acsard/machine/versions.py same: 'return files[0] == files[1] and all((cmp(one / name, other / name, shallow=False) for name in files[0]))' -> 'return files[0] == files[1] and all((cmp(other / name, one / name, shallow=False) for name in files[0]))'": "the comparison of two files is symmetric",
    "acsard/machine/upgrade.py Look.missed_fraction: \"return counters.get('missed_periods', 0) / max(1, counters.get('lines_sent', 0))\" -> \"return counters.get('missed_periods', -1) / max(1, counters.get('lines_sent', 0))\"": "it is compared with a positive bound",
    "acsard/machine/upgrade.py Look.missed_fraction: \"return counters.get('missed_periods', 0) / max(1, counters.get('lines_sent', 0))\" -> \"return counters.get('missed_periods', 0) / max(2, counters.get('lines_sent', 0))\"": "a daemon that answers has sent more than two lines",
    "acsard/machine/certificates.py : 'if TYPE_CHECKING: from acsard.machine.authority import Authority' -> 'pass'": "only a type checker reads it",
    "acsard/machine/versions.py _fill: \"_copy_file(reference(deploy), ours / 'deploy' / 'acsard.toml')\" -> \"_copy_file(reference(deploy), 'acsard.toml' / (ours / 'deploy'))\"": "an absolute path replaces what stands before it, and a copy into a directory keeps the name",
    "acsard/machine/local_findings.py slowdowns: 'stolen_ns = max((new - old for old, new in pairs), default=0)' -> 'stolen_ns = max((new - old for old, new in pairs), default=1)'": "one nanosecond is below the bound of any measurement",
    "acsard/machine/local_findings.py slowdowns: 'if stolen_ns > MAX_STEAL_FRACTION * within_ns:' -> 'if stolen_ns >= MAX_STEAL_FRACTION * within_ns:'": "the kernel counts in ticks, and the time between two readings is none",
    "acsard/checkup/board.py Board.listen: 'if self.now_s - self._listened_s > BEAT_NS / NS_PER_S:' -> 'if self.now_s - self._listened_s >= BEAT_NS / NS_PER_S:'": "times that are measured in ns are never equal",
    "acsard/checkup/procedure.py _Watched.check_operator: 'if stalled_s > SHORT_STALL_S:' -> 'if stalled_s >= SHORT_STALL_S:'": "times that are measured in ns are never equal",
    "acsard/checkup/watchdog.py measured: 'if ran_on_s < 0.95 * trial.silent_s:' -> 'if ran_on_s <= 0.95 * trial.silent_s:'": "two measured times are never equal",
    "acsard/checkup/motor_channels.py run_up: 'eans[m]) / motion.SPEED - 1) < 0.4 * FAIL_TOLERANCE]' -> 'eans[m]) / motion.SPEED - 1) <= 0.4 * FAIL_TOLERANCE]'": "a mean of measured speeds is never equal to the bound",
    "acsard/checkup/motor_channels.py Channel.kind: 'if self.error > WARN_TOLERANCE + self.unsure:' -> 'if self.error >= WARN_TOLERANCE + self.unsure:'": "a mean of measured speeds is never equal to the bound",
    "acsard/checkup/watchdog.py run: 'board.listen(min(left_s, board.period_s) if line else left_s)' -> 'board.listen(min(left_s, board.period_s))'": "several waits take as long as one",
    "acsard/checkup/outcomes.py TimingFinding: 'margin_s: float = 0.0' -> 'margin_s: float = -1.0'": "the larger of it and a positive time counts",
    "acsard/checkup/board.py Board.__init__: 'self._unanswered_s = 0.0' -> 'self._unanswered_s = 1.0'": "`open` sets it to 0",
    "acsard/checkup/board.py Board._reply: 'return None' -> 'pass'": "a function without a result returns None",
    "acsard/client/follower.py Watch._decode: 'return None' -> 'pass'": "a function without a result returns None",
    "acsard/calibration/fit.py Piece.residuals: 'off = run.yaw - np.interp(at, self.t, heading)' -> 'off = np.interp(at, self.t, heading) - run.yaw'": "a fit squares its residuals, whatever their sign",
    "acsard/calibration/hypotheses.py Turns.match: 'weight = known / np.maximum(off, LEAST_TURN)' -> 'weight = known / np.maximum(LEAST_TURN, off)'": "the larger of two is the same in any order",
    "acsard/calibration/hypotheses.py Comparison.rolls: 'rolled = np.abs(self.rolled(begin, end)).sum(axis=0)' -> 'rolled = np.abs(self.rolled(end, begin)).sum(axis=0)'": "only the size of the angle counts",
    "acsard/calibration/hypotheses.py Comparison.__init__: 'last = float(parts[-1][-1])' -> 'last = float(parts[-1][1])'": "no step spans two runs, so the offset between them is never seen",
    "acsard/calibration/hypotheses.py Places.match: 'moved = np.abs(self.place - (np.add.reduceat(self.place, self.first) / np.bincount(self.part))[self.part])' -> 'moved = np.abs((np.add.reduceat(self.place, self.first) / np.bincount(self.part))[self.part] - self.place)'": "only the size of the way counts",
    "acsard/calibration/log.py _sides: ' if len(v) else 0.0 for v in (a - b, np.maximum(np.abs(a), np.abs(b))))' -> ' if len(v) else 0.0 for v in (b - a, np.maximum(np.abs(a), np.abs(b))))'": "only the size of the difference counts",
    "acsard/calibration/log.py Run.rests: 'rolled = [np.abs(np.interp(end, self.t, side) - np.interp(begin, self.t, side)) for side in (self.left, self.right)]' -> 'rolled = [np.abs(np.interp(begin, self.t, side) - np.interp(end, self.t, side)) for side in (self.left, self.right)]'": "only the size of the angle counts",
    "acsard/calibration/guide.py _measured: 'std = math.hypot(TAPE_STD_M, SKID_LENGTH * metres)' -> 'std = math.hypot(SKID_LENGTH * metres, TAPE_STD_M)'": "the root of a sum of squares is the same in any order",
    "acsard/cli/recording.py main_replay: 'if head is None or not comparison.steps:' -> 'if not comparison.steps:'": "without a head there is no step",
    "acsard/client/connection.py Connection.reply: 'ce(name) or time.monotonic() > end_s:' -> 'ce(name) or time.monotonic() >= end_s:'": "times that are measured in ns are never equal",
    "acsard/client/connection.py _CommandSpacing.__init__: '_s = (threading.RLock(), 0.0, 0.0)' -> '_s = (threading.RLock(), 0.0, -1.0)'": "the monotonic clock is above both",
    "acsard/client/ride.py Ride.due: 'if now - self._opened >= OPEN_TIMEOUT_S:' -> 'if now - self._opened > OPEN_TIMEOUT_S:'": "times that are measured in ns are never equal",
    "acsard/foxglove/bridge.py Bridge.__init__: 'self._retry_s = 0.0' -> 'self._retry_s = 1.0'": "the monotonic clock is above both",
    "acsard/foxglove/relay.py EventDeduplicator.of: 'known, previous = (0, [])' -> 'known, previous = (-1, [])'": "a total is never below the number of its events",
    "acsard/recording/file.py encode_steps: '), replace(heard, received=()) if reads else heard, driven, line, sent, trip, la' -> '), replace(heard, received=()), driven, line, sent, trip, la'": "without reads it replaces an empty tuple by an empty tuple",
    "acsard/recording/recorder.py Recorder._watch_disk: 'elif self._waited_ns > SLOW_DISK_NS:' -> 'elif self._waited_ns >= SLOW_DISK_NS:'": "times that are measured in ns are never equal",
    "acsard/recording/recorder.py _Writer.__init__: 'self._number = 0' -> 'pass'": "`_begin` sets it before the first step",
    "acsard/recording/replay.py Playback.failed_step: 'if failure.now is None or failure.heard is None:' -> 'if failure.now is None and failure.heard is None:'": "a failure has both or neither",
    "acsard/recording/state.py _Written: 'layout: int = 0' -> 'layout: int = 1'": "`LAYOUT` is another number",
    "acsard/web/connections.py Connections.accept: 'await asyncio.sleep(0)' -> 'await asyncio.sleep(-1)'": "asyncio takes every number below 0 as 0",
    "acsard/web/followed_robot.py FollowedRobot.__init__: 'self._about_due_s, self._is_leaving = (0.0, False)' -> 'self._about_due_s, self._is_leaving = (-1.0, False)'": "the clock is above both",
    "acsard/web/socket_sender.py Following.__init__: 'self.due = 0.0' -> 'self.due = -1.0'": "the clock of the event loop is above both",
    "acsard/client/connection.py Connection._present_causes: '._own_causes or (cause.age or 0.0) >= waited_s]' -> '._own_causes or (cause.age or -1.0) >= waited_s]'": "a query takes longer than 0 s",
    "acsard/client/ride.py Ride.due: 'if now - self._wished > STALE_S:' -> 'if now - self._wished >= STALE_S:'": "times that are measured in ns are never equal",
    "acsard/client/driving.py _course.steps: 'elif now - nearer > COURSE_TIMEOUT_S:' -> 'elif now - nearer >= COURSE_TIMEOUT_S:'": "times that are measured in ns are never equal",
    "acsard/client/driving.py Driver.require: 'if state is None or ride.ended != ride.objection o' -> 'if ride.ended != ride.objection o'": "without a state there is no objection, which differs from each reason",
}
