"""Mutants no test can notice: how they are printed (without the line), and why."""

# ruff: noqa: E501 - as they are printed

from __future__ import annotations

EQUIVALENT: dict[str, str] = {
    "acsard/mcu/codec.py Codec.decode: 'index, sign = self._by_letter[letter[0]]' -> 'index, sign = self._by_letter[letter[-1]]'": "the first of one byte is its last",
    "acsard/drive/sanity.py Sanity._objection: 'if abs(now - then) > most:' -> 'if abs(then - now) > most:'": "the size of a difference",
    "acsard/drive/sanity.py _Wheel.signs: 'apart = abs(speed - expected) > SLACK + 0.3 * most' -> 'apart = abs(expected - speed) > SLACK + 0.3 * most'": "the size of a difference",
    "acsard/drive/limits.py _approach: 'most = min(most, abs(slope) + step, _flattenable(abs(target - speed), step, dt))' -> 'most = min(most, abs(slope) + step, _flattenable(abs(speed - target), step, dt))'": "the size of a difference",
    "acsard/drive/sanity.py _Wheel.signs: ' moving and speed * expected < 0 and (abs(speed) > 0.3 * siz' -> ' moving and speed * expected <= 0 and (abs(speed) > 0.3 * siz'": "neither is 0: `moving` has |expected| > 2, the term after it |speed| > 0.6",
    "acsard/drive/sanity.py _Wheel.signs: 'moving and speed * expected < 0 and (abs(speed) > 0.3 * size)' -> 'moving and speed * expected < 1 and (abs(speed) > 0.3 * size)'": "|expected| > 2 and |speed| > 0.6: their product is not between 0 and 1",
    "acsard/guard.py Guard._read: 'token = line[start:start + 7]' -> 'token = line[start:start + 8]'": "the digits are taken from columns 2 to 6 of the token",
    "acsard/guard.py Guard.check: 'if self.trip or wheels is None:' -> 'if self.trip:'": "without wheels there is a trip; the rest is for the type checker",
    "acsard/guard.py Guard._read: 'found.append(int(digits) if token[1] == 112 else -int(digits))' -> 'found.append(int(digits) if token[1] != 112 else -int(digits))'": "all signs turned: the guard asks only for sizes and for changes of sign",
    "acsard/drive/limits.py Limiter._within_speed: 'if abs(angular) * scale > self._angular.speed:' -> 'if abs(angular) * scale >= self._angular.speed:'": "at the limit itself both branches give the same scale",
    "acsard/drive/neutral.py Sender.__init__: 'self.came_ns = 0' -> 'self.came_ns = 1'": "set by the first command, before it is read",
    "acsard/drive/neutral.py Sender.__init__: 'self.came_ns = 0' -> 'self.came_ns = -1'": "set by the first command, before it is read",
    "acsard/drive/odometry.py Odometry.fold: 'if dt > 0.0:' -> 'if dt > -1.0:'": "no dt is negative, and a step of none adds nothing",
    "acsard/robot.py Robot.__init__: 'self._before = (self._limiter.state, 0)' -> 'self._before = (self._limiter.state, 1)'": "no robot starts with a link, and without one each step sets it",
    "acsard/robot.py Robot.__init__: 'self._before = (self._limiter.state, 0)' -> 'self._before = (self._limiter.state, -1)'": "no robot starts with a link, and without one each step sets it",
    "acsard/robot.py Robot._drive: \"if self.session.link != 'up' or since > UNHEARD_S:\" -> 'if since > UNHEARD_S:'": "without a link `_fold` has cut the limiter, and rest coasts to rest",
    "acsard/drive/sanity.py _Wheel.forget: 'self.seen = 0.0' -> 'self.seen = -1.0'": "one line more of evidence, for a wheel first seen at just this speed",
    "acsard/mcu/codec.py Codec.decode: \"wheel[index] = speed * sign if direction == b'p' else -speed * sign\" -> \"wheel[index] = speed / sign if direction == b'p' else -speed * sign\"": "the sign is 1 or -1",
    "acsard/drive/limits.py _approach: 'most = axis.acceleration if abs(target) > abs(speed) else axis.deceleration' -> 'most = axis.acceleration if abs(target) >= abs(speed) else axis.deceleration'": "as fast as its target it is there: the change is none",
    "acsard/drive/sanity.py Sanity.forget: 'self._last, self._since, self._impossible = (None, 0.0, 0)' -> 'self._last, self._since, self._impossible = (None, 1.0, 0)'": "counts only against a last line, and there is none",
    "acsard/guard.py Guard._commanded: 'return abs(outputs.now.mono_ns - arrived) <= timeout' -> 'return abs(arrived - outputs.now.mono_ns) <= timeout'": "the size of a difference",
    "acsard/mcu/codec.py Codec.decode: \"direction == b'p' else -speed * sign\" -> \"direction == b'p' else -speed / sign\"": "the sign is 1 or -1",
    "acsard/drive/limits.py _approach: 'slope = slope if slope * wanted > 0 else 0.0' -> 'slope = slope if slope * wanted >= 0 else 0.0'": "where the product is 0 the slope is",
    "acsard/drive/sanity.py _Wheel.signs: 'expected < 0 and (abs(speed) > 0.3 * size), fast and (not sl' -> 'expected < 0 and (abs(speed) >= 0.3 * size), fast and (not sl'": "the model nears its command and never quite meets it: nor does a line this bound",
    "acsard/drive/neutral.py Sender.__init__: 'self.came_ns = 0' -> 'pass'": "set by the first command, before it is read",
    "acsard/robot.py Robot._drive: 'elif self._life.mode is Mode.DRIVING and twist is not None:' -> 'elif self._life.mode is Mode.DRIVING:'": "without a twist NO_COMMAND has just ended driving; the rest is for the type checker",
    "acsard/drive/sanity.py _Wheel.forget: 'self.seen = 0.0' -> 'self.seen = 1.0'": "one line more of evidence, for a wheel first seen at just this speed",
    "acsard/drive/arbiter.py Arbiter.__init__: 'self._since_ns = 0' -> 'self._since_ns = -1'": "no command arrives before 0",
    "acsard/drive/freshness.py _Clock.__init__: 'self._least = self._most = self._since_ns = 0' -> 'pass'": "set as the proof begins, before they are read",
    "acsard/drive/freshness.py _Clock.__init__: 'self._least = self._most = self._since_ns = 0' -> 'self._least = self._most = self._since_ns = 1'": "set as the proof begins, before they are read",
    "acsard/drive/freshness.py _Clock.__init__: 'self._least = self._most = self._since_ns = 0' -> 'self._least = self._most = self._since_ns = -1'": "set as the proof begins, before they are read",
    "acsard/drive/neutral.py Sender.__init__: 'self.twist = REST' -> 'pass'": "set by the first command, before it is read",
}
