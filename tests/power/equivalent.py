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
    "acsard/calibration/comparison.py Comparison.rolls: 'rolled = np.abs(self.rolled(begin, end)).sum(axis=0)' -> 'rolled = np.abs(self.rolled(end, begin)).sum(axis=0)'": "only the size of the angle counts",
    "acsard/calibration/comparison.py Comparison.__init__: 'last = float(parts[-1][-1])' -> 'last = float(parts[-1][1])'": "no step spans two runs, so the offset between them is never seen",
    "acsard/calibration/log.py _sides: ' if len(v) else 0.0 for v in (a - b, np.maximum(np.abs(a), np.abs(b))))' -> ' if len(v) else 0.0 for v in (b - a, np.maximum(np.abs(a), np.abs(b))))'": "only the size of the difference counts",
    "acsard/calibration/hypotheses.py _facts: 'if alone > ALONE * rolled:' -> 'if alone >= ALONE * rolled:'": "two measured angles are never equal",
    "acsard/calibration/series.py by_turns: 'moves = speed > MOVING * usual' -> 'moves = speed >= MOVING * usual'": "two measured speeds are never equal",
    "acsard/calibration/log.py _sides: 'elif float(low @ high) < 0.0:' -> 'elif float(low @ high) < -1.0:'": "wheels of a whole log that turn against each other have a product far below it",
    "acsard/calibration/comparison.py Match.cost: 'return float(cost(self.raw, self.track if self.given else 0.0, self.delay))' -> 'return float(cost(self.raw, self.track if self.given else -1.0, self.delay))'": "either is the track of no possible robot",
    "acsard/calibration/fit.py _tracked: 'moved[:, TRACK] += (OTHER_TRACK, -OTHER_TRACK)' -> 'moved[:, TRACK] -= (OTHER_TRACK, -OTHER_TRACK)'": "both are tried, in any order",
    "acsard/calibration/fit.py Piece.residuals: 'off = aligned(run.place, model + lever).off' -> 'off = aligned(model + lever, run.place).off'": "a fit squares its residuals, whatever their sign and axes",
    "acsard/calibration/series.py by_turns: 'nt, CYCLES, period) for v in (values - smooth, size))' -> 'nt, CYCLES, period) for v in (smooth - values, size))'": "only the size of the difference counts",
    "acsard/calibration/fit.py centered: 'off = values - weight @ values / weight.sum()' -> 'off = values - values @ weight / weight.sum()'": "the product of two vectors has no order",
    "acsard/calibration/comparison.py Comparison.judged: 'share = np.clip(off, 0.0, moved)[~bad].sum() / max(TINY, float(moved[~bad].sum()))' -> 'share = np.clip(0.0, off, moved)[~bad].sum() / max(TINY, float(moved[~bad].sum()))'": "the middle of three numbers is the same in any order",
    "acsard/calibration/fit.py Problem.__init__: \"free += [POSE_DELAY] if {'positions', 'headings'} & set(self.sensors) else []\" -> 'free += [POSE_DELAY]'": "a parameter that no sensor shows stays as it was, and only costs time",
    "acsard/calibration/fit.py Problem.__init__: \"free += [AHEAD, ASIDE] if 'positions' in self.sensors else []\" -> 'free += [AHEAD, ASIDE]'": "a parameter that no sensor shows stays as it was, and only costs time",
    "acsard/calibration/guide.py _doubts: \"angle = math.degrees(_line_angle(found['front'], found['rear'], wheelbase))\" -> \"angle = math.degrees(_line_angle(found['rear'], found['front'], wheelbase))\"": "only the size of the angle counts",
    "acsard/calibration/series.py by_chance: 'factor = np.where(np.abs(factor) > 1, 1 / np.where(factor, factor, 1), factor)' -> 'factor = np.where(np.abs(factor) >= 1, 1 / np.where(factor, factor, 1), factor)'": "the inverse of 1 is 1",
    "acsard/calibration/series.py : 'CYCLE_ROWS, CYCLES, MIN_BLOCKS = (range(2, 8), 6, 3)' -> 'CYCLE_ROWS, CYCLES, MIN_BLOCKS = (range(1, 8), 6, 3)'": "a cycle of one row never differs from its mean",
    "acsard/calibration/result.py _too_good: 'if errors and errors.new < least:' -> 'if errors and errors.new <= least:'": "a measured error is never equal to the bound",
    "acsard/calibration/comparison.py Places.match: '_, _, delay = best(np.array([track]), delay + DELAYS_S)' -> '_, _, delay = best(np.array([track]), delay - DELAYS_S)'": "the grid of delays is symmetric",
}
