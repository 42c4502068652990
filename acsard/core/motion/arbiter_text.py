"""Sentences about the arbiter's decisions, for `state`, `diagnostics` and the log."""

from __future__ import annotations

from acsard.core.formatting import lasting
from acsard.core.motion.arbiter import MAX_SENDERS, Choice
from acsard.core.values import Wait

REFUSED = {
    "unknown_source": "not one of commands.sources",
    "not_finite": "NaN or infinity",
    "too_many_senders": f"{MAX_SENDERS} other senders of this source are live",
    "unproven": "a sender that is new here counts once its delays have proved steady; this is "
    "not an error",
    "stale": "older than the source's timeout allows, or than a command that was accepted: the "
    "network held it up, or the sender's clock was set",
}
"""The words for each reason to refuse a command."""


ROS_NEVER = (
    " (`ros2 topic pub` of a speed sends none: "
    '"After a clear" in deploy/ros2/README.md has tools that do)'
)


def chosen(choice: Choice) -> str:
    """Return which source the robot follows, or why it follows none."""
    if choice.wait.what == "command":
        return "waiting for a command: no source has sent one within its timeout"
    return waiting(choice.wait) or f"commanded by {choice.source}"


def waiting(wait: Wait) -> str:
    """Return the sentence for what a source waits for, "" if it waits for nothing."""
    match wait.what:
        case "nothing":
            return ""
        case "command":
            return "a command"
        case "proof":
            return (
                f"{wait.source} is new here: it drives once its delays have been steady for "
                f"{wait.seconds:g} s"
            )
        case "late":
            return (
                f"commands of {wait.source} come too late, by more than {wait.seconds:g} s: the "
                "network holds them up, or the sender's clock was set; if this goes on, look at "
                "the network, then restart the sender"
            )
        case "neutral":
            lasts = f"; it has sent speeds for over {lasting(wait.lasts)}" if wait.lasts else ""
            alone = f", and no speed for {wait.seconds:g} s after it," if wait.shared else ""
            return (
                f"send a zero first: {wait.source} must send a zero{alone} before it can drive"
                f"{lasts}{ROS_NEVER if wait.ros else ''}"
            )
        case "zeros":
            kept = f"; {wait.kept} sends speeds and is kept waiting" if wait.kept else ""
            zeros = f"nothing but zeros for over {lasting(wait.lasts)}"
            return f"held by {wait.source}, which sends {zeros}{kept}"
        case "higher":
            return f"{wait.source} has the higher priority: until it is silent"
        case "equal":
            return f"{wait.source}, of the same priority, came first: until it is silent"
        case "senders":
            return f"{wait.senders} more of its senders: the first until it is silent"
