"""Describes the result of a replay in lines of text, for `acsard recording`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from acsard.core.codes import reason
from acsard.core.config.live import flat
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.config.validation import show
from acsard.core.formatting import listed, many, printable
from acsard.core.values import NS_PER_S, Event, Ns
from acsard.recording.file import Damage, Unread
from acsard.recording.recorded_steps import US_PER_S, RecordedOutputs
from acsard.recording.replay import Comparison, Difference, Gap, max_wheel_speed

# Settings that affect the speeds in the lines to the board.
LINE_SETTINGS = ("limits.", "drive.", "mcu.wheels.")

MAX_KEYS = 8  # changed settings in a line of text


def verdict(comparison: Comparison) -> str:
    """Return a line of text: how many outputs of each kind are equal."""
    c = comparison
    first, *rest = [
        f"{c.equal[kind]:,} of {total:,}".replace(",", " ") + f" {kind}"
        for kind, total in c.all.items()
    ]
    rounded = c.same and not c.exact
    bits = " (poses agree to 1 um, but not to the last bit)" if rounded else ""
    return f"{first} are the same, {', '.join(rest)}{bits}"


def explain_verdict(other: bool) -> str:
    """Return a paragraph on the numbers of `verdict()`, maybe with an `other` configuration."""
    computed = "with the other configuration" if other else "with this version of acsard"
    return (
        "(The replay computes new outputs "
        f"{computed} from the recorded inputs, and compares them with the recorded outputs: each "
        "line to the board; each odometry pose, rounded to 1 um; the mode, reason, link and source "
        "of each step; and each event with its text and its client.)"
    )


def describe_missing(gaps: Sequence[Gap], damage: Sequence[Damage | Unread], how: str) -> list[str]:
    """Return lines about the steps that a recording lacks, the first of which begin with `how`."""
    lines = []
    if gaps:
        steps = many(sum(gap.steps for gap in gaps), "step is missing", "steps are missing")
        seconds = sum(gap.end.mono_ns - gap.begin.mono_ns for gap in gaps) / NS_PER_S
        lines.append(f"{how}: {seconds:.1f} s in {many(len(gaps), 'place')}, where {steps}")
    return lines + [str(place) for place in damage]


def describe_difference(difference: Difference, began_ns: Ns) -> list[str]:
    """Return lines with the recorded and the replayed outputs of a step."""
    what = ", ".join(difference.what)
    return [
        f"the first difference is in step {difference.number}, "
        f"{_seconds(difference, began_ns):.3f} s after the "
        f"beginning of the recording: {what}",
        *_side("recorded", difference.recorded, difference.what),
        *_side("replayed", difference.replayed, difference.what),
        *([f"            {reason(difference.trip).text}"] if difference.trip else []),
    ]


def _seconds(difference: Difference, began_ns: Ns) -> float:
    return (difference.at.mono_ns - began_ns) / NS_PER_S


def _side(name: str, outputs: RecordedOutputs, what: Sequence[str]) -> list[str]:
    status = outputs.status
    words = status.mode, status.code, status.reason, status.link, status.source
    mode, code, why, link, source = map(printable, words)
    line = (
        "no line"
        if outputs.line is None
        else printable(outputs.line.decode(errors="replace").strip())
    )
    poses = [[f"{value / US_PER_S:.6f}" for value in pose] for pose in outputs.poses]
    return [
        f"  {name:8}  {line}",
        f"            mode {mode} ({code}: {why}), link {link}, source {source or 'none'}",
        *[f"            pose x {x} y {y} yaw {yaw}" for x, y, yaw in poses],
        *(["            no pose"] if "pose" in what and not poses else []),
        *[f"            event {_event(event)}" for event in outputs.events],
    ]


def _event(event: Event) -> str:
    by = f" (by {event.by})" if event.by else ""
    return printable(f"{event.name}: {event.text}{by}")


def explain_settings(
    recorded: Config, other: Config, comparison: Comparison, began_ns: Ns
) -> list[str]:
    """Return lines about the effects of changed settings.

    They name the settings, the first line to the board that differs, and the first fault that only
    the replayed robot has.
    """
    before, after = (dict(flat(effective(config))) for config in (recorded, other))
    keys = [key for key in before | after if before.get(key) != after.get(key)]
    changes = [f"{key} was {_value(key, before)}, is {_value(key, after)}" for key in keys]
    rows = [f"changed settings: {listed(changes, MAX_KEYS, '; ') or 'none'}"]
    first, fault = comparison.first_by_output.get("line"), comparison.fault
    if first is not None:
        if first is not comparison.first:
            rows.append(
                f"the first line to the board that differs is in step {first.number}, "
                f"{_seconds(first, began_ns):.3f} s after the beginning of the recording"
            )
        speeds = _speeds(max_wheel_speed(first.recorded.line), max_wheel_speed(first.replayed.line))
        shaping = [key for key in keys if key.startswith(LINE_SETTINGS)]
        because = f", because of {', '.join(shaping[:MAX_KEYS])}" if shaping else ""
        rows.append(f"the highest wheel speed in the first line that differs: {speeds}{because}")
    if fault is not None:
        rows.append(
            "the replayed robot is in the mode fault from "
            f"t = {_seconds(fault, began_ns):.3f} s onward: "
            f"{printable(fault.replayed.status.reason)}"
        )
        if first is not None and first.number < fault.number:
            rows.append(
                "  the wheel speeds in the recording are the response to the recorded lines, not "
                "to the lines of this replay. So a robot with this configuration might not have "
                "had that fault, and only the part of the replay before the fault is reliable"
            )
    return rows


def _value(key: str, settings: Mapping[str, object]) -> str:
    return show(settings[key]) if key in settings else "absent"


def _speeds(recorded: int, replayed: int) -> str:
    # In rad/s, of 0.01 rad/s.
    return f"{recorded / 100:.2f} rad/s recorded, {replayed / 100:.2f} rad/s replayed"


def describe_outcome(comparison: Comparison) -> list[str]:
    """Return lines that compare the motion: lines to the board, wheel speeds, poses, distance."""
    total, equal = comparison.all, comparison.equal
    rows = [
        f"{total['lines'] - equal['lines']} of {total['lines']} lines to the board "
        f"differ from the recorded ones, and {total['modes'] - equal['modes']} of "
        f"{total['modes']} steps have a different mode",
        "the highest wheel speed in any line to the board: "
        f"{_speeds(*comparison.max_wheel_speeds)}",
    ]
    if comparison.end is not None:
        (x, y, _), (new_x, new_y, _) = comparison.end
        rows.append(
            f"the last odometry pose: x {x / US_PER_S:.3f} y {y / US_PER_S:.3f} recorded, "
            f"x {new_x / US_PER_S:.3f} y {new_y / US_PER_S:.3f} replayed; "
            "the recorded and the replayed path are at most "
            f"{comparison.max_distance_m:.3f} m apart"
        )
    return rows
