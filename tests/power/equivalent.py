"""Lists mutants that no test can notice, and the reason for each.

A mutant's key is its printed description without the line number.
"""

# ruff: noqa: E501 - as they are printed

from __future__ import annotations

EQUIVALENT: dict[str, str] = {
    "acsard/core/motion/limits.py Limiter._within_speed: 'if abs(angular) * scale > self._angular.speed:' -> 'if abs(angular) * scale >= self._angular.speed:'": "at the limit itself both branches give the same scale",
    "acsard/core/motion/neutral.py Sender.__init__: 'self.came_ns = 0' -> 'self.came_ns = 1'": "set by the first command, before it is read",
    "acsard/core/motion/neutral.py Sender.__init__: 'self.came_ns = 0' -> 'self.came_ns = -1'": "set by the first command, before it is read",
    "acsard/core/motion/limits.py _approach: 'most = axis.acceleration if abs(target) > abs(speed) else axis.deceleration' -> 'most = axis.acceleration if abs(target) >= abs(speed) else axis.deceleration'": "as fast as its target it is there: the change is none",
    "acsard/core/motion/limits.py _approach: 'slope = slope if slope * wanted > 0 else 0.0' -> 'slope = slope if slope * wanted >= 0 else 0.0'": "where the product is 0 the slope is",
    "acsard/core/motion/neutral.py Sender.__init__: 'self.came_ns = 0' -> 'pass'": "set by the first command, before it is read",
    "acsard/core/motion/arbiter.py Arbiter.__init__: 'self._since_ns = 0' -> 'self._since_ns = -1'": "no command arrives before 0",
    "acsard/core/motion/neutral.py Sender.__init__: 'self.twist = REST' -> 'pass'": "set by the first command, before it is read",
    "acsard/core/motion/neutral.py Sender.__init__: \"self.name = ''\" -> 'pass'": "set by the first command, before it is read",
    "acsard/core/motion/neutral.py Sender.__init__: 'self.ros = False' -> 'self.ros = True'": "set by the first command, before it is read",
    "acsard/core/motion/neutral.py Sender.__init__: 'self.shared = False' -> 'self.shared = True'": "set by the first command, before it is read",
    "acsard/core/motion/neutral.py Sender.__init__: 'self.noticed_ns = 0' -> 'self.noticed_ns = 1'": "set by the first command, before it is read",
    "acsard/core/motion/neutral.py Sender.__init__: 'self.noticed_ns = 0' -> 'self.noticed_ns = -1'": "set by the first command, before it is read",
    "acsard/core/motion/neutral.py Sender.__init__: 'self.ros = False' -> 'pass'": "set by the first command, before it is read",
    "acsard/core/motion/neutral.py Sender.__init__: 'self.shared = False' -> 'pass'": "set by the first command, before it is read",
    "acsard/core/motion/neutral.py Sender.__init__: 'self.noticed_ns = 0' -> 'pass'": "set by the first command, before it is read",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self.forgiven_ns = 0' -> 'self.forgiven_ns = 1'": "set by each `set`, before it is read",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self.forgiven_ns = 0' -> 'self.forgiven_ns = -1'": "set by each `set`, before it is read",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self.forgiven_ns = 0' -> 'pass'": "set by each `set`, before it is read",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self._least = 0' -> 'pass'": "set when the first proof ends, before it is read",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self._least = 0' -> 'self._least = 1'": "set when the first proof ends, before it is read",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self._least = 0' -> 'self._least = -1'": "set when the first proof ends, before it is read",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self._shown = 0' -> 'pass'": "set when the first proof ends, before it is read",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self._shown = 0' -> 'self._shown = 1'": "set when the first proof ends, before it is read",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self._shown = 0' -> 'self._shown = -1'": "set when the first proof ends, before it is read",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self._delay = 0' -> 'pass'": "set by the first command, before it is read",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self._delay = 0' -> 'self._delay = 1'": "set by the first command, before it is read",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self._delay = 0' -> 'self._delay = -1'": "set by the first command, before it is read",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self._stamp_ns = 0' -> 'self._stamp_ns = 1'": "read with the first command only beside its silence, which is 0",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self._stamp_ns = 0' -> 'self._stamp_ns = -1'": "read with the first command only beside its silence, which is 0",
    "acsard/core/guard.py Memory: 'ramp_ns: int = 0' -> 'ramp_ns: int = -1'": "a guard without a last line takes the ramps of its limits",
    "acsard/core/guard.py Memory: 'stop_ramp_ns: int = 0' -> 'stop_ramp_ns: int = -1'": "a guard without a last line takes the ramps of its limits",
    "acsard/core/link/codec.py Codec.decode: 'wheel[index] = speed * sign' -> 'wheel[index] = speed / sign'": "the sign is 1 or -1",
    "acsard/core/link/codec.py Codec.wheels: 'wheel[index] = motor * sign' -> 'wheel[index] = motor / sign'": "the sign is 1 or -1",
    "acsard/core/guard.py _wheels: 'a, b, c, d = [int(word[1:3] + word[4:]) if word[0] == 112 else -int(word[1:3] + wo' -> 'a, b, c, d = [int(word[1:3] + word[4:]) if word[0] != 112 else -int(word[1:3] + wo'": "all signs turned: the guard asks only for sizes and for changes of sign",
    "acsard/core/guard.py Guard._objection: \"return ''\" -> 'pass'": "None is as false as an empty text",
    "acsard/core/guard.py Guard._objection: 'grows = wheels != before and any((abs(new) > abs(old) or ne' -> 'grows = any((abs(new) > abs(old) or ne'": "equal wheels do not grow: the comparison saves time",
    "acsard/core/motion/sanity.py Sanity.__init__: 'self._since = 0.0' -> 'self._since = 1.0'": "counts only against a last line, and there is none",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self._early = 0' -> 'self._early = -1'": "`max(0, ...)` takes it for 0",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self._paused = False' -> 'pass'": "set when the first proof ends, before it is read",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self._paused = False' -> 'self._paused = True'": "set when the first proof ends, before it is read",
    "acsard/core/motion/freshness.py _Clock.judge: 'number = -1 if command.sequence is None else command.sequence' -> 'number = -2 if command.sequence is None else command.sequence'": "no sender has a number below 0",
    "acsard/core/motion/freshness.py _Clock.__init__: 'self._number = -1' -> 'self._number = -2'": "no sender has a number below 0",
    "acsard/core/motion/freshness.py _Proof._constant: 'pairs = [min(pair) for pair in zip(minima[::2], minima[1::2], strict=True)]' -> 'pairs = [min(pair) for pair in zip(minima[1::2], minima[::2], strict=True)]'": "the minimum of a pair is the same in either order",
}
