"""What the arbiter decides, in words for people: `state`, `diagnostics`, the log."""

from __future__ import annotations

from acsard.drive.arbiter import MAX_SENDERS, Choice
from acsard.values import Wait

REFUSED = {
    "unknown_source": "not one of commands.sources",
    "not_finite": "NaN or infinity",
    "crowded": f"{MAX_SENDERS} other senders of this source are live",
    "unproven": "of a sender that is new here: no error, it counts once its delays are steady",
    "stale": "held up on the way for longer than the source's timeout, or the sender's clock was "
    "set: counts once its delays are steady",
}
"""What a command is refused for."""


ROS_NEVER = (
    ' (`ros2 topic pub` of a speed never does that: "Drive" in deploy/ros2/README.md has what does)'
)


def chosen(choice: Choice) -> str:
    """Whose command is followed, or why nobody's is."""
    if choice.wait.what == "command":
        return "waiting for a command: no source has sent one within its timeout"
    return waiting(choice.wait) or f"commanded by {choice.source}"


def waiting(wait: Wait) -> str:
    """What a source waits for; "" for nothing."""
    match wait.what:
        case "nothing":
            return ""
        case "command":
            return "a command"
        case "proof":
            return (
                f"{wait.source} may be late: its delays must be steady for {wait.seconds:g} s if "
                "its clock is new here, for 1.5 s if that was set"
            )
        case "neutral":
            lasts = f", and sends speeds for over {_long(wait.lasts)}" if wait.lasts else ""
            return (
                f"neutral first: {wait.source} must send a zero, or pause for "
                f"{wait.seconds:g} s, before it can drive{lasts}{ROS_NEVER if wait.ros else ''}"
            )
        case "zeros":
            kept = f"; {wait.kept} sends speeds and is kept waiting" if wait.kept else ""
            zeros = f"nothing but zeros for over {_long(wait.lasts)}"
            return f"held by {wait.source}, which sends {zeros}{kept}"
        case "higher":
            return f"{wait.source} has the higher priority: until it is silent"
        case "equal":
            return f"{wait.source}, of the same priority, came first: until it is silent"
        case "senders":
            return f"{wait.senders} more of its senders: the first until it is silent"


def _long(seconds: float) -> str:
    """A time to the unit that people would say it in."""
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= size:
            return f"{seconds / size:g} {unit}"
    return f"{seconds:g} s"
